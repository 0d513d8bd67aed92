"""CDR, the wire format of ROS 2 messages (OMG DDS-XTypes, plain XCDR1, little endian).

A recording consists of many messages with the same names and lengths and other numbers. So a message is laid out
once, as a `Layout`: constant bytes with slots for time stamps and float64 (or int64) values. Writing or reading a
batch is then a copy into or out of the slots of all its messages at once, instead of a walk through every field of
each.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from demorec.geometry import Array

_HEADER = b"\x00\x01\x00\x00"
_NANOSECONDS = 1_000_000_000


class CdrWriter:
    """Appends fields to one message; alignment counts from the end of the four header bytes."""

    def __init__(self) -> None:
        self._data = bytearray(_HEADER)
        self.time_slots: list[int] = []
        self.value_slots: list[int] = []

    def _pack(self, code: str, size: int, value: float) -> None:
        self._data += b"\x00" * (-(len(self._data) - 4) % size)
        self._data += struct.pack("<" + code, value)

    def u8(self, value: int) -> None:
        """One byte; also bool."""
        self._data.append(value)

    def u16(self, value: int) -> None:
        """uint16."""
        self._pack("H", 2, value)

    def u32(self, value: int) -> None:
        """uint32; also the length of a sequence."""
        self._pack("I", 4, value)

    def i32(self, value: int) -> None:
        """int32."""
        self._pack("i", 4, value)

    def f64(self, value: float) -> None:
        """float64."""
        self._pack("d", 8, value)

    def f32(self, value: float) -> None:
        """float32."""
        self._pack("f", 4, value)

    def integers(self, values: NDArray[np.int64]) -> None:
        """A sequence of int64."""
        self.u32(len(values))
        if len(values):
            self._data += b"\x00" * (-(len(self._data) - 4) % 8)
            self._data += np.ascontiguousarray(values, dtype="<i8").tobytes()

    def floats(self, values: Sequence[float]) -> None:
        """float64 after float64: a fixed-size array, or the elements of a sequence."""
        for value in values:
            self.f64(value)

    def text(self, value: str) -> None:
        """A string: length with the closing NUL, UTF-8 bytes, NUL."""
        raw = value.encode()
        self.u32(len(raw) + 1)
        self._data += raw + b"\x00"

    def time(self, time_ns: int) -> None:
        """builtin_interfaces/Time."""
        self.i32(time_ns // _NANOSECONDS)
        self.u32(time_ns % _NANOSECONDS)

    def header(self, frame_id: str, time_ns: int = 0) -> None:
        """std_msgs/Header; its stamp is a slot of the layout."""
        self.time_slot(time_ns)
        self.text(frame_id)

    def time_slot(self, time_ns: int = 0) -> None:
        """A time stamp that `Layout.encode` fills in."""
        self.time(time_ns)
        self.time_slots.append(len(self._data) - 8)

    def value_slot(self, count: int = 1) -> None:
        """Values of eight bytes that `Layout.encode` fills in."""
        for _ in range(count):
            self.f64(0.0)
            self.value_slots.append(len(self._data) - 8)

    def finish(self) -> bytes:
        """The message."""
        return bytes(self._data)

    def layout(self, dtype: Literal["<f8", "<i8"] = "<f8") -> Layout:
        """The message as a layout, whose values are all of one type."""
        return Layout(
            dtype=dtype,
            constant=np.frombuffer(bytes(self._data), dtype=np.uint8),
            time_bytes=_slot_bytes(self.time_slots),
            value_bytes=_slot_bytes(self.value_slots),
        )


def _slot_bytes(offsets: Sequence[int]) -> NDArray[np.intp]:
    return (np.array(offsets, dtype=np.intp)[:, None] + np.arange(8)).reshape(-1)


def _runs(positions: NDArray[np.intp]) -> list[tuple[int, int]]:
    """(first, last + 1) of the stretches without a gap in ascending positions."""
    if not len(positions):
        return []
    cuts = np.flatnonzero(np.diff(positions) != 1) + 1
    firsts, lasts = positions[[0, *cuts]], positions[[*(cuts - 1), -1]]
    return [(int(a), int(b) + 1) for a, b in zip(firsts, lasts, strict=True)]


@dataclass(frozen=True, kw_only=True, eq=False)
class Layout:
    """A message of constant length whose stamps and values change.

    Attributes:
        dtype: Of the values: float64 or int64.
        constant: (L,) uint8, the message with zeros in the slots.
        time_bytes: (8 S,) positions of the bytes of the S time stamps, which are all set to the message's time.
        value_bytes: (8 K,) positions of the bytes of the K values.
    """

    dtype: Literal["<f8", "<i8"] = "<f8"
    constant: NDArray[np.uint8]
    time_bytes: NDArray[np.intp]
    value_bytes: NDArray[np.intp]

    @property
    def num_values(self) -> int:
        """K."""
        return len(self.value_bytes) // 8

    @cached_property
    def _value_runs(self) -> list[tuple[int, int]]:
        return _runs(self.value_bytes)

    @cached_property
    def _time_runs(self) -> list[tuple[int, int]]:
        return _runs(self.time_bytes)

    def encode(self, time_ns: NDArray[np.int64], values: NDArray[Any]) -> list[bytes]:
        """One message for each row of `values` (N, K), stamped with `time_ns` (N,)."""
        count, length = len(time_ns), len(self.constant)
        # Four bytes in front of each message put its float64 values on multiples of eight.
        width = 4 + length + -(4 + length) % 8
        rows = np.zeros((count, width), dtype=np.uint8)
        rows[:, 4 : 4 + length] = self.constant
        seconds, nanoseconds = np.divmod(time_ns, _NANOSECONDS)
        words = rows.view("<u4")
        words[:, (self.time_bytes[::8] + 4) // 4] = seconds[:, None]
        words[:, (self.time_bytes[::8] + 8) // 4] = nanoseconds[:, None]
        rows.view(self.dtype)[:, (self.value_bytes[::8] + 4) // 8] = values
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
        values = np.empty((len(rows), self.num_values), dtype=self.dtype)
        rest = rows.copy()
        column = 0
        for first, last in self._value_runs:
            count = (last - first) // 8
            values[:, column : column + count] = np.ascontiguousarray(rows[:, first:last]).view(self.dtype)
            rest[:, first:last] = 0
            column += count
        for first, last in self._time_runs:
            rest[:, first:last] = 0
        # The slots of the constant are zero, so what is left must be the constant.
        if not (rest == self.constant).all():
            raise ValueError("a message with other names or lengths than the episode's metadata")
        return values


class CdrReader:
    """Reads the fields of one message in order; ValueError when it is too short or of another encoding."""

    def __init__(self, data: bytes) -> None:
        if data[:4] != _HEADER:
            raise ValueError(f"a message with the encapsulation {data[:4].hex() or 'of no bytes'}, expected 00010000")
        self._data = data
        self._position = 4

    def _take(self, size: int) -> bytes:
        start = self._position
        if start + size > len(self._data):
            raise ValueError(f"a message of {len(self._data)} bytes that ends within a field")
        self._position = start + size
        return self._data[start : start + size]

    def _unpack(self, code: str, size: int) -> int:
        self._position += -(self._position - 4) % size
        value: int = struct.unpack("<" + code, self._take(size))[0]
        return value

    def u8(self) -> int:
        """One byte."""
        return self._take(1)[0]

    def u16(self) -> int:
        """uint16."""
        return self._unpack("H", 2)

    def u32(self) -> int:
        """uint32."""
        return self._unpack("I", 4)

    def floats(self, count: int) -> Array:
        """(count,) float64 after float64."""
        if count:
            self._position += -(self._position - 4) % 8
        return np.frombuffer(self._take(8 * count), dtype="<f8").astype(np.float64)

    def text(self) -> str:
        """A string."""
        raw = self._take(self.u32())
        if not raw.endswith(b"\x00"):
            raise ValueError("a string without its closing NUL")
        return raw[:-1].decode()

    def octets(self, count: int) -> bytes:
        """Byte after byte."""
        return self._take(count)

    def integers(self) -> NDArray[np.int64]:
        """A sequence of int64."""
        count = self.u32()
        if count:
            self._position += -(self._position - 4) % 8
        return np.frombuffer(self._take(8 * count), dtype="<i8").astype(np.int64)

    def time(self) -> int:
        """builtin_interfaces/Time, as nanoseconds."""
        return self.u32() * _NANOSECONDS + self.u32()

    def header(self) -> tuple[int, str]:
        """std_msgs/Header: stamp in nanoseconds, frame."""
        return self.time(), self.text()
