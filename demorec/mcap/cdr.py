"""CDR, the wire format of ROS 2 messages (OMG DDS-XTypes, plain XCDR1, little endian).

Messages are written and read by the definitions of their types (`demorec.mcap.ros2`, or a bag's). The values to write
are one per field, in order: a tuple for a struct, a sequence for an array, bytes for uint8[].

A recording consists of many messages with the same names and lengths but different numbers. So a message is laid out
once, as a `Layout`: constant bytes with slots for timestamps and float64 (or int64) values. Writing or reading a batch
is then a copy into or out of the slots of all its messages at once, instead of a walk through every field of each.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from functools import lru_cache
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from demorec.mcap.ros2 import FieldType, Types, types_of

HEADER = b"\x00\x01\x00\x00"
_NANOSECONDS = 1_000_000_000
_CODES = {
    "bool": "?", "byte": "B", "char": "B", "uint8": "B", "int8": "b", "uint16": "H", "int16": "h", "uint32": "I",
    "int32": "i", "uint64": "Q", "int64": "q", "float32": "f", "float64": "d",
}  # fmt: skip


class Slot(Enum):
    """Placeholder filled by `Layout.encode`: the message's time, as builtin_interfaces/Time, or the next value."""

    TIME = 4
    VALUE = 8


def encode(schema: str, *values: Any) -> bytes:
    """Encode a message of a type, or its beginning if there are fewer values than fields."""
    writer = _Writer(types_of(schema))
    writer.struct("", values)
    return bytes(writer.data)


# The recordings of a run share a few layouts, and an export opens many recordings.
@lru_cache(maxsize=128)
def layout(schema: str, *values: Any) -> Layout:
    """Lay out messages of a type that differ only in their `Slot` values; tuples for all sequences."""
    writer = _Writer(types_of(schema))
    writer.struct("", values)
    return Layout(
        dtype="<i8" if schema.endswith("Int64MultiArray") else "<f8",
        constant=np.frombuffer(bytes(writer.data), dtype=np.uint8),
        time_slots=np.array(writer.slots[Slot.TIME], dtype=np.intp),
        value_slots=np.array(writer.slots[Slot.VALUE], dtype=np.intp),
    )


class _Writer:
    """Appends fields to one message; alignment is relative to the end of the four header bytes."""

    def __init__(self, types: Types) -> None:
        self._types = types
        self.data = bytearray(HEADER)
        self.slots: dict[Slot, list[int]] = {slot: [] for slot in Slot}

    def struct(self, kind: str, values: Sequence[Any]) -> None:
        for field, value in zip(self._types[kind], values, strict=False):
            if not field.is_array:
                self._value(field.kind, value)
                continue
            if field.length is None:
                self._value("uint32", len(value))
            if isinstance(value, bytes):
                self.data += value
            elif isinstance(value, np.ndarray):
                dtype = np.dtype("<" + _CODES[field.kind])
                self._align(dtype.itemsize if len(value) else 1)
                self.data += value.astype(dtype).tobytes()
            else:
                for item in value:
                    self._value(field.kind, item)

    def _value(self, kind: str, value: Any) -> None:
        if isinstance(value, Slot):
            self._align(value.value)
            self.slots[value].append(len(self.data))
            self.data += bytes(8)
        elif kind in self._types:
            self.struct(kind, value)
        elif kind == "string":
            raw = value.encode() + b"\x00"
            self._value("uint32", len(raw))
            self.data += raw
        else:
            raw = struct.pack("<" + _CODES[kind], value)
            self._align(len(raw))
            self.data += raw

    def _align(self, size: int) -> None:
        self.data += bytes(-(len(self.data) - 4) % size)


