"""Messages of ROS 1 and ROS 2 as plain values, by the definitions that a bag carries.

`rosbags` parses the definitions; its own deserialisers, and those of others, are programs that are made of the
definition's text and run. A definition from a foreign file is data here: it becomes a chain of ready-made readers.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.base import make_typesdict
from rosbags.typesys.idl import IDLParser
from rosbags.typesys.msg import MSGParser
from rosbags.typesys.peg import Parser

from demorec.mcap.limits import Budget, Limits, SpentError

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


class Budgets:
    """What may be made of a bag's definitions and messages, whatever they claim: counted while it is made.

    Args:
        num_bytes: Of the bag's files.

    Attributes:
        steps: Of parsing definitions, some 7 microseconds each. The largest definition of ROS, with all that it refers
            to, takes 2,200 of them as .msg, and one of 300 fields 130,000 to 790,000 as .idl.
        values: Fields and elements, 100 to 300 bytes each in memory. A message of joints has 30, a list of 100,000
            points 400,000. Small files have a floor, 5 million, which are read in some seconds.
        numbers: Bytes of what streams keep of the messages.
    """

    def __init__(self, num_bytes: int = 0) -> None:
        floor = Limits.of_file(num_bytes).floor
        self.steps = Budget(floor // 56, 800_000, "parts of definitions")
        self.values = Budget(max(floor // 13, 12 * num_bytes), 500_000, "values")
        numbers = max(floor, 100 * num_bytes)
        self.numbers = Budget(numbers, numbers, "bytes of numbers")


def ros_decoder(
    type_name: str, schema_encoding: str, schema: bytes, *, is_cdr: bool, budgets: Budgets
) -> Callable[[bytes], Values]:
    """What makes values of the messages of a type.

    Args:
        type_name: "sensor_msgs/msg/JointState" (or as in ROS 1, without "msg").
        schema_encoding: ros2msg, ros2idl, ros1msg; "" for a type of ROS itself that comes without a definition.
        schema: The definition.
        is_cdr: Whether messages are CDR (ROS 2), otherwise as ROS 1 serialises them.
        budgets: What may be made of the bag.

    Raises:
        ValueError: The definition cannot be read; or, from the decoder, a message does not fit it, or holds too much.
    """
    parts = type_name.split("/")
    name = f"{parts[0]}/msg/{parts[1]}" if len(parts) == 2 else type_name
    budgets.steps.begin()
    types = _types(name, schema_encoding, schema, budgets.steps)
    if not is_cdr:
        read = _Builder(types, budgets.values, order="<", is_aligned=False).message(name)
        return lambda data: _whole(read, memoryview(data), budgets.values)
    readers = {
        number: _Builder(types, budgets.values, order=order, is_aligned=True).message(name)
        for number, order in enumerate("><")
    }

    def decode(data: bytes) -> Values:
        if len(data) < 4 or data[0] != 0 or data[1] not in readers:
            raise ValueError("its first bytes are not those of a CDR message")
        return _whole(readers[data[1]], memoryview(data)[4:], budgets.values)

    return decode


def _whole(read: _Reader, data: memoryview, budget: Budget) -> Values:
    budget.begin()
    try:
        values: Values = read(data, 0)[0]
    except struct.error:
        raise ValueError("it ends within a value") from None
    return values


class _Counted(Parser):  # type: ignore[misc]
    """Counts its steps: what takes long is no matter of a text's length alone."""

    def __init__(self, text: str, steps: Budget) -> None:
        super().__init__(text)
        self._steps = steps

    def regex(self, pos: int, pattern: str, flags: int = 0) -> Any:
        self._steps.take()
        return super().regex(pos, pattern, flags)


class _CountedMsgParser(_Counted, MSGParser):  # type: ignore[misc]
    pass


class _CountedIdlParser(_Counted, IDLParser):  # type: ignore[misc]
    def _binop(self, pos: int, left: Any, op: str, right: Any) -> Any:
        found = super()._binop(pos, left, op, right)
        if getattr(getattr(found, "value", None), "op", "") in ("*", "<<"):  # numbers without end
            raise ValueError("its definition computes numbers, which is not read")
        return found


def _from_msg(text: str, name: str, steps: Budget) -> Any:
    return make_typesdict(_CountedMsgParser(f"MSG: {name}\n{text}", steps).specification())


def _types(name: str, schema_encoding: str, schema: bytes, steps: Budget) -> Mapping[str, _Fields]:
    key = (name, schema_encoding, schema)
    if key not in _parsed:
        found = _parsed_types(name, schema_encoding, schema, steps)
        if len(_parsed) >= _MAX_PARSED:
            _parsed.clear()
        _parsed[key] = found
    return _parsed[key]


_MAX_PARSED = 512
_parsed: dict[tuple[str, str, bytes], Mapping[str, _Fields]] = {}
"""(type, encoding, definition) -> its types: a bag is read twice, and the next one has the same definitions."""


