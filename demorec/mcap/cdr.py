"""CDR, the wire format of ROS 2 messages (OMG DDS-XTypes, plain XCDR1, little endian).

Messages are written and read by the definitions of their types (`demorec.mcap.ros2`). A value is one for each
field, in order: a tuple of a struct, a sequence of an array, the bytes of uint8[].

A recording consists of many messages with the same names and lengths and other numbers. So a message is laid out
once, as a `Layout`: constant bytes with slots for time stamps and float64 (or int64) values. Writing or reading a
batch is then a copy into or out of the slots of all its messages at once, instead of a walk through every field of
each.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from enum import Enum
from functools import cached_property, lru_cache
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from demorec.mcap.ros2 import FieldType, Types, types_of

HEADER = b"\x00\x01\x00\x00"
_NANOSECONDS = 1_000_000_000
_CODES = {
    "bool": "?", "byte": "B", "uint8": "B", "int8": "b", "uint16": "H", "int16": "h", "uint32": "I", "int32": "i",
    "uint64": "Q", "int64": "q", "float32": "f", "float64": "d",
}  # fmt: skip


class Slot(Enum):
    """What `Layout.encode` fills in: the message's time, in place of a builtin_interfaces/Time, or the next value."""

    TIME = 4
    VALUE = 8


def encode(schema: str, *values: Any) -> bytes:
    """A message of a type, or its beginning, where there are fewer values than fields."""
    writer = _Writer(types_of(schema))
    writer.struct("", values)
    return bytes(writer.data)


# The recordings of a run have the same few layouts, and an export opens many.
@lru_cache(maxsize=128)
def layout(schema: str, *values: Any) -> Layout:
    """Messages of a type that differ in what a `Slot` stands for alone; tuples for all that is in order."""
    writer = _Writer(types_of(schema))
    writer.struct("", values)
    return Layout(
        dtype="<i8" if schema.endswith("Int64MultiArray") else "<f8",
        constant=np.frombuffer(bytes(writer.data), dtype=np.uint8),
        time_slots=np.array(writer.slots[Slot.TIME], dtype=np.intp),
        value_slots=np.array(writer.slots[Slot.VALUE], dtype=np.intp),
    )


class _Writer:
    """Appends fields to one message; alignment counts from the end of the four header bytes."""

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
    """A message of constant length whose stamps and values change.

    Attributes:
        dtype: Of the values: float64 or int64.
        constant: (L,) uint8, the message with zeros in the slots.
        time_slots: (S,) where the time stamps begin, which are all set to the message's time.
        value_slots: (K,) where the values begin, which have eight bytes as the stamps do.
    """

    dtype: Literal["<f8", "<i8"] = "<f8"
    constant: NDArray[np.uint8]
    time_slots: NDArray[np.intp]
    value_slots: NDArray[np.intp]

    @cached_property
    def _value_runs(self) -> list[tuple[int, int]]:
        """(first, last + 1) of the stretches of bytes that values fill without a gap."""
        runs: list[tuple[int, int]] = []
        for slot in self.value_slots.tolist():
            first = runs.pop()[0] if runs and runs[-1][1] == slot else slot
            runs.append((first, slot + 8))
        return runs

    def encode(self, time_ns: NDArray[np.int64], values: NDArray[Any]) -> list[bytes]:
        """One message for each row of `values` (N, K), stamped with `time_ns` (N,)."""
        count, length = len(time_ns), len(self.constant)
        # Four bytes in front of each message put its float64 values on multiples of eight.
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

    def decode(self, messages: Sequence[bytes]) -> NDArray[Any]:
        """(N, K) values; ValueError unless every message has this layout in all its constant bytes."""
        length = len(self.constant)
        if any(len(message) != length for message in messages):
            found = next(len(message) for message in messages if len(message) != length)
            raise ValueError(f"a message of {found} bytes where {length} were expected")
        return self.decode_rows(np.frombuffer(b"".join(messages), dtype=np.uint8).reshape(len(messages), length))

    def decode_rows(self, rows: NDArray[np.uint8]) -> NDArray[Any]:
        """(N, K) values of messages of the right length, given as (N, L) bytes; ValueError as `decode`."""
        values = np.empty((len(rows), len(self.value_slots)), dtype=self.dtype)
        rest = rows.copy()
        column = 0
        for first, last in self._value_runs:
            count = (last - first) // 8
            values[:, column : column + count] = np.ascontiguousarray(rows[:, first:last]).view(self.dtype)
            rest[:, first:last] = 0
            column += count
        for slot in self.time_slots.tolist():
            rest[:, slot : slot + 8] = 0
        # The slots of the constant are zero, so what is left must be the constant.
        if not (rest == self.constant).all():
            raise ValueError("a message with other names or lengths than the episode's metadata")
        return values


def strict_text(raw: bytes) -> str:
    """A string as it is in a message; ValueError for none."""
    if not raw.endswith(b"\x00"):
        raise ValueError("a string without its closing NUL")
    return raw[:-1].decode()


class CdrReader:
    """Reads one message in order; ValueError when it is too short or of another encoding.

    Args:
        data: The message.
        text: What becomes of the bytes of a string.
    """

    def __init__(self, data: bytes, *, text: Callable[[bytes], str] = strict_text) -> None:
        if data[:4] != HEADER:
            raise ValueError(f"a message with the encapsulation {data[:4].hex() or 'of no bytes'}, expected 00010000")
        self._data, self._text = data, text
        self._position = 4

    @property
    def num_left(self) -> int:
        """Bytes that were not read."""
        return len(self._data) - self._position

    def values(self, schema: str) -> Iterator[Any]:
        """The fields of a message of a type; an array of numbers is a NumPy array."""
        types = types_of(schema)
        return (self._field(types, field) for field in types[""])

    def _field(self, types: Types, field: FieldType) -> Any:
        if not field.is_array:
            return self._value(types, field.kind)
        length = self._value(types, "uint32") if field.length is None else field.length
        if field.kind == "uint8" and field.length is None:
            return self._take(length)
        if field.kind not in _CODES:
            return [self._value(types, field.kind) for _ in range(length)]
        dtype = np.dtype("<" + _CODES[field.kind])
        if length:
            self._align(dtype.itemsize)
        return np.frombuffer(self._take(dtype.itemsize * length), dtype)

    def _value(self, types: Types, kind: str) -> Any:
        if kind in types:
            return tuple([self._field(types, field) for field in types[kind]])
        if kind == "string":
            return self._text(self._take(self._value(types, "uint32")))
        code = "<" + _CODES[kind]
        size = struct.calcsize(code)
        self._align(size)
        return struct.unpack(code, self._take(size))[0]

    def _align(self, size: int) -> None:
        self._position += -(self._position - 4) % size

    def _take(self, size: int) -> bytes:
        start = self._position
        if start + size > len(self._data):
            raise ValueError(f"a message of {len(self._data)} bytes that ends within a field")
        self._position = start + size
        return self._data[start : start + size]
