"""Dataclasses to plain JSON data and back, strictly: unknown keys and wrong types are errors that name the key."""

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
"""Lists and objects within each other: our own data have ten at most, and code that walks deeper ones would recurse."""
_MAX_DIGITS = 20
"""Of a whole number: 64 bits need no more."""
_LENGTH = re.compile(r"^(Not enough|Too many) values in .* to structure as (.*)$", re.DOTALL)
"""What cattrs says of a list that is not as long as it must be."""
_CHOICE = re.compile(r"^(.*) not in literal typing\.Literal\[(.*)\]$", re.DOTALL)
"""What cattrs says of a value that is none of those allowed."""
MAX_LISTED = 8
"""Mistakes that are listed at once; a hostile file may have hundreds of thousands."""


def _exactly[T](kind: type[T], accepted: type | tuple[type, ...]) -> Callable[[object, object], T]:
    """A hook that takes no value of another type, where cattrs would convert ("false" to True, 224.5 to 224)."""

    def hook(value: object, _: object) -> T:
        if type(value) is kind:  # nearly always; the abstract types below are slow
            return value
        if not isinstance(value, accepted) or (isinstance(value, bool) and kind is not bool):
            raise ValueError(f"{reprlib.repr(value)} is no {_TYPE_WORDS[kind]}")
        return kind(value)  # type: ignore[call-arg]

    return hook


_TYPE_WORDS: dict[type, str] = {int: "whole number", float: "number", str: "string", bool: "boolean"}
_exact_int, _exact_float = _exactly(int, Integral), _exactly(float, Real)


def _int(value: object, kind: object) -> int:
    number = _exact_int(value, kind)
    if not -(2**63) <= number < 2**64:
        raise ValueError(f"{reprlib.repr(value)} is no whole number of 64 bits")
    return number


def _float(value: object, kind: object) -> float:
    try:
        number = _exact_float(value, kind)
    except OverflowError:  # a whole number beyond all floats
        number = math.inf
    if not math.isfinite(number):
        raise ValueError(f"{reprlib.repr(value)} is no finite number")
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
        return f"{reprlib.repr(choice[1])} is none of {choice[2]}"
    return words if isinstance(error, ValueError) and " is no " in words else format_exception(error, type_)


def listed(words: Iterable[str], most: int = MAX_LISTED, separator: str = "; ") -> str:
    """The first of some words as one sentence's part, and how many more there are."""
    items = list(words)
    more = [f"and {len(items) - most:,} more"] if len(items) > most else []
    return separator.join(items[:most] + more)


def to_plain(value: object) -> Any:
    """Plain dicts, lists and scalars of a dataclass; floats keep every bit."""
    return _converter.unstructure(value)


def from_plain[T](data: object, cls: type[T]) -> T:
    """Build `cls` from plain data.

    Raises:
        ValueError: One line that lists the keys that are unknown, missing or of a wrong type (the first of very many).
    """
    try:
        return _converter.structure(data, cls)
    except cattrs.BaseValidationError as error:
        words = cattrs.transform_error(error, path=cls.__name__, format_exception=_in_words)
        raise ValueError(listed(words)) from None
    except (TypeError, AttributeError) as error:  # no object where the outermost one is expected
        raise ValueError(f"{reprlib.repr(data)} is no {cls.__name__}") from error


def leave_out_default(cls: type, *names: str) -> None:
    """Write a dataclass without those of these fields that have their default value."""
    changes: Any = dict.fromkeys(names, override(omit_if_default=True))
    _converter.register_unstructure_hook(cls, make_dict_unstructure_fn(cls, _converter, **changes))


def parse_json(text: str, *, allow_nan: bool = False) -> Any:
    """The value of a JSON text of unknown origin.

    Args:
        text: What to read.
        allow_nan: Whether NaN and infinities, which Python and NumPy write and the standard does not know, may occur.

    Raises:
        ValueError: No JSON, or what none of our own files holds and no code that reads them can bear: values nested
            deeper than `MAX_DEPTH`, whole numbers of more than 64 bits.
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
    raise ValueError(f"{word} is no number of JSON")


def to_json(value: object, *, indent: int | None = None) -> str:
    """Canonical JSON: sorted keys, shortest floats that read back to the same bits."""
    separators = None if indent else (",", ":")
    return json.dumps(to_plain(value), sort_keys=True, indent=indent, separators=separators, allow_nan=False)


def from_json[T](text: str, cls: type[T]) -> T:
    """Inverse of `to_json`; ValueError as `parse_json` and `from_plain`."""
    return from_plain(parse_json(text), cls)


def digest(value: object) -> str:
    """First 16 hex digits of the SHA-256 of the canonical JSON."""
    return hashlib.sha256(to_json(value).encode()).hexdigest()[:16]
