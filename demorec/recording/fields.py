"""Any message taken apart into its fields by the definition of its type, so that what differs can be named.

The batch layouts of `streams` are for speed and know only what a recording should hold; here every byte has a name.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator, Mapping
from functools import cache

from demorec.recording.messages import PROTOBUF_VIDEO, protobuf_fields
from demorec.recording.ros2 import DEFINITIONS

Value = bool | int | float | str | bytes

_CODES = {
    "bool": "?", "byte": "B", "uint8": "B", "int8": "b", "uint16": "H", "int16": "h", "uint32": "I", "int32": "i",
    "uint64": "Q", "int64": "q", "float32": "f", "float64": "d",
}  # fmt: skip
_FIELD = re.compile(r"^([\w/]+)(\[(\d*)\])?\s+(\w+)$")


def message_fields(schema: str, data: bytes) -> dict[str, Value]:
    """Name of each field, as in `pose.position.x` or `position[3]`, -> its value, in order.

    A sequence also has its length, as `position.length`; octets (a coded picture) are one value.

    Args:
        schema: Type of the message, one that recordings use.
        data: The message.

    Raises:
        ValueError: The message is not of this type, or the type is unknown.
    """
    if schema == PROTOBUF_VIDEO:
        return dict(protobuf_fields(data))
    if schema not in DEFINITIONS:
        raise ValueError(f"no recording has messages of the type {schema!r}")
    types = _types(schema)
    reader = _Reader(data)
    found = dict(reader.struct(types, types[""], ""))
    reader.end()
    return found


_Fields = tuple[tuple[str, str, int | None], ...]
"""(name, type, length: -1 for a sequence, None for a single value) of each field."""


@cache
def _types(schema: str) -> Mapping[str, _Fields]:
    """Type -> its fields; "" is the message itself."""
    first, *others = re.split(r"^=+\n", DEFINITIONS[schema], flags=re.MULTILINE)
    types = {"": _fields(first)}
    for text in others:
        head, _, body = text.partition("\n")
        types[head.removeprefix("MSG: ")] = _fields(body)
    return types


def _fields(text: str) -> _Fields:
    found = (_FIELD.match(line) for line in text.splitlines())  # constants, which have a value, do not match
    return tuple(
        (match[4], match[1], None if match[2] is None else int(match[3] or -1)) for match in found if match is not None
    )


class _Reader:
    """Walks through one little-endian XCDR1 message; ValueError when it is of another form."""

    def __init__(self, data: bytes) -> None:
        if data[:4] != b"\x00\x01\x00\x00":
            raise ValueError("a message of another encapsulation")
        self._data, self._position = data, 4

    def struct(self, types: Mapping[str, _Fields], fields: _Fields, prefix: str) -> Iterator[tuple[str, Value]]:
        """Every field of a struct."""
        for name, kind, length in fields:
            path = prefix + name
            if length is None:
                yield from self._value(types, kind, path)
                continue
            if length < 0:
                length = self._number("I")
                if kind == "uint8":
                    yield path, self._take(length)
                    continue
                yield f"{path}.length", length
            for index in range(length):
                yield from self._value(types, kind, f"{path}[{index}]")

    def _value(self, types: Mapping[str, _Fields], kind: str, path: str) -> Iterator[tuple[str, Value]]:
        if kind in types:
            yield from self.struct(types, types[kind], f"{path}.")
        elif kind == "string":
            yield path, self._take(self._number("I")).decode(errors="backslashreplace").removesuffix("\0")
        else:
            yield path, self._number(_CODES[kind])

    def _number(self, code: str) -> int:
        size = struct.calcsize(code)
        self._position += -(self._position - 4) % size
        value: int = struct.unpack("<" + code, self._take(size))[0]
        return value

    def _take(self, size: int) -> bytes:
        start, self._position = self._position, self._position + size
        if self._position > len(self._data):
            raise ValueError(f"a message of {len(self._data)} bytes that ends within a field")
        return self._data[start : self._position]

    def end(self) -> None:
        """ValueError unless all was read."""
        if self._position != len(self._data):
            raise ValueError(f"a message with {len(self._data) - self._position} bytes too many")