def _parsed_types(name: str, schema_encoding: str, schema: bytes, steps: Budget) -> Mapping[str, _Fields]:
    try:
        if "/srv/" in name:
            parsed = _service_event(name, schema.decode(), steps)
        elif schema_encoding in ("ros2msg", "ros1msg"):
            parsed = _from_msg(schema.decode(), name, steps)
        elif schema_encoding == "ros2idl":
            parsed = {}
            text = schema.decode()
            parts = [part.partition("\n")[2] for part in text.split(_SEPARATOR)[1:]] if _SEPARATOR in text else []
            for part in parts or [text]:
                parsed |= make_typesdict(_CountedIdlParser(part, steps).specification())
        elif not schema_encoding:
            parsed = dict(get_typestore(Stores.ROS2_HUMBLE).fielddefs)
        else:
            raise ValueError(f"its definition is in {schema_encoding[:40]!r}")
    except RecursionError:
        raise ValueError("its definition is nested too deeply") from None
    except (ValueError, MemoryError, SpentError):
        raise
    except Exception as error:  # the parser's own errors, and what it does not foresee
        raise ValueError("its definition cannot be read") from error
    types = {key: list(fields) for key, (_, fields) in parsed.items()}
    if name not in types:
        raise ValueError("it comes without a definition, and is no type of ROS itself")
    return types


def _service_event(name: str, text: str, steps: Budget) -> dict[str, Any]:
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
        types |= _from_msg(_SEPARATOR.join([f"{fields}\n", *others]), f"{package}/msg/{service}_{part}", steps)
    event_type = "service_msgs/ServiceEventInfo info\n" + "".join(
        f"{package}/{service}_{part}[<=1] {part.lower()}\n" for part in ("Request", "Response")
    )
    ((_, definition),) = _from_msg(event_type, f"{package}/msg/{event}", steps).items()
    known = get_typestore(Stores.ROS2_JAZZY).fielddefs
    info = "service_msgs/msg/ServiceEventInfo"
    return {**types, info: known[info], name: definition}


class _Builder:
    """Readers of some types, in one byte order and alignment: one for each type, however often it occurs."""

    def __init__(self, types: Mapping[str, _Fields], budget: Budget, *, order: str, is_aligned: bool) -> None:
        self._types = types
        self._budget = budget
        self._order = order
        self._is_aligned = is_aligned
        self._made: dict[str, tuple[_Reader, int]] = {}

    def message(self, name: str) -> _Reader:
        """That of a type; ValueError when it refers to one that is not defined, or to itself."""
        return self._message(name, 0)[0]

    def _message(self, name: str, depth: int) -> tuple[_Reader, int]:
        """The reader of a type that is so deep within others, and how deep others are within it."""
        found = self._made.get(name)
        if depth + (found[1] if found else 0) > _MAX_DEPTH:
            raise ValueError("its definition is nested too deeply")
        if found is None:
            found = self._made[name] = self._new(name, depth)
        return found

    def _new(self, name: str, depth: int) -> tuple[_Reader, int]:
        fields = self._types.get(name) or _BUILT_IN.get(name)
        if fields is None and name not in self._types:
            raise ValueError(f"its definition lacks the type {name[:80]!r}")
        parts = [(field, *self._field(description, depth)) for field, description in fields or ()]
        height = max((below for _, _, below in parts), default=0)
        readers = [(field, reader) for field, reader, _ in parts]
        take, count = self._budget.take, 1 + len(readers)
        if not readers and self._is_aligned:  # ROS 2 gives a type without fields a byte
            return lambda data, position: ({}, position + 1), height

        def read(data: memoryview, position: int) -> tuple[Values, int]:
            take(count)
            values = {}
            for field, read_field in readers:
                values[field], position = read_field(data, position)
            return values, position

        return read, height

    def _field(self, description: Any, depth: int) -> tuple[_Reader, int]:
        kind, rest = description
        if kind == Nodetype.BASE:
            return self._scalar(rest[0]), 0
        if kind == Nodetype.NAME:
            reader, height = self._message(rest, depth + 1)
            return reader, height + 1
        element, length = rest
        count = None if kind == Nodetype.SEQUENCE else length
        if element[0] == Nodetype.BASE and element[1][0] in _CODES:
            return self._numbers(element[1][0], count), 0
        reader, height = self._field(element, depth + 1)
        return self._list(reader, count), height + 1

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
        length_of, take = self._scalar("uint32"), self._budget.take

        def read(data: memoryview, position: int) -> tuple[list[Any], int]:
            number = count
            if number is None:
                number, position = length_of(data, position)
            if number > len(data) - position:  # each element takes a byte at least
                raise ValueError("a list reaches beyond its end")
            take(number)
            values = []
            for _ in range(number):
                value, position = read_element(data, position)
                values.append(value)
            return values, position

        return read
