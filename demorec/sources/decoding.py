"""Messages of any encoding as plain values: numbers, texts, NumPy arrays, lists and dictionaries of these.

`rosbags` parses the definitions of ROS 1 and ROS 2; its own deserialisers, and those of others, are programs that are
made of the definition's text and run. A definition from a foreign file is data here: it becomes a chain of ready-made
readers.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from graphlib import TopologicalSorter
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.base import make_typesdict
from rosbags.typesys.idl import IDLParser
from rosbags.typesys.msg import MSGParser
from rosbags.typesys.peg import Parser

from demorec.core.errors import describe_error
from demorec.core.plain import MAX_DEPTH, parse_json
from demorec.mcap.cdr import Readers, Values, lenient_text, read_whole
from demorec.mcap.limits import Budget, Limits, SpentError
from demorec.mcap.ros2 import FieldType, Types
from demorec.mcap.scan import ScannedChannel, ScannedMessage

_BYTES_OF_VALUE = 200
"""That are counted for each that is kept."""
_BYTES_PER_STEP = 8
"""Of a protobuf definition, which takes some twenty times its length in memory."""
_FEW_FIELDS, _MAX_FIELDS = 2_000_000, 4_000_000
"""Of a protobuf message, set or not: each takes 8 to 16 bytes before any is read. Fewer need no counting."""
_PACKED_BYTES = 8
"""Of numbers that are packed in a byte each, and take eight or sixteen: as many as a field that is not set."""
Decoder = Callable[[bytes], Values]
"""Bytes of a message to its values; ValueError when they do not fit its type."""


class UnknownEncodingError(ValueError):
    """Messages in an encoding, or of a definition, that cannot be read; `str` is the reason."""


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


class BagDecoder:
    """Decoders of a bag's channels, made when they are first needed.

    Args:
        num_bytes: Of the bag's files, by which grows what may be read of it.

    Attributes:
        budgets: What may still be made of it.
    """

    def __init__(self, num_bytes: int = 0) -> None:
        self.budgets = Budgets(num_bytes)
        self._decoders: dict[ScannedChannel, Decoder] = {}

    def values(self, message: ScannedMessage) -> Values:
        """Of a message.

        Raises:
            UnknownEncodingError: Its channel cannot be read at all.
            ValueError: The message does not fit its type.
        """
        decoder = self._decoders.get(message.channel)
        if decoder is None:
            try:
                decoder = self._decoder_of(message.channel)
            except ValueError as error:
                decoder = partial(_refuse, str(error))
            self._decoders[message.channel] = decoder
        return decoder(message.data)

    def _decoder_of(self, channel: ScannedChannel) -> Decoder:
        match channel.encoding:
            case "cdr" | "ros1":
                is_cdr = channel.encoding == "cdr"
                return _ros_decoder(
                    channel.type, channel.schema_encoding, channel.schema, is_cdr=is_cdr, budgets=self.budgets
                )
            case "protobuf":
                return _protobuf_decoder(channel.type, channel.schema, self.budgets)
            case "json":
                return partial(_decode_json, budget=self.budgets.values)
            case other:
                raise ValueError(f"the encoding {other[:40]!r} is not read; cdr, ros1, protobuf and json are")

    def may_keep(self, message: ScannedMessage) -> bool:
        """Whether the values that a message has just given are few enough to be kept beside those kept before."""
        used = self.budgets.values.used - self.budgets.values.begun
        try:
            self.budgets.numbers.take(len(message.data) + _BYTES_OF_VALUE * used)
        except SpentError:
            return False
        return True


def _refuse(reason: str, data: bytes) -> Values:
    raise UnknownEncodingError(reason)


def _decode_json(data: bytes, budget: Budget) -> Values:
    budget.begin()
    budget.take(data.count(b",") + data.count(b"[") + data.count(b"{"))  # before anything is built
    value = parse_json(data.decode(), allow_nan=True)
    if not isinstance(value, dict):
        raise ValueError("it is no JSON object")
    values: Values = _array_of(value)
    return values


def _array_of(value: Any) -> Any:
    """Lists of numbers as arrays, at any depth; texts without the halves of characters that cannot be written."""
    if isinstance(value, dict):
        return {_array_of(key): _array_of(item) for key, item in value.items()}
    if isinstance(value, str):
        return value if value.isascii() else value.encode(errors="replace").decode()
    if isinstance(value, list):
        if value and all(isinstance(item, int | float) and not isinstance(item, bool) for item in value):
            return np.array(value, dtype=np.float64)
        return [_array_of(item) for item in value]
    return value


def _protobuf_decoder(type_name: str, schema: bytes, budgets: Budgets) -> Decoder:
    from google.protobuf.descriptor_pb2 import FileDescriptorSet
    from google.protobuf.descriptor_pool import DescriptorPool
    from google.protobuf.message import DecodeError
    from google.protobuf.message_factory import GetMessageClass

    budgets.steps.begin()
    budgets.steps.take(len(schema) // _BYTES_PER_STEP)
    try:
        pool = DescriptorPool()
        files = {file.name: file for file in FileDescriptorSet.FromString(schema).file}
        for name in TopologicalSorter({name: file.dependency for name, file in files.items()}).static_order():
            if name in files:
                pool.Add(files[name])
        descriptor = pool.FindMessageTypeByName(type_name)
        message_class = GetMessageClass(descriptor)
    except (DecodeError, TypeError, KeyError, RecursionError, ValueError) as error:
        raise ValueError("its protobuf definition cannot be read") from error
    methods: Any = message_class.__mro__[1]  # a message's own fields may have the names of its methods
    size = _ProtobufSize(descriptor)

    def decode(data: bytes) -> Values:
        budgets.values.begin()
        size.check(data)
        message = message_class()
        try:
            methods.ParseFromString(message, data)
        except DecodeError as error:
            raise ValueError(describe_error(error)) from error
        return _protobuf_values(message, descriptor, methods, budgets.values)

    return decode


class _ProtobufSize:
    """Whether a message of a type takes little memory, found out before any is taken.

    An element of two bytes may be of a type with thousands of fields, and takes the memory of all of them.
    """

    def __init__(self, descriptor: Any) -> None:
        self._descriptor = descriptor
        self._kinds: dict[str, tuple[int, dict[int, Any]]] = {"": (0, {})}
        waiting = [descriptor]
        while waiting:
            kind = waiting.pop()
            if kind.full_name not in self._kinds:
                counted = [field for field in kind.fields if field.message_type is not None or _is_number_list(field)]
                within = {field.number: field.message_type for field in counted}
                self._kinds[kind.full_name] = (1 + len(kind.fields), within)
                waiting += filter(None, within.values())
        self._most = max(count for count, _ in self._kinds.values())

    def check(self, data: bytes) -> None:
        """Raise ValueError for a message of more fields than are read."""
        if len(data) * (1 + self._most) > _FEW_FIELDS and self._count(data) > _MAX_FIELDS:
            raise ValueError(f"it holds more than {_MAX_FIELDS:,} fields, set or not")

    def _count(self, data: bytes) -> int:
        """Fields of all messages in one, set or not; no more than needed is counted, and nothing damaged."""
        total, waiting = 0, [(self._descriptor.full_name, memoryview(data))]
        while waiting and total <= _MAX_FIELDS:
            name, part = waiting.pop()
            total += self._kinds[name][0]
            outer: list[str] = []
            position = 0
            while position < len(part) and total <= _MAX_FIELDS:
                key, position = _varint(part, position)
                kind = self._kinds[name][1].get(key >> 3)
                total += 1
                match key & 7:
                    case 0:
                        _, position = _varint(part, position)
                    case 1:
                        position += 8
                    case 2:
                        length, position = _varint(part, position)
                        if kind is not None:
                            waiting.append((kind.full_name, part[position : position + length]))
                        elif key >> 3 in self._kinds[name][1]:  # of numbers
                            total += length // _PACKED_BYTES
                        position += length
                    case 3:
                        outer.append(name)
                        name = "" if kind is None else kind.full_name
                        total += self._kinds[name][0]
                    case 4 if outer:
                        name = outer.pop()
                    case 5:
                        position += 4
                    case _:
                        return total  # the parser refuses it
        return total


def _is_number_list(field: Any) -> bool:
    return bool(field.is_repeated) and field.type not in (field.TYPE_STRING, field.TYPE_BYTES, field.TYPE_MESSAGE)


def _varint(data: memoryview, position: int) -> tuple[int, int]:
    value = 0
    for shift in range(0, 70, 7):
        if position >= len(data):
            break
        byte = data[position]
        position += 1
        value |= (byte & 127) << shift
        if byte < 128:
            break
    return value, position


def _protobuf_values(message: Any, descriptor: Any, methods: Any, budget: Budget, depth: int = 0) -> Values:
    if depth > MAX_DEPTH:
        raise ValueError("its values are nested too deeply")
    budget.take(1 + len(descriptor.fields))
    values: Values = {}
    for field in descriptor.fields:
        kind = field.message_type
        if field.is_repeated:
            found = getattr(message, field.name)
            if kind is None:
                dtype = {field.TYPE_FLOAT: "f4", field.TYPE_BOOL: "u1"}.get(field.type, "f8")
                is_list = _is_number_list(field)
                budget.take(0 if is_list else len(found))
                values[field.name] = np.fromiter(found, dtype, len(found)) if is_list else list(found)
            elif not kind.GetOptions().map_entry:  # maps hold no features
                values[field.name] = [_protobuf_values(item, kind, methods, budget, depth + 1) for item in found]
        elif kind is None:
            values[field.name] = getattr(message, field.name)
        elif methods.HasField(message, field.name):
            values[field.name] = _protobuf_values(getattr(message, field.name), kind, methods, budget, depth + 1)
    return values


_TIME = (FieldType("sec", "int32", False, None), FieldType("nanosec", "uint32", False, None))
_BUILT_IN = {"builtin_interfaces/msg/Time": _TIME, "builtin_interfaces/msg/Duration": _TIME}
_SEPARATOR = "=" * 80 + "\n"
"""Between the definitions of types that are in one text."""


def _ros_decoder(
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
    budget = budgets.values
    readers = [
        Readers(types, order=order, is_aligned=is_cdr, text=lenient_text, take=budget.take).of(name) for order in "><"
    ]

    def decode(data: bytes) -> Values:
        budget.begin()
        if not is_cdr:
            return read_whole(readers[1], memoryview(data))[0]
        if len(data) < 4 or data[0] != 0 or data[1] > 1:
            raise ValueError("its first bytes are not those of a CDR message")
        return read_whole(readers[data[1]], memoryview(data)[4:])[0]

    return decode


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


def _types(name: str, schema_encoding: str, schema: bytes, steps: Budget) -> Types:
    key = (name, schema_encoding, schema)
    if key not in _parsed:
        found = _parsed_types(name, schema_encoding, schema, steps)
        if len(_parsed) >= _MAX_PARSED:
            _parsed.clear()
        _parsed[key] = found
    return _parsed[key]


_MAX_PARSED = 512
_parsed: dict[tuple[str, str, bytes], Types] = {}
"""(type, encoding, definition) -> its types: a bag is read twice, and the next one has the same definitions."""


def _parsed_types(name: str, schema_encoding: str, schema: bytes, steps: Budget) -> Types:
    try:
        if schema_encoding in ("ros2msg", "ros1msg"):
            parsed = make_typesdict(_CountedMsgParser(f"MSG: {name}\n{schema.decode()}", steps).specification())
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
    if name not in parsed:
        raise ValueError("it comes without a definition, and is no type of ROS itself")
    found = {kind: tuple(_field_type(*field) for field in fields) for kind, (_, fields) in parsed.items()}
    return found | {kind: fields for kind, fields in _BUILT_IN.items() if not found.get(kind)}


def _field_type(name: str, description: Any) -> FieldType:
    """A field as the definitions of recordings have it; ValueError for lists of lists."""
    kind, rest = description
    if kind not in (Nodetype.SEQUENCE, Nodetype.ARRAY):
        return FieldType(name, rest[0] if kind == Nodetype.BASE else rest, False, None)
    (inner, of), length = rest
    if inner not in (Nodetype.BASE, Nodetype.NAME):
        raise ValueError("it has lists of lists, which are not read")
    return FieldType(name, of[0] if inner == Nodetype.BASE else of, True, length if kind == Nodetype.ARRAY else None)
