"""What all mappings have in common: parts of features, their units, and the strict reading of TOML into dataclasses."""

from __future__ import annotations

import dataclasses
import math
import re
import tomllib
import typing
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Any, Literal

from demorec.core.errors import ConfigError, in_words
from demorec.core.files import read_text_limited
from demorec.core.plain import MAX_TOLD, digest, from_plain, listed
from demorec.core.registry import nearest_match
from demorec.mcap.external.validity import MAX_CAMERAS, MAX_FEATURES

Unit = Literal["", "rad", "degree", "percent", "m", "mm"]
STATE = "observation.state"
ACTION = "action"
MAX_FPS = 1000
MAX_ELEMENTS = 4096
"""Of a part: more is a picture or a point cloud, not a vector."""
MAX_SECONDS = 1e9
"""Of any time in a mapping: beyond it nanoseconds are no numbers of 64 bits."""
_MAX_FILE_BYTES = 1 << 20
_MAX_TABLES, _MAX_VALUES = 1000, 50_000
_MAX_TEXT = 10_000
_PART = r"""(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')"""
_DEEP_KEY = re.compile(rf"(?<![\w-]){_PART}(?:[ \t]*+\.[ \t]*+{_PART}){{16}}")
"""What no mapping has: each part of a key makes a table, and takes as long as all before it."""


@dataclass(frozen=True, kw_only=True)
class Part:
    """A part of a feature: which numbers of a vector are taken, what they are called, and in which unit.

    Attributes:
        elements: By number, in this order (auto: all).
        names: Of the elements in the feature (auto: as the source calls them).
        prefix: In front of each name, for two arms with the same names.
        unit: Of the source.
        to: Unit of the feature (auto: the source's, so that no bit changes).
        limits: [lowest, highest] of each element in the unit `to`, which -100..100 ("percent") stands for.
        next: In place of a source: the feature whose value at the next row this one has.
    """

    elements: tuple[int, ...] = ()
    names: tuple[str, ...] = ()
    prefix: str = ""
    unit: Unit = ""
    to: Unit = ""
    limits: tuple[tuple[float, float], ...] = ()
    next: str = ""


class AnyMapping(ABC):
    """A mapping, of whatever kind of file."""

    @cached_property
    def digest(self) -> str:
        """16 hex digits of all it says."""
        return digest(self)

    @abstractmethod
    def problems(self) -> Iterator[str]:
        """What is impossible in it, whatever the file."""


def feature_problems(features: Mapping[str, Sequence[Part]]) -> Iterator[str]:
    """What is impossible in features, whatever their parts are taken from."""
    if len(features) > MAX_FEATURES:
        yield f"there are {len(features):,} features, allowed are up to {MAX_FEATURES}"
        return
    if STATE not in features:
        yield f'there is no feature {STATE!r}: write [[features."{STATE}"]] and what it is taken from'
    for name, parts in features.items():
        if "/" in name or not name or name.startswith("observation.images"):
            yield f"a feature cannot be called {name!r}"
        if not parts:
            yield f"the feature {name!r} has no source"
        for part in parts:
            yield from _part_problems(f"the feature {name!r}", name, part, features)


def _part_problems(place: str, name: str, part: Part, features: Mapping[str, Sequence[Part]]) -> Iterator[str]:
    if part.next and len(features[name]) > 1:
        yield f"{place} has other sources beside next"
    if part.next:
        known = [other for other in features if other != name]
        if part.next == STATE and STATE not in features:
            pass  # said already
        elif part.next not in known:
            yield f"{place} follows {part.next!r}, which is no feature.{nearest_match(part.next, known)}".rstrip(".")
        elif any(other.next for other in features[part.next]):
            yield f"{place} follows {part.next!r}, which follows another feature itself"
    if len(set(part.elements)) != len(part.elements):
        yield f"{place} names an element twice"
    if any(element < 0 for element in part.elements):
        yield f"{place} names an element below 0"
    pair = (part.unit, part.to or part.unit)
    if pair not in _CONVERSIONS and pair[0] != pair[1]:
        yield f"{place} cannot turn {part.unit or 'no unit'} into {part.to}"
    if "percent" in pair and pair[0] != pair[1] and not part.limits:
        yield f"{place} needs limits, since -100..100 stands for each joint's own range"
    if any(not low < high for low, high in part.limits):
        yield f"{place} has limits that are not [lowest, highest]"


def camera_name_problems(cameras: Mapping[str, object]) -> Iterator[str]:
    """Names that no camera can have; too many cameras."""
    if len(cameras) > MAX_CAMERAS:
        yield f"there are {len(cameras):,} cameras, allowed are up to {MAX_CAMERAS}"
        return
    for name in cameras:
        if not name.isidentifier():
            yield f"a camera cannot be called {name!r}: letters, digits and underscores are allowed"


_CONVERSIONS: Mapping[tuple[str, str], float] = {
    ("degree", "rad"): math.pi / 180,
    ("rad", "degree"): 180 / math.pi,
    ("mm", "m"): 1e-3,
    ("m", "mm"): 1e3,
    ("percent", "rad"): math.nan,
    ("percent", "degree"): math.nan,
    ("percent", "m"): math.nan,
}
"""(unit of the source, unit of the feature) -> factor; NaN where each element has its own."""


def conversion_factor(unit: str, to: str) -> float | None:
    """What numbers are multiplied with; None for not at all, NaN where `Part.limits` say it for each element."""
    return _CONVERSIONS.get((unit, to or unit))


def recorded_unit(unit: str) -> str:
    """What recordings call a unit."""
    return "deg" if unit == "degree" else unit


def read_mapping_file[M: AnyMapping](path: Path, kind: type[M]) -> M:
    """A mapping from its TOML file; ConfigError tells what is wrong with it at once."""
    try:
        text = read_text_limited(path, _MAX_FILE_BYTES)
        if _DEEP_KEY.search(text):
            raise ValueError("a key has more than 16 parts")
        data = tomllib.loads(text)
    except OSError as error:
        raise ConfigError(f"The mapping cannot be read ({error.strerror}): {path}") from error
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"The mapping is no valid TOML ({in_words(error)}): {path}") from error
    problems = [problem] if (problem := _excess(data)) else list(islice(_unknown_keys(data, kind, ""), MAX_TOLD))
    if problems:
        raise ConfigError(f"The mapping cannot be used: {'; '.join(problems)}: {path}")
    try:
        mapping = from_plain(data, kind)
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


def _unknown_keys(value: Any, kind: Any, place: str) -> Iterator[str]:
    arguments = typing.get_args(kind)
    if isinstance(value, list) and typing.get_origin(kind) is tuple:
        for item in value:
            yield from _unknown_keys(item, arguments[0], place)
    children: dict[str, Any] = {}
    if isinstance(value, dict) and dataclasses.is_dataclass(kind):
        children = typing.get_type_hints(kind)
        where = f" in {place}" if place else ""
        for key in (key for key in value if key not in children):
            yield f"unknown key {key!r}{where}.{nearest_match(key, children)}".rstrip(".")
    elif isinstance(value, dict) and len(arguments) == 2:
        children = dict.fromkeys(value, arguments[1])
    for key, item in value.items() if children else ():
        if key in children:
            yield from _unknown_keys(item, children[key], f"{place}.{key}".strip("."))
