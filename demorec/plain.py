"""Dataclasses to plain JSON data and back, strictly: unknown keys and wrong types are errors that name the key."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from numbers import Integral, Real
from typing import Any

import cattrs
import numpy as np
from cattrs.preconf.json import make_converter
from cattrs.v import format_exception

from demorec.geometry import Pose

_converter = make_converter(forbid_extra_keys=True)


def _pose_from_plain(value: Mapping[str, Any], _: type[Pose]) -> Pose:
    return Pose(position=np.array(value["position"]), quat_xyzw=np.array(value["quat_xyzw"]))


_converter.register_unstructure_hook(
    Pose, lambda pose: {"position": pose.position.tolist(), "quat_xyzw": pose.quat_xyzw.tolist()}
)
_converter.register_structure_hook(Pose, _pose_from_plain)


def _exactly[T](kind: type[T], accepted: type | tuple[type, ...]) -> Callable[[object, object], T]:
    """A hook that takes no value of another type, where cattrs would convert ("false" to True, 224.5 to 224)."""

    def hook(value: object, _: object) -> T:
        if type(value) is kind:  # nearly always; the abstract types below are slow
            return value
        if not isinstance(value, accepted) or (isinstance(value, bool) and kind is not bool):
            raise ValueError(f"{value!r} is no {_TYPE_WORDS[kind]}")
        return kind(value)  # type: ignore[call-arg]

    return hook


_TYPE_WORDS: dict[type, str] = {int: "whole number", float: "number", str: "string", bool: "boolean"}
_converter.register_structure_hook(int, _exactly(int, Integral))
_converter.register_structure_hook(float, _exactly(float, Real))
_converter.register_structure_hook(str, _exactly(str, str))
_converter.register_structure_hook(bool, _exactly(bool, (bool, np.bool_)))


def _in_words(error: BaseException, type_: type | None) -> str:
    words = str(error)
    return words if isinstance(error, ValueError) and " is no " in words else format_exception(error, type_)


def to_plain(value: object) -> Any:
    """Plain dicts, lists and scalars of a dataclass; floats keep every bit."""
    return _converter.unstructure(value)


def from_plain[T](data: object, cls: type[T]) -> T:
    """Build `cls` from plain data.

    Raises:
        ValueError: One line that lists every key that is unknown, missing or of a wrong type.
    """
    try:
        return _converter.structure(data, cls)
    except cattrs.BaseValidationError as error:
        raise ValueError(
            "; ".join(cattrs.transform_error(error, path=cls.__name__, format_exception=_in_words))
        ) from None


def to_json(value: object, *, indent: int | None = None) -> str:
    """Canonical JSON: sorted keys, shortest floats that read back to the same bits."""
    separators = None if indent else (",", ":")
    return json.dumps(to_plain(value), sort_keys=True, indent=indent, separators=separators, allow_nan=False)


def from_json[T](text: str, cls: type[T]) -> T:
    """Inverse of `to_json`; ValueError as `from_plain`."""
    return from_plain(json.loads(text), cls)


def digest(value: object) -> str:
    """First 16 hex digits of the SHA-256 of the canonical JSON."""
    return hashlib.sha256(to_json(value).encode()).hexdigest()[:16]
