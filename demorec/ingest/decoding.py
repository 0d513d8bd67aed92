"""Messages of any encoding as plain values: numbers, texts, NumPy arrays, lists and dictionaries of these."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from demorec.errors import in_words
from demorec.ingest.channel import BagChannel
from demorec.ingest.ros_types import Values, ros_decoder
from demorec.plain import MAX_DEPTH, parse_json

Decoder = Callable[[bytes], Values]
"""Bytes of a message to its values; ValueError when they do not fit its type."""


class UnknownEncodingError(ValueError):
    """Messages in an encoding, or of a definition, that cannot be read; `str` is the reason."""


def decoder_of(channel: BagChannel) -> Decoder:
    """What reads the messages of a channel; UnknownEncodingError says why nothing does."""
    try:
        match channel.encoding:
            case "cdr" | "ros1":
                is_cdr = channel.encoding == "cdr"
                return ros_decoder(channel.type, channel.schema_encoding, channel.schema, is_cdr=is_cdr)
            case "protobuf":
                return _protobuf_decoder(channel.type, channel.schema)
            case "json":
                return _decode_json
            case other:
                raise ValueError(f"the encoding {other[:40]!r} is not read; cdr, ros1, protobuf and json are")
    except ValueError as error:
        raise UnknownEncodingError(str(error)) from error


def _decode_json(data: bytes) -> Values:
    value = parse_json(data.decode(), allow_nan=True)
    if not isinstance(value, dict):
        raise ValueError("it is no JSON object")
    return {key: _array_of(item) for key, item in value.items()}


def _array_of(value: Any) -> Any:
    """Lists of numbers as arrays, at any depth."""
    if isinstance(value, dict):
        return {key: _array_of(item) for key, item in value.items()}
    if isinstance(value, list):
        if value and all(isinstance(item, int | float) and not isinstance(item, bool) for item in value):
            return np.array(value, dtype=np.float64)
        return [_array_of(item) for item in value]
    return value


def _protobuf_decoder(type_name: str, schema: bytes) -> Decoder:
    from google.protobuf.descriptor_pb2 import FileDescriptorSet
    from google.protobuf.descriptor_pool import DescriptorPool
    from google.protobuf.message import DecodeError
    from google.protobuf.message_factory import GetMessageClass, GetMessages

    try:
        pool = DescriptorPool()
        GetMessages(FileDescriptorSet.FromString(schema).file, pool)  # adds each file behind those that it needs
        message_class = GetMessageClass(pool.FindMessageTypeByName(type_name))
    except (DecodeError, TypeError, KeyError, RecursionError, ValueError) as error:
        raise ValueError("its protobuf definition cannot be read") from error

    def decode(data: bytes) -> Values:
        try:
            return _protobuf_values(message_class.FromString(data), 0)
        except DecodeError as error:
            raise ValueError(in_words(error)) from error

    return decode


def _protobuf_values(message: Any, depth: int) -> Values:
    if depth > MAX_DEPTH:
        raise ValueError("its values are nested too deeply")
    values: Values = {}
    for field in message.DESCRIPTOR.fields:
        is_message = field.message_type is not None
        if field.is_repeated:
            found = getattr(message, field.name)
            if is_message and field.message_type.GetOptions().map_entry:
                continue  # maps hold no features
            if is_message:
                values[field.name] = [_protobuf_values(item, depth + 1) for item in found]
            else:
                items = list(found)
                is_number = all(isinstance(item, int | float) for item in items)
                dtype = {field.TYPE_FLOAT: "f4", field.TYPE_BOOL: "u1"}.get(field.type, "f8")
                values[field.name] = np.array(items, dtype=dtype) if is_number else items
        elif is_message:
            if message.HasField(field.name):
                values[field.name] = _protobuf_values(getattr(message, field.name), depth + 1)
        else:
            values[field.name] = getattr(message, field.name)
    return values