@dataclass(frozen=True, kw_only=True, eq=False)
class Layout:
    """A message of constant length with variable timestamps and values."""

    dtype: Literal["<f8", "<i8"]  # type of the values
    constant: NDArray[np.uint8]  # (L,) the message with zeros in the slots
    time_slots: NDArray[np.intp]  # (S,) offsets of the timestamps, which are all set to the message's time
    value_slots: NDArray[np.intp]  # (K,) offsets of the values, of eight bytes each like the timestamps

    def encode(self, time_ns: NDArray[np.int64], values: NDArray[Any]) -> list[bytes]:
        """Encode one message per row of `values` (N, K), stamped with `time_ns` (N,)."""
        count, length = len(time_ns), len(self.constant)
        # Four bytes in front of each message align its float64 values to multiples of eight.
        width = 4 + length + -(4 + length) % 8
        rows = np.zeros((count, width), dtype=np.uint8)
        rows[:, 4 : 4 + length] = self.constant
        seconds, nanoseconds = np.divmod(time_ns, _NANOSECONDS)
        words = rows.view("<u4")
        words[:, (self.time_slots + 4) // 4] = seconds[:, None]
        words[:, (self.time_slots + 8) // 4] = nanoseconds[:, None]
        rows.view(self.dtype)[:, (self.value_slots + 4) // 8] = values
        data = rows.tobytes()
        return [data[start : start + length] for start in range(4, count * width, width)]

    def decode(self, rows: NDArray[np.uint8]) -> NDArray[Any]:
        """Decode (N, K) values of messages (N, L); ValueError unless each matches this layout's constant bytes."""
        places = self.value_slots[:, None] + np.arange(8)
        values = rows.take(places, axis=1).view(self.dtype)[..., 0]
        rest = rows.copy()
        rest[:, places] = 0
        rest[:, self.time_slots[:, None] + np.arange(8)] = 0
        # The slots of the constant are zero, so the remainder must equal the constant.
        if not (rest == self.constant).all():
            raise ValueError("a message with other names or lengths than the episode's metadata")
        return values


Values = dict[str, Any]
"""Field -> number, text, NumPy array (numbers), list (texts, messages) or Values."""
Reader = Callable[[memoryview, int], tuple[Any, int]]
"""Function of bytes and an offset; returns the value there and the offset after it."""

_MAX_DEPTH = 32
"""Maximum depth of types nested in a type; types that were read before may double it."""


class Readers:
    """Readers of the types in a definition, which is data: one per type, however often it occurs.

    Args:
        order: Byte order of numbers, "<" or ">".
        is_aligned: Whether numbers are aligned, as in CDR; those of ROS 1 are not.
    """

    def __init__(self, types: Types, *, order: str = "<", is_aligned: bool = True) -> None:
        self._types, self._order, self._is_aligned = types, order, is_aligned
        self._made: dict[str, Reader] = {}

    def of(self, kind: str) -> Reader:
        """Return the reader of a type; ValueError if it refers to an undefined type, or to itself."""
        return self._message(kind, 0)

    def _message(self, kind: str, depth: int) -> Reader:
        if depth > _MAX_DEPTH:
            raise ValueError("its definition is nested too deeply")
        if kind not in self._made:
            self._made[kind] = self._new(kind, depth)
        return self._made[kind]

    def _new(self, kind: str, depth: int) -> Reader:
        readers = [(field.name, self._field(field, depth)) for field in self._types[kind]]
        if not readers and self._is_aligned:  # ROS 2 gives a type without fields a byte
            return lambda data, position: ({}, position + 1)

        def read(data: memoryview, position: int) -> tuple[Values, int]:
            values = {}
            for field, read_field in readers:
                values[field], position = read_field(data, position)
            return values, position

        return read

    def _field(self, field: FieldType, depth: int) -> Reader:
        if field.is_array and field.kind in _CODES:
            return self._numbers(field.kind, field.length)
        if field.kind in self._types:
            reader = self._message(field.kind, depth + 1)
        elif "/" in field.kind:
            raise ValueError(f"its definition lacks the type {field.kind[:80]!r}")
        else:
            reader = self._scalar(field.kind)
        return self._list(reader, field.length) if field.is_array else reader

    def _scalar(self, kind: str) -> Reader:
        if kind == "string":
            return self._text()
        if kind not in _CODES:
            raise ValueError(f"it has a field of the unsupported type {kind}")
        number = struct.Struct(self._order + _CODES[kind])
        size, unpack = number.size, number.unpack_from
        mask = size - 1 if self._is_aligned else 0

        def read(data: memoryview, position: int) -> tuple[Any, int]:
            position = (position + mask) & ~mask
            return unpack(data, position)[0], position + size

        return read

    def _text(self) -> Reader:
        """Return the reader of a string, which replaces undecodable bytes; in CDR it ends with a zero byte."""
        length_of, end_bytes = self._scalar("uint32"), 1 if self._is_aligned else 0

        def read(data: memoryview, position: int) -> tuple[str, int]:
            length, position = length_of(data, position)
            end = position + length
            if end > len(data):
                raise ValueError("a text extends beyond the message's end")
            return bytes(data[position : end - end_bytes]).decode(errors="replace"), end

        return read

    def _count(self, count: int | None) -> Reader:
        """Return the reader of an array's length: fixed by the type, or stored in the message."""
        return self._scalar("uint32") if count is None else lambda data, position: (count, position)

    def _numbers(self, kind: str, count: int | None) -> Reader:
        dtype = np.dtype(self._order + ("B" if kind == "bool" else _CODES[kind]))
        size, count_of = dtype.itemsize, self._count(count)
        mask = size - 1 if self._is_aligned else 0

        def read(data: memoryview, position: int) -> tuple[Any, int]:
            number, position = count_of(data, position)
            if number == 0:
                return np.empty(0, dtype), position
            position = (position + mask) & ~mask
            end = position + number * size
            if end > len(data):
                raise ValueError("an array extends beyond the message's end")
            return np.frombuffer(data, dtype, number, position), end

        return read

    def _list(self, read_element: Reader, count: int | None) -> Reader:
        count_of = self._count(count)

        def read(data: memoryview, position: int) -> tuple[list[Any], int]:
            number, position = count_of(data, position)
            if number > len(data) - position:  # each element takes at least a byte
                raise ValueError("a list extends beyond the message's end")
            values = []
            for _ in range(number):
                value, position = read_element(data, position)
                values.append(value)
            return values, position

        return read


def read_whole(read: Reader, data: memoryview) -> tuple[Values, int]:
    """Read a message, and the number of bytes left after it; ValueError if it is truncated."""
    try:
        values, position = read(data, 0)
    except struct.error:
        raise ValueError("it ends within a value") from None
    return values, len(data) - position


@lru_cache(maxsize=128)
def _reader_of(schema: str) -> Reader:
    return Readers(types_of(schema)).of("")


def decode(schema: str, data: bytes) -> tuple[Values, int]:
    """Decode a message of a recorded type, and the number of bytes left after it; ValueError if it is damaged."""
    if data[:4] != HEADER:
        raise ValueError(f"a message with the encapsulation {data[:4].hex() or 'of no bytes'}, not 00010000")
    return read_whole(_reader_of(schema), memoryview(data)[4:])
