"""Access to message content: field paths, header times, and the numbers of a source."""

from __future__ import annotations

import base64
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from demorec.core.registry import nearest_match
from demorec.extensions.imports.bag_files import MAX_TIME_NS
from demorec.extensions.imports.mapping import MAX_ELEMENTS, Source
from demorec.mcap.cdr import Values

_STEP = re.compile(r"(?P<name>[^.\[\]]+)|\[(?P<key>[^=\]]+)=(?P<value>[^\]]*)\]|\[(?P<index>\d+)\]")
_STAMP_PATHS = (
    ("header", "stamp"),
    ("stamp",),
    ("timestamp",),
    ("header", "timestamp"),
    ("ts", "realtime"),
    ("transforms", 0, "header", "stamp"),
    ("transforms", 0, "timestamp"),
)
_SECONDS, _NANOSECONDS = ("sec", "secs", "seconds"), ("nanosec", "nsec", "nsecs", "nanos")
_NAME_FIELDS = ("name", "names", "joint_names")
Step = str | int | tuple[str, str]


class FieldError(ValueError):
    """A message or dataset does not fit the mapping; `str` is the reason, for use inside a sentence."""


class OtherPublisherError(ValueError):
    """A message names none of the joints: it comes from another publisher on the same topic, which is not an error."""


def parse_path(path: str) -> tuple[Step, ...]:
    """Parse the steps of "transforms[child_frame_id=hand].transform" or "points[0].positions"; FieldError if
    invalid.
    """
    steps: list[Step] = []
    position = 0
    while position < len(path):
        if steps and path[position] == ".":
            position += 1
        found = _STEP.match(path, position)
        if found is None:
            raise FieldError(f"{path!r} is not a field path")
        if found["name"] is not None:
            steps.append(found["name"])
        elif found["index"] is not None:
            steps.append(int(found["index"]))
        else:
            steps.append((found["key"], found["value"]))
        position = found.end()
    return tuple(steps)


def follow(values: Any, steps: Sequence[Step]) -> Any:
    """Value at a path; for a list of messages, the field of each."""
    for step in steps:
        if isinstance(step, str):
            if isinstance(values, list):
                values = [follow(item, (step,)) for item in values]
                if values and all(isinstance(item, int | float) for item in values):
                    values = np.array(values, dtype=np.float64)
            elif isinstance(values, Mapping):
                if step not in values:
                    raise FieldError(f"there is no field {step!r}.{nearest_match(step, values)}".rstrip("."))
                values = values[step]
            else:
                raise FieldError(f"there is no field {step!r} in a number or text")
        elif isinstance(step, int):
            if not isinstance(values, list | np.ndarray) or not 0 <= step < len(values):
                raise FieldError(f"there is no element {step}")
            values = values[step]
        else:
            items = values if isinstance(values, list) else []
            chosen = [item for item in items if isinstance(item, Mapping) and str(item.get(step[0])) == step[1]]
            if not chosen:
                raise OtherPublisherError(f"nothing has the {step[0]} {step[1]!r}")
            values = chosen[0]
    return values


def stamp_of(values: Values) -> int | None:
    """Header time of a message, nanoseconds; None if it has no header."""
    for path in _STAMP_PATHS:
        found: Any = values
        for step in path:
            if isinstance(step, str):
                found = found.get(step) if isinstance(found, Mapping) else None
            else:
                found = found[step] if isinstance(found, list) and len(found) > step else None
        if (time_ns := _nanoseconds(found)) is not None:
            return time_ns
    return None


def _nanoseconds(value: Any) -> int | None:
    if isinstance(value, Mapping):
        seconds = next((value[key] for key in _SECONDS if key in value), None)
        rest = next((value[key] for key in _NANOSECONDS if key in value), 0)
        if not isinstance(seconds, int | float) or not isinstance(rest, int | float):
            return None
        if abs(seconds) < MAX_TIME_NS and abs(rest) < MAX_TIME_NS:  # also false for NaN
            time_ns = int(seconds) * 1_000_000_000 + int(rest)
            return time_ns if abs(time_ns) < MAX_TIME_NS else None
    return None


