"""Strict conversion of dataclasses to plain JSON data and back; errors name each unknown key and wrong type."""

from __future__ import annotations

import hashlib
import json
import math
import re
import reprlib
from collections.abc import Callable, Iterable, Mapping
from numbers import Integral, Real
from typing import Any

import cattrs
import numpy as np
from cattrs.gen import make_dict_unstructure_fn, override
from cattrs.preconf.json import make_converter
from cattrs.v import format_exception

from demorec.core.geometry import Pose

_converter = make_converter(forbid_extra_keys=True)

MAX_DEPTH = 64
"""Maximum nesting of lists and objects: demorec's data need at most ten, and deeper data would overflow recursive code.
"""
_MAX_DIGITS = 20
"""Maximum digits of a whole number; 64 bits need at most 20."""
_LENGTH = re.compile(r"^(Not enough|Too many) values in .* to structure as (.*)$", re.DOTALL)
"""cattrs' message for a list of the wrong length."""
_CHOICE = re.compile(r"^(.*) not in literal typing\.Literal\[(.*)\]$", re.DOTALL)
"""cattrs' message for a value that is not one of the allowed ones."""
MAX_LISTED = 8
"""Maximum errors listed at once; a hostile file may have hundreds of thousands."""


def _exactly[T](kind: type[T], accepted: type | tuple[type, ...]) -> Callable[[object, object], T]:
    """Return a hook that rejects other types, which cattrs would convert ("false" to True, 224.5 to 224)."""

    def hook(value: object, _: object) -> T:
        if type(value) is kind:  # the usual case; the abstract types below are slow
            return value
        if not isinstance(value, accepted) or (isinstance(value, bool) and kind is not bool):
            raise ValueError(f"{reprlib.repr(value)} is not a {_TYPE_WORDS[kind]}")
        return kind(value)  # type: ignore[call-arg]

    return hook


_TYPE_WORDS: dict[type, str] = {int: "whole number", float: "number", str: "string", bool: "boolean"}
_exact_int, _exact_float = _exactly(int, Integral), _exactly(float, Real)


def _int(value: object, kind: object) -> int:
    number = _exact_int(value, kind)
    if not -(2**63) <= number < 2**64:
        raise ValueError(f"{reprlib.repr(value)} is not a 64-bit integer")
    return number


def _float(value: object, kind: object) -> float:
    try:
        number = _exact_float(value, kind)
    except OverflowError:  # an integer beyond the range of floats
        number = math.inf
    if not math.isfinite(number):
        raise ValueError(f"{reprlib.repr(value)} is not a finite number")
    return number


def _pose_from_plain(value: Mapping[str, Any], _: type[Pose]) -> Pose:
    position, quat_xyzw = ([_float(number, float) for number in value[name]] for name in ("position", "quat_xyzw"))
    return Pose(position=np.array(position), quat_xyzw=np.array(quat_xyzw))


_converter.register_structure_hook(int, _int)
_converter.register_structure_hook(float, _float)
_converter.register_structure_hook(str, _exactly(str, str))
_converter.register_structure_hook(bool, _exactly(bool, (bool, np.bool_)))
_converter.register_structure_hook(Pose, _pose_from_plain)
_converter.register_unstructure_hook(
    Pose, lambda pose: {"position": pose.position.tolist(), "quat_xyzw": pose.quat_xyzw.tolist()}
)


def _in_words(error: BaseException, type_: type | None) -> str:
    words = str(error)
    if isinstance(error, ValueError) and (length := _LENGTH.search(words)):
        return f"{length[1].lower()} values, expected {length[2]}"
    if choice := _CHOICE.search(words):
        return f"{reprlib.repr(choice[1])} is not one of {choice[2]}"
    return words if isinstance(error, ValueError) and " is no" in words else format_exception(error, type_)


def listed(words: Iterable[str], most: int = MAX_LISTED, separator: str = "; ") -> str:
    """Join the first few words, and the number of those left out, for use in a sentence."""
    items = list(words)
    more = [f"and {len(items) - most:,} more"] if len(items) > most else []
    return separator.join(items[:most] + more)


