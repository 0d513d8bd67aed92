"""The strict reading of a mapping's TOML file: bounded, unknown keys refused with the nearest known one."""

from __future__ import annotations

import dataclasses
import re
import tomllib
import typing
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

from demorec.core.errors import ConfigError, in_words
from demorec.core.files import read_text_limited
from demorec.core.plain import MAX_TOLD, from_plain, listed
from demorec.core.registry import nearest_match
from demorec.sources.mapping import KIND, SourceKind, SourceMapping

_MAX_FILE_BYTES = 1 << 20
_MAX_TABLES, _MAX_VALUES = 1000, 50_000
_MAX_TEXT = 10_000
_KINDS: dict[SourceKind, str] = {"bag": "bags", "hdf5": "HDF5 files"}
_PART = r"""(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')"""
_DEEP_KEY = re.compile(rf"(?<![\w-]){_PART}(?:[ \t]*+\.[ \t]*+{_PART}){{16}}")
"""What no mapping has: each part of a key makes a table, and takes as long as all before it."""


def read_mapping(path: Path, kind: SourceKind = "bag") -> SourceMapping:
    """A mapping of bags, or of HDF5 files, from its TOML file; ConfigError says all that is wrong with it at once."""
    try:
        text = read_text_limited(path, _MAX_FILE_BYTES)
        if _DEEP_KEY.search(text):
            raise ValueError("a key has more than 16 parts")
        data = tomllib.loads(text)
    except OSError as error:
        raise ConfigError(f"The mapping cannot be read ({error.strerror}): {path}") from error
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"The mapping is no valid TOML ({in_words(error)}): {path}") from error
    problems = (
        [problem]
        if (problem := _excess(data))
        else list(islice(_unknown_keys(data, SourceMapping, "", kind), MAX_TOLD))
    )
    if problems:
        other: SourceKind = "hdf5" if kind == "bag" else "bag"
        if not _excess(data) and not any(_unknown_keys(data, SourceMapping, "", other)):
            raise ConfigError(f"This is a mapping of {_KINDS[other]}, not of {_KINDS[kind]}: {path}")
        raise ConfigError(f"The mapping cannot be used: {'; '.join(problems)}: {path}")
    try:
        if kind == "hdf5" and isinstance(data.get("episodes", {}), dict):
            # Nobody asks how an episode ended unless the mapping says where that is.
            data["episodes"] = {"success": ""} | data.get("episodes", {})
        mapping = from_plain({**data, KIND: kind}, SourceMapping)
    except ValueError as error:
        raise ConfigError(f"The mapping cannot be used: {error}: {path}") from error
    if problems := list(mapping.problems()):
        raise ConfigError(f"The mapping cannot be used: {listed(problems)}: {path}")
    return mapping


def _excess(data: Any) -> str:
    """What a mapping has too much of; "" for nothing."""
    values, tables, waiting = 0, 0, [data]
    while waiting:
        value = waiting.pop()
        values += 1
        if isinstance(value, dict):
            tables += 1
            waiting += [*value, *value.values()]
        elif isinstance(value, list):
            waiting += value
        elif isinstance(value, str) and len(value) > _MAX_TEXT:
            return f"a text has {len(value):,} characters, at most {_MAX_TEXT:,} are read"
    for count, most, what in ((tables, _MAX_TABLES, "tables"), (values, _MAX_VALUES, "values")):
        if count > most:
            return f"it has {count:,} {what}, at most {most:,} are read"
    return ""


def _unknown_keys(value: Any, kind: Any, place: str, of: SourceKind) -> Iterator[str]:
    arguments = typing.get_args(kind)
    if isinstance(value, list) and typing.get_origin(kind) is tuple:
        for item in value:
            yield from _unknown_keys(item, arguments[0], place, of)
    children: dict[str, Any] = {}
    if isinstance(value, dict) and dataclasses.is_dataclass(kind):
        own = {one.name for one in dataclasses.fields(kind) if one.metadata.get(KIND, of) == of} - {KIND}
        children = {name: hint for name, hint in typing.get_type_hints(kind).items() if name in own}
        where = f" in {place}" if place else ""
        for key in (key for key in value if key not in children):
            yield f"unknown key {key!r}{where}.{nearest_match(key, children)}".rstrip(".")
    elif isinstance(value, dict) and len(arguments) == 2:
        children = dict.fromkeys(value, arguments[1])
    for key, item in value.items() if children else ():
        if key in children:
            yield from _unknown_keys(item, children[key], f"{place}.{key}".strip("."), of)
