"""Strict parsing of a mapping's TOML file: size limits, and an error with the closest match for unknown keys."""

from __future__ import annotations

import dataclasses
import tomllib
import typing
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

from demorec.core.errors import ConfigError, describe_error
from demorec.core.files import read_text_limited
from demorec.core.plain import MAX_LISTED, from_plain, listed
from demorec.core.registry import nearest_match
from demorec.episode.features import ACTION, STATE
from demorec.extensions.imports.mapping import (
    KIND,
    MAX_FPS,
    MAX_SECONDS,
    Source,
    SourceKind,
    SourceMapping,
)

_MAX_FILE_BYTES = 1 << 20
_KINDS: dict[SourceKind, str] = {"bag": "bags", "hdf5": "HDF5 files"}


def read_mapping(path: Path, kind: SourceKind = "bag") -> SourceMapping:
    """Read a mapping of bags or HDF5 files from its TOML file.

    Raises:
        ConfigError: All unknown keys; without any, all values of a wrong type; without any, all impossible values: the
        former often cause the latter.
    """
    try:
        data = tomllib.loads(read_text_limited(path, _MAX_FILE_BYTES))
    except FileNotFoundError as error:
        raise ConfigError(f"No mapping (demorec import ... --suggest > FILE writes one): {path}") from error
    except OSError as error:
        raise ConfigError(f"The mapping cannot be read ({error.strerror}): {path}") from error
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"The mapping is not valid TOML ({describe_error(error)}): {path}") from error
    if problems := list(islice(_unknown_keys(data, SourceMapping, "", kind), MAX_LISTED)):
        for other in _KINDS:
            if not any(_unknown_keys(data, SourceMapping, "", other)):
                raise ConfigError(f"This is a mapping of {_KINDS[other]}, not of {_KINDS[kind]}: {path}")
        raise ConfigError(f"The mapping cannot be used: {'; '.join(problems)}: {path}")
    try:
        mapping = from_plain({**data, KIND: kind}, SourceMapping)
    except ValueError as error:
        raise ConfigError(f"The mapping cannot be used: {error}: {path}") from error
    if problems := list(_problems(mapping)):
        raise ConfigError(f"The mapping cannot be used: {listed(problems)}: {path}")
    return mapping


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


def _problems(mapping: SourceMapping) -> Iterator[str]:
    """Yield the problems of a mapping that neither depend on a bag or file nor make every episode invalid."""
    is_bag = mapping.kind == "bag"
    what = "topic" if is_bag else "dataset"
    for name, advice in ((STATE, "with its source"), (ACTION, f'with its {what}, or next = "{STATE}"')):
        if name not in mapping.features:
            key = name if "." not in name else f'"{name}"'
            yield f"missing feature {name!r}: write [[features.{key}]] {advice}"
    for name, sources in mapping.features.items():
        if not sources:
            yield f"the feature {name!r} has no source"
        for source in sources:
            yield from _source_problems(mapping, name, source)
    for name, camera in mapping.cameras.items():
        if not (camera.topic or camera.dataset):
            yield f"cameras.{name} needs a {what}"
    task, clock = mapping.task, mapping.clock
    if (bool(task.text.strip()) + bool(task.attribute) + task.file_name) != 1:
        yield f"[task] needs one of {'text' if is_bag else 'text, attribute'} and file_name"
    if mapping.robot.urdf and mapping.robot.urdf_topic:
        yield "robot.urdf and robot.urdf_topic are both given, one is enough"
    if not (clock.fps == 0 and not is_bag) and not 1 <= clock.fps <= MAX_FPS:
        yield f"clock.fps is {clock.fps}, allowed are 1 to {MAX_FPS}"
    yield from _age_problems("clock", clock.max_age_s)
    if not 0 <= clock.max_trim_s <= MAX_SECONDS:
        yield f"clock.max_trim_s is {clock.max_trim_s:g}, it must be 0 to {MAX_SECONDS:g}"


def _source_problems(mapping: SourceMapping, name: str, source: Source) -> Iterator[str]:
    place, is_bag = f"the feature {name!r}", mapping.kind == "bag"
    for what, taken in (("an element", source.elements), (f"a joint of {source.topic}", source.joints)):
        if len(set(taken)) != len(taken):
            yield f"{place} names {what} twice"
    if any(element < 0 for element in source.elements):
        yield f"{place} names an element below 0"
    if source.next:
        known = [other for other in mapping.features if other != name]
        if len(mapping.features[name]) > 1 and not is_bag:
            yield f"{place} has other parts next to next"
        if source.next not in known:
            near = nearest_match(source.next, known)
            yield f"{place} follows {source.next!r}, which is not a feature.{near}".rstrip(".")
        elif any(other.next for other in mapping.features[source.next]):
            yield f"{place} follows {source.next!r}, which follows another feature itself"
    if bool(source.topic or source.dataset) == bool(source.next):
        what, parts = ("topic", "sources") if is_bag else ("dataset", "parts")
        yield f"{place} needs either a {what} or next in each of its {parts}"
    if source.topic and not source.field:
        yield f"{place} needs the field of {source.topic}"
    if source.joints and source.elements:
        yield f"{place} picks elements of {source.topic} both by joints and by elements"
    yield from _age_problems(place, source.max_age_s)


def _age_problems(place: str, age: float | None) -> Iterator[str]:
    if age is not None and not 0 < age <= MAX_SECONDS:
        yield f"{place}.max_age_s is {age:g}, it must be above 0 and at most {MAX_SECONDS:g}"