def to_plain(value: object) -> Any:
    """Convert a dataclass to plain dicts, lists and scalars; floats are bit-exact."""
    return _converter.unstructure(value)


def from_plain[T](data: object, cls: type[T]) -> T:
    """Build `cls` from plain data.

    Raises:
        ValueError: One line that lists unknown keys, missing keys and wrong types, up to a maximum.
    """
    try:
        return _converter.structure(data, cls)
    except cattrs.BaseValidationError as error:
        words = cattrs.transform_error(error, path=cls.__name__, format_exception=_in_words)
        raise ValueError(listed(words)) from None
    except (TypeError, AttributeError) as error:  # the outermost value is not an object
        raise ValueError(f"{reprlib.repr(data)} is not a valid {cls.__name__}") from error


def leave_out_default(cls: type, *names: str) -> None:
    """Omit these fields from a dataclass's plain form when they have their default value."""
    changes: Any = dict.fromkeys(names, override(omit_if_default=True))
    _converter.register_unstructure_hook(cls, make_dict_unstructure_fn(cls, _converter, **changes))


def parse_json(text: str, *, allow_nan: bool = False) -> Any:
    """Parse JSON text of unknown origin.

    Args:
        text: JSON text.
        allow_nan: Whether NaN and infinities may occur, which Python and NumPy write although the standard forbids
        them.

    Raises:
        ValueError: Not JSON, nested deeper than `MAX_DEPTH`, or an integer over 64 bits; demorec's files have neither.
    """
    try:
        value = json.loads(text, parse_int=_whole_number, parse_constant=float if allow_nan else _refuse_constant)
    except RecursionError:
        raise ValueError("its values are nested too deeply") from None
    level = [value]
    for _ in range(MAX_DEPTH):
        level = [
            child
            for parent in level
            for child in (parent.values() if isinstance(parent, dict) else parent if isinstance(parent, list) else ())
            if isinstance(child, dict | list)
        ]
        if not level:
            return value
    raise ValueError(f"its values are nested deeper than {MAX_DEPTH}")


def _whole_number(digits: str) -> int:
    if len(digits) > _MAX_DIGITS:
        raise ValueError(f"a whole number of {len(digits)} digits")
    return int(digits)


def _refuse_constant(word: str) -> float:
    raise ValueError(f"{word} is not a JSON number")


def to_json(value: object, *, indent: int | None = None) -> str:
    """Canonical JSON: sorted keys, shortest floats that parse back to the same bits."""
    separators = None if indent else (",", ":")
    return json.dumps(to_plain(value), sort_keys=True, indent=indent, separators=separators, allow_nan=False)


def from_json[T](text: str, cls: type[T]) -> T:
    """Parse the output of `to_json`; ValueError as in `parse_json` and `from_plain`."""
    return from_plain(parse_json(text), cls)


def digest(value: object) -> str:
    """First 16 hex digits of the SHA-256 of the canonical JSON."""
    return hashlib.sha256(to_json(value).encode()).hexdigest()[:16]


def plain_differences(there: Mapping[str, Any], here: Mapping[str, Any]) -> tuple[str, ...]:
    """One line per difference between two configs as plain data."""
    old, new = _flat(there), _flat(here)
    return tuple(
        f"{key} is {_spelt(old, key)} there and {_spelt(new, key)} here"
        for key in dict.fromkeys((*old, *new))
        if _spelt(old, key) != _spelt(new, key)
    )


def _flat(plain: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in plain.items():
        if isinstance(value, Mapping):
            flat.update(_flat(value, f"{prefix}{key} "))
        else:
            flat[prefix + key] = value
    return flat


def _spelt(values: Mapping[str, Any], key: str) -> str:
    if key not in values:
        return "nothing"
    value = values[key]
    if isinstance(value, list | tuple):
        return " ".join(str(item) for item in value) or "none"
    return str(value)
