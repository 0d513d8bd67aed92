"""Messages of ROS 1 and ROS 2 as plain values, by the definitions that a bag carries.

`rosbags` parses the definitions; its own deserialisers, and those of others, are programs that are made of the
definition's text and run. A definition from a foreign file is data here: it becomes a chain of ready-made readers.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

Values = dict[str, Any]
"""Field -> number, text, NumPy array (numbers), list (texts, messages) or Values."""
_Reader = Callable[[memoryview, int], tuple[Any, int]]
_Fields = list[tuple[str, Any]]

_MAX_DEPTH = 32
_CODES = {
    "bool": "?", "byte": "B", "char": "B", "int8": "b", "uint8": "B", "int16": "h", "uint16": "H", "int32": "i",
    "uint32": "I", "int64": "q", "uint64": "Q", "float32": "f", "float64": "d",
}  # fmt: skip
_TIME: _Fields = [
    ("sec", (Nodetype.BASE, ("int32", 0))),
    ("nanosec", (Nodetype.BASE, ("uint32", 0))),
]
_BUILT_IN = {"builtin_interfaces/msg/Time": _TIME, "builtin_interfaces/msg/Duration": _TIME}
_SEPARATOR = "=" * 80 + "\n"
"""Between the definitions of types that are in one text."""


def ros_decoder(type_name: str, schema_encoding: str, schema: bytes, *, is_cdr: bool) -> Callable[[bytes], Values]:
    """What makes values of the messages of a type.

    Args:
        type_name: "sensor_msgs/msg/JointState" (or as in ROS 1, without "msg").
        schema_encoding: ros2msg, ros2idl, ros1msg; "" for a type of ROS itself that comes without a definition.
        schema: The definition.
        is_cdr: Whether messages are CDR (ROS 2), otherwise as ROS 1 serialises them.

    Raises:
        ValueError: The definition cannot be read; or, from the decoder, a message does not fit it.
    """
    parts = type_name.split("/")
    name = f"{parts[0]}/msg/{parts[1]}" if len(parts) == 2 else type_name
    types = _types(name, schema_encoding, schema)
    if not is_cdr:
        read = _Builder(types, order="<", is_aligned=False).message(name)
        return lambda data: _whole(read, memoryview(data))
    readers = {
        0: _Builder(types, order=">", is_aligned=True).message(name),
        1: _Builder(types, order="<", is_aligned=True).message(name),
    }

    def decode(data: bytes) -> Values:
        if len(data) < 4 or data[0] != 0 or data[1] not in readers:
            raise ValueError("its first bytes are not those of a CDR message")
        return _whole(readers[data[1]], memoryview(data)[4:])

    return decode


def _whole(read: _Reader, data: memoryview) -> Values:
    try:
        values: Values = read(data, 0)[0]
    except struct.error:
        raise ValueError("it ends within a value") from None
    return values


@lru_cache(maxsize=512)
def _types(name: str, schema_encoding: str, schema: bytes) -> Mapping[str, _Fields]:
    try:
        if "/srv/" in name:
            parsed = _service_event(name, schema.decode())
        elif schema_encoding in ("ros2msg", "ros1msg"):
            parsed = get_types_from_msg(schema.decode(), name)
        elif schema_encoding == "ros2idl":
            parsed = {}
            text = schema.decode()
            parts = [part.split("\n", 1)[1] for part in text.split(_SEPARATOR)[1:]] if _SEPARATOR in text else []
            for part in parts or [text]:
                parsed |= get_types_from_idl(part)
        elif not schema_encoding:
            parsed = dict(get_typestore(Stores.ROS2_HUMBLE).fielddefs)
        else:
            raise ValueError(f"its definition is in {schema_encoding[:40]!r}")
    except RecursionError:
        raise ValueError("its definition is nested too deeply") from None
    except ValueError:
        raise
    except Exception as error:  # the parser's own errors, and what it does not foresee
        raise ValueError("its definition cannot be read") from error
    types = {key: list(fields) for key, (_, fields) in parsed.items()}
    if name not in types:
        raise ValueError("it comes without a definition, and is no type of ROS itself")
    return types


def _service_event(name: str, text: str) -> dict[str, Any]:
    """The types of a service's events: rosbag2 writes the definition of the service, from which they follow.

    It has a line of "=", "SRV: " and the name in front, and requests and responses apart by "---".
    """
    package, _, event = name.split("/", 2)
    service = event.removesuffix("_Event")
    if not text.strip():
        raise ValueError(f"it comes without the definition of the service {package}/srv/{service}")
    first, *others = [part for part in text.split(_SEPARATOR) if part.strip()]
    head, _, body = first.partition("\n")
    if event == service or head.strip() != f"SRV: {package}/srv/{service}":
        raise ValueError(f"its definition is not that of the service {package}/srv/{service}")
    request, _, response = f"\n{body}".partition("\n---")
    types: dict[str, Any] = {}
    for part, fields in (("Request", request), ("Response", response)):
        types |= get_types_from_msg(_SEPARATOR.join([f"{fields}\n", *others]), f"{package}/msg/{service}_{part}")
    event_type = "service_msgs/ServiceEventInfo info\n" + "".join(
        f"{package}/{service}_{part}[<=1] {part.lower()}\n" for part in ("Request", "Response")
    )
    ((_, definition),) = get_types_from_msg(event_type, f"{package}/msg/{event}").items()
    known = get_typestore(Stores.ROS2_JAZZY).fielddefs
    info = "service_msgs/msg/ServiceEventInfo"
    return {**types, info: known[info], name: definition}


class _Builder:
    """Readers of the fields of some types, in one byte order and alignment."""

    def __init__(self, types: Mapping[str, _Fields], *, order: str, is_aligned: bool) -> None:
        self._types = types
        self._order = order
        self._is_aligned = is_aligned

    def message(self, name: str, depth: int = 0) -> _Reader:
        """That of a type; ValueError when it refers to one that is not defined, or to itself."""
        fields = self._types.get(name) or _BUILT_IN.get(name)
        if fields is None and name not in self._types:
            raise ValueError(f"its definition lacks the type {name[:80]!r}")
        if depth > _MAX_DEPTH:
            raise ValueError("its definition is nested too deeply")
        readers = [(field, self._field(description, depth)) for field, description in fields or ()]
        if not readers and self._is_aligned:  # ROS 2 gives a type without fields a byte
            return lambda data, position: ({}, position + 1)

        def read(data: memoryview, position: int) -> tuple[Values, int]:
            values = {}
            for field, read_field in readers:
                values[field], position = read_field(data, position)
            return values, position

        return read

    def _field(self, description: Any, depth: int) -> _Reader:
        kind, rest = description
        if kind == Nodetype.BASE:
            return self._scalar(rest[0])
        if kind == Nodetype.NAME:
            return self.message(rest, depth + 1)
        element, length = rest
        count = None if kind == Nodetype.SEQUENCE else length
        if element[0] == Nodetype.BASE and element[1][0] in _CODES:
            return self._numbers(element[1][0], count)
        return self._list(self._field(element, depth + 1), count)

    def _scalar(self, name: str) -> _Reader:
        if name == "string":
            return self._text()
        if name not in _CODES:
            raise ValueError(f"it has a field of the type {name}, which is not read")
        number = struct.Struct(self._order + _CODES[name])
        size, unpack = number.size, number.unpack_from
        if not self._is_aligned or size == 1:
            return lambda data, position: (unpack(data, position)[0], position + size)
        mask = size - 1

        def read(data: memoryview, position: int) -> tuple[Any, int]:
            position = (position + mask) & ~mask
            return unpack(data, position)[0], position + size

        return read

    def _text(self) -> _Reader:
        length_of, ends_with_nul = self._scalar("uint32"), self._is_aligned

        def read(data: memoryview, position: int) -> tuple[str, int]:
            length, position = length_of(data, position)
            end = position + length
            if end > len(data):
                raise ValueError("a text reaches beyond its end")
            last = end - 1 if ends_with_nul and length else end
            return bytes(data[position:last]).decode(errors="replace"), end

        return read

    def _numbers(self, name: str, count: int | None) -> _Reader:
        dtype = np.dtype(self._order + ("B" if name == "bool" else _CODES[name]))
        size = dtype.itemsize
        mask = size - 1 if self._is_aligned else 0
        length_of = self._scalar("uint32")

        def read(data: memoryview, position: int) -> tuple[Any, int]:
            number = count
            if number is None:
                number, position = length_of(data, position)
            if number == 0:
                return np.empty(0, dtype), position
            position = (position + mask) & ~mask
            end = position + number * size
            if end > len(data):
                raise ValueError("an array reaches beyond its end")
            return np.frombuffer(data, dtype, number, position), end

        return read

    def _list(self, read_element: _Reader, count: int | None) -> _Reader:
        length_of = self._scalar("uint32")

        def read(data: memoryview, position: int) -> tuple[list[Any], int]:
            number = count
            if number is None:
                number, position = length_of(data, position)
            if number > len(data) - position:  # each element takes a byte at least
                raise ValueError("a list reaches beyond its end")
            values = []
            for _ in range(number):
                value, position = read_element(data, position)
                values.append(value)
            return values, position

        return read
