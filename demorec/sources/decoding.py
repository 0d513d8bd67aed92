"""Messages of any encoding as plain values: numbers, texts, NumPy arrays, lists and dictionaries of these."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from functools import partial
from typing import Any

import numpy as np

from demorec.core.errors import describe_error
from demorec.core.plain import MAX_DEPTH, parse_json
from demorec.mcap.cdr import Values
from demorec.mcap.limits import Budget, SpentError
from demorec.mcap.scan import ScannedChannel, ScannedMessage
from demorec.sources.ros_types import Budgets, ros_decoder

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


def decoder_of(channel: ScannedChannel, budgets: Budgets | None = None) -> Decoder:
    """What reads the messages of a channel, within the budgets; UnknownEncodingError says why nothing does."""
    budgets = budgets or Budgets()
    try:
        match channel.encoding:
            case "cdr" | "ros1":
                is_cdr = channel.encoding == "cdr"
                return ros_decoder(
                    channel.type, channel.schema_encoding, channel.schema, is_cdr=is_cdr, budgets=budgets
                )
            case "protobuf":
                return _protobuf_decoder(channel.type, channel.schema, budgets)
            case "json":
                return partial(_decode_json, budget=budgets.values)
            case other:
                raise ValueError(f"the encoding {other[:40]!r} is not read; cdr, ros1, protobuf and json are")
    except ValueError as error:
        raise UnknownEncodingError(str(error)) from error


class BagDecoder:
    """Decoders of a bag's channels, made when they are first needed.

    Args:
        num_bytes: Of the bag's files, by which grows what may be read of it.

    Attributes:
        budgets: What may still be made of it.
    """

    def __init__(self, num_bytes: int = 0) -> None:
        self.budgets = Budgets(num_bytes)
        self._decoders: dict[ScannedChannel, Decoder | UnknownEncodingError] = {}

    def values(self, message: ScannedMessage) -> Values:
        """Of a message.

        Raises:
            UnknownEncodingError: Its channel cannot be read at all.
            ValueError: The message does not fit its type.
        """
        decoder = self._decoders.get(message.channel)
        if decoder is None:
            try:
                decoder = decoder_of(message.channel, self.budgets)
            except UnknownEncodingError as error:
                decoder = error
            self._decoders[message.channel] = decoder
        if isinstance(decoder, UnknownEncodingError):
            raise UnknownEncodingError(str(decoder))
        return decoder(message.data)

    def may_keep(self, message: ScannedMessage) -> bool:
        """Whether the values that a message has just given are few enough to be kept beside those kept before."""
        used = self.budgets.values.used - self.budgets.values.begun
        try:
            self.budgets.numbers.take(len(message.data) + _BYTES_OF_VALUE * used)
        except SpentError:
            return False
        return True


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
        for file in _in_order(FileDescriptorSet.FromString(schema).file):
            pool.Add(file)
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


def _in_order(files: Iterable[Any]) -> Iterator[Any]:
    """Definitions behind those that they need."""
    waiting = {file.name: file for file in files}
    stack = list(waiting)
    opened: set[str] = set()
    while stack:
        name = stack[-1]
        needed = [other for other in waiting[name].dependency if other in waiting] if name in waiting else []
        if name in waiting and needed and name not in opened:
            opened.add(name)
            stack += needed
            continue
        stack.pop()
        if name in waiting:
            yield waiting.pop(name)


class _ProtobufSize:
    """Whether a message of a type takes little memory, found out before any is taken.

    An element of two bytes may be of a type with thousands of fields, and takes the memory of all of them.
    """

    def __init__(self, descriptor: Any) -> None:
        self._descriptor = descriptor
        self._kinds: dict[str, tuple[int, dict[int, Any]]] = {"": (0, {})}
        self._packed: set[tuple[str, int]] = set()
        waiting, largest = [descriptor], 0
        while waiting:
            kind = waiting.pop()
            if kind.full_name not in self._kinds:
                within = {field.number: field.message_type for field in kind.fields if field.message_type is not None}
                self._kinds[kind.full_name] = (1 + len(kind.fields), within)
                self._packed |= {(kind.full_name, field.number) for field in kind.fields if _is_number_list(field)}
                largest = max(largest, 1 + len(kind.fields))
                waiting += within.values()
        self._most = largest

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
                        elif (name, key >> 3) in self._packed:
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
                values[field.name] = _array_of_protobuf(found, field, budget)
            elif not kind.GetOptions().map_entry:  # maps hold no features
                values[field.name] = [_protobuf_values(item, kind, methods, budget, depth + 1) for item in found]
        elif kind is None:
            values[field.name] = getattr(message, field.name)
        elif methods.HasField(message, field.name):
            values[field.name] = _protobuf_values(getattr(message, field.name), kind, methods, budget, depth + 1)
    return values


def _array_of_protobuf(found: Any, field: Any, budget: Budget) -> Any:
    if not _is_number_list(field):
        budget.take(len(found))
        return list(found)
    dtype = {field.TYPE_FLOAT: "f4", field.TYPE_BOOL: "u1"}.get(field.type, "f8")
    return np.fromiter(found, dtype, len(found))
