"""Decode messages of any encoding to plain values: numbers, texts, NumPy arrays, and lists and dictionaries of these.

`rosbags` parses the definitions of ROS 1 and ROS 2; its own deserialisers, like others, are code generated from the
definition's text and executed. A definition from a foreign file is only data here: it becomes a chain of predefined
readers.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from graphlib import TopologicalSorter
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.base import make_typesdict
from rosbags.typesys.msg import MSGParser

from demorec.core.errors import describe_error
from demorec.core.plain import MAX_DEPTH, parse_json
from demorec.extensions.recovery.scan import ScannedChannel, ScannedMessage
from demorec.mcap.cdr import Readers, Values, read_whole
from demorec.mcap.ros2 import FieldType, Types

Decoder = Callable[[bytes], Values]
"""Converts a message's bytes to values; ValueError if they do not fit its type."""


class UnknownEncodingError(ValueError):
    """Messages with an unsupported encoding or definition; `str` is the reason."""


def decode_message(message: ScannedMessage) -> Values:
    """Decode a message.

    Raises:
        UnknownEncodingError: Its channel cannot be decoded.
        ValueError: The message does not fit its type.
    """
    return _decoder_of(message.channel)(message.data)


@lru_cache(maxsize=512)
def _decoder_of(channel: ScannedChannel) -> Decoder:
    try:
        match channel.encoding:
            case "cdr" | "ros1":
                is_cdr = channel.encoding == "cdr"
                return _ros_decoder(channel.type, channel.schema_encoding, channel.schema, is_cdr=is_cdr)
            case "protobuf":
                return _protobuf_decoder(channel.type, channel.schema)
            case "json":
                return _decode_json
            case other:
                raise ValueError(f"the encoding {other[:40]!r} is not supported; cdr, ros1, protobuf and json are")
    except ValueError as error:
        raise UnknownEncodingError(str(error)) from error


def _decode_json(data: bytes) -> Values:
    value = parse_json(data.decode(), allow_nan=True)
    if not isinstance(value, dict):
        raise ValueError("it is not a JSON object")
    values: Values = _array_of(value)
    return values


def _array_of(value: Any) -> Any:
    """Convert lists of numbers to arrays, at any depth, and remove lone surrogates from texts."""
    if isinstance(value, dict):
        return {_array_of(key): _array_of(item) for key, item in value.items()}
    if isinstance(value, str):
        return value if value.isascii() else value.encode(errors="replace").decode()
    if isinstance(value, list):
        if value and all(isinstance(item, int | float) and not isinstance(item, bool) for item in value):
            return np.array(value, dtype=np.float64)
        return [_array_of(item) for item in value]
    return value


def _protobuf_decoder(type_name: str, schema: bytes) -> Decoder:
    from google.protobuf.descriptor_pb2 import FileDescriptorSet
    from google.protobuf.descriptor_pool import DescriptorPool
    from google.protobuf.message import DecodeError
    from google.protobuf.message_factory import GetMessageClass

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
    methods: Any = message_class.__mro__[1]  # a message's own fields may shadow its methods

    def decode(data: bytes) -> Values:
        message = message_class()
        try:
            methods.ParseFromString(message, data)
        except DecodeError as error:
            raise ValueError(describe_error(error)) from error
        return _protobuf_values(message, descriptor, methods)

    return decode


def _protobuf_values(message: Any, descriptor: Any, methods: Any, depth: int = 0) -> Values:
    if depth > MAX_DEPTH:
        raise ValueError("its values are nested too deeply")
    values: Values = {}
    for field in descriptor.fields:
        kind = field.message_type
        if field.is_repeated:
            found = getattr(message, field.name)
            if kind is None:
                dtype = {field.TYPE_FLOAT: "f4", field.TYPE_BOOL: "u1"}.get(field.type, "f8")
                are_numbers = field.type not in (field.TYPE_STRING, field.TYPE_BYTES)
                values[field.name] = np.fromiter(found, dtype, len(found)) if are_numbers else list(found)
            elif not kind.GetOptions().map_entry:  # maps hold no features
                values[field.name] = [_protobuf_values(item, kind, methods, depth + 1) for item in found]
        elif kind is None:
            values[field.name] = getattr(message, field.name)
        elif methods.HasField(message, field.name):
            values[field.name] = _protobuf_values(getattr(message, field.name), kind, methods, depth + 1)
    return values


_TIME = (FieldType("sec", "int32", False, None), FieldType("nanosec", "uint32", False, None))
_BUILT_IN = {"builtin_interfaces/msg/Time": _TIME, "builtin_interfaces/msg/Duration": _TIME}


def _ros_decoder(type_name: str, schema_encoding: str, schema: bytes, *, is_cdr: bool) -> Decoder:
    """Make the decoder of a type's messages, CDR (ROS 2) or serialised by ROS 1; both raise ValueError."""
    parts = type_name.split("/")
    name = f"{parts[0]}/msg/{parts[1]}" if len(parts) == 2 else type_name
    types = _types(name, schema_encoding, schema)
    readers = [Readers(types, order=order, is_aligned=is_cdr).of(name) for order in "><"]

    def decode(data: bytes) -> Values:
        if not is_cdr:
            return read_whole(readers[1], memoryview(data))[0]
        if len(data) < 4 or data[0] != 0 or data[1] > 1:
            raise ValueError("its first bytes are not those of a CDR message")
        return read_whole(readers[data[1]], memoryview(data)[4:])[0]

    return decode


def _types(name: str, schema_encoding: str, schema: bytes) -> Types:
    """Fields of a type and of all types that it refers to."""
    try:
        if schema_encoding in ("ros2msg", "ros1msg"):
            parsed = make_typesdict(MSGParser(f"MSG: {name}\n{schema.decode()}").specification())
        elif not schema_encoding:
            parsed = dict(get_typestore(Stores.ROS2_HUMBLE).fielddefs)
        else:
            raise ValueError(f"its definition is in {schema_encoding[:40]!r}")
    except RecursionError:
        raise ValueError("its definition is nested too deeply") from None
    except (ValueError, MemoryError):
        raise
    except Exception as error:  # the parser's own errors, and unforeseen ones
        raise ValueError("its definition cannot be read") from error
    if name not in parsed:
        raise ValueError("it has no definition, and is not a standard ROS type")
    found = {kind: tuple(_field_type(*field) for field in fields) for kind, (_, fields) in parsed.items()}
    return found | {kind: fields for kind, fields in _BUILT_IN.items() if not found.get(kind)}


def _field_type(name: str, description: Any) -> FieldType:
    """Convert a field to recordings' form; ValueError for lists of lists."""
    kind, rest = description
    if kind not in (Nodetype.SEQUENCE, Nodetype.ARRAY):
        return FieldType(name, rest[0] if kind == Nodetype.BASE else rest, False, None)
    (inner, of), length = rest
    if inner not in (Nodetype.BASE, Nodetype.NAME):
        raise ValueError("it has lists of lists, which are not supported")
    return FieldType(name, of[0] if inner == Nodetype.BASE else of, True, length if kind == Nodetype.ARRAY else None)