def whole(values: Mapping[str, Any], name: str) -> int:
    """An integer of a message, which JSON may store in any form; FieldError if it is not a 32-bit integer."""
    value = values[name]
    if isinstance(value, int | float | np.integer | np.floating) and -(2**31) <= value < 2**32:
        return int(value)
    raise FieldError(f"its {name} is not a 32-bit number")


def image_bytes(values: Mapping[str, Any]) -> bytes:
    """Bytes of an image; JSON has them in base64."""
    data = values["data"]
    if isinstance(data, str):
        try:
            return base64.b64decode(data, validate=True)
        except ValueError as error:  # binascii's error, and that for texts that are not ASCII
            raise FieldError("its image is not base64") from error
    if isinstance(data, np.ndarray):
        return data.tobytes()
    if isinstance(data, bytes):
        return data
    raise FieldError("it holds no image")


def numbers_in(value: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """Yield (name, number or array) for all numbers in a value, in field order; headers and texts are left out."""
    if isinstance(value, Mapping):
        for key, item in value.items():
            if key != "header":
                yield from numbers_in(item, f"{name}.{key}" if name else key)
    elif isinstance(value, np.ndarray | bool | int | float | np.generic):
        yield name, value


_FLOATS = (np.dtype(np.float32), np.dtype(np.float64))


@dataclass(kw_only=True)
class SourceReader:
    """Reader of a source's vectors, with the layout of its first message.

    Attributes:
        names: Names of the feature's elements.
        joints: Names of these elements in messages, where their order may vary; empty if elements have no names, or
        several share one.
        steps, names_steps: Path of the numbers, and of their names; None if elements have none.
    """

    source: Source
    names: tuple[str, ...]
    joints: tuple[str, ...]
    steps: tuple[Step, ...]
    names_steps: tuple[Step, ...] | None
    _orders: dict[tuple[str, ...], list[int]] = field(init=False, compare=False, default_factory=dict)

    def read(self, values: Values) -> NDArray[np.floating[Any]]:
        """(D,) float32 or float64.

        Raises:
            FieldError: The message lacks content of the first one.
            OtherPublisherError: It has none of the joints.
        """
        found = follow(values, self.steps)
        if isinstance(found, np.ndarray) and found.ndim == 1 and found.dtype in _FLOATS:
            vector: NDArray[np.floating[Any]] = found  # the fast path for most messages
        else:
            vector = _joined([found] if isinstance(found, np.ndarray) else [item for _, item in numbers_in(found)])
        if self.joints:
            assert self.names_steps is not None
            names = tuple(_names_at(values, self.names_steps))
            order = self._orders.get(names) or self._order_of(names)
            if len(vector) != len(names):
                raise FieldError(f"{len(vector)} values have {len(names)} names")
            return vector[order]
        if elements := self.source.elements:
            if max(elements) >= len(vector):
                raise FieldError(f"there are {len(vector)} values, too few")
            return vector[list(elements)]
        if len(vector) != len(self.names):
            raise FieldError(f"there are {len(vector)} values where the first message has {len(self.names)}")
        return vector

    def _order_of(self, names: tuple[str, ...]) -> list[int]:
        missing = [joint for joint in self.joints if joint not in names]
        if self.source.joints and len(missing) == len(self.joints):
            raise OtherPublisherError("it names none of the joints")
        takes_all = not self.source.joints and not self.source.elements
        if takes_all and (others := [name for name in names if name not in self.joints]):
            raise FieldError(
                f"it names other joints than the first message, such as {others[0]!r}: select one publisher by joints"
            )
        if missing:
            raise FieldError(f"the joint {missing[0]!r} is missing")
        order = [names.index(joint) for joint in self.joints]
        if len(self._orders) < 1000:
            self._orders[names] = order
        return order


def reader_of(source: Source, values: Values) -> SourceReader:
    """Create the reader of a source from its first message.

    Raises:
        FieldError: The message lacks content that the source names.
        OtherPublisherError: It has none of the joints.
    """
    steps = parse_path(source.field)
    found = follow(values, steps)
    parts = list(numbers_in(found))
    if not parts:
        raise FieldError(f"the field {source.field!r} holds no numbers")
    count = sum(np.size(item) for _, item in parts)
    if count > MAX_ELEMENTS:
        raise FieldError(f"the field {source.field!r} holds {count:,} numbers, at most {MAX_ELEMENTS:,} are supported")
    beside = _names_beside(values, steps)
    if not source.joints:
        beside = [(place, names) for place, names in beside if len(names) == np.size(found)]
    names_steps, named = beside[0] if beside else (None, None)
    if not source.joints:
        labels = picked(source, named or _labels(source.field, parts), repr(source.field))
    elif named is None:
        raise FieldError(f"the elements of {source.field!r} have no names, pick them by elements = [0, 1, ...]")
    elif missing := [joint for joint in source.joints if joint not in named]:
        problem = f"there is no joint {missing[0]!r}.{nearest_match(missing[0], named)}".rstrip(".")
        raise OtherPublisherError(problem) if len(missing) == len(source.joints) else FieldError(problem)
    else:
        labels = list(source.joints)
    is_named = bool(source.joints) or (named is not None and len(set(named)) == len(named))
    return SourceReader(
        source=source,
        names=names_of(source, labels, repr(source.field)),
        joints=tuple(labels) if is_named else (),
        steps=steps,
        names_steps=names_steps,
    )


def picked[T](source: Source, elements: Sequence[T], place: str) -> list[T]:
    """The elements that a source selects; FieldError if there are too few."""
    if outside := [index for index in source.elements if index >= len(elements)]:
        raise FieldError(f"no element {outside[0]} among the {len(elements)} of {place}")
    return [elements[index] for index in source.elements or range(len(elements))]


def names_of(source: Source, labels: Sequence[str], place: str) -> tuple[str, ...]:
    """Names in the feature of the selected elements; FieldError if their numbers differ."""
    if source.names and len(source.names) != len(labels):
        raise FieldError(f"names: {len(source.names)} given for the {len(labels)} elements of {place}")
    return tuple(source.names or labels)


def _names_beside(values: Values, steps: tuple[Step, ...]) -> list[tuple[tuple[Step, ...], list[str]]]:
    """Path and texts of each list of names that may belong to the numbers at a path."""
    found = []
    for place in dict.fromkeys([*((*steps[:-1], name) for name in _NAME_FIELDS), *((name,) for name in _NAME_FIELDS)]):
        with suppress(FieldError, OtherPublisherError):
            found.append((place, _names_at(values, place)))
    return found


def _names_at(values: Values, steps: tuple[Step, ...]) -> list[str]:
    names = follow(values, steps)
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise FieldError("the field of the names holds no texts")
    return names


def _labels(field: str, parts: Sequence[tuple[str, Any]]) -> list[str]:
    labels = []
    for name, item in parts:
        base = name or field.rsplit(".", 1)[-1]
        labels += [f"{base}_{index}" for index in range(np.size(item))] if np.ndim(item) else [base]
    return labels


def _joined(parts: Sequence[Any]) -> NDArray[np.floating[Any]]:
    """Concatenate numbers to a vector: float32 if all are, otherwise float64, which holds the others exactly."""
    arrays = [np.atleast_1d(np.asarray(part)) for part in parts]
    single = all(array.dtype.newbyteorder("=") == np.float32 for array in arrays)
    return np.concatenate([array.astype(np.float32 if single else np.float64) for array in arrays])
