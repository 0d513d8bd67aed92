"""Records of an MCAP file in their order, without its index, complete or truncated.

For recordings cut off by a crash, and for third-party bags.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import BinaryIO, NamedTuple

from mcap.opcode import Opcode
from mcap.records import Metadata

from demorec.mcap.scan import NO_SCHEMA, RECORD_HEAD, chunk_content, read_channel, read_record, read_schema, records_in

_MESSAGE_HEAD = struct.Struct("<HIQQ")
"""Channel, sequence number, time of recording and of publishing (MCAP specification, Message)."""
_IN_CHUNKS = (Opcode.MESSAGE, Opcode.SCHEMA, Opcode.CHANNEL)


class CutOffError(ValueError):
    """The file ends early; `str` describes where, as part of a sentence."""


@dataclass(frozen=True, kw_only=True)
class ScannedChannel:
    """Channel of one topic, type and encoding; a bag may have several channels for a topic."""

    topic: str
    type: str  # "sensor_msgs/msg/JointState"
    encoding: str  # of its messages: cdr, ros1, protobuf, json
    schema_encoding: str  # of the definition: ros2msg, ros2idl, ros1msg, protobuf, jsonschema; "" for none
    schema: bytes  # the definition: data, never code
    has_qos: bool = False  # whether it states a quality of service; in recordings only for latched topics


class ScannedMessage(NamedTuple):
    """A message as in the file, and its recording time, nanoseconds."""

    channel: ScannedChannel
    log_ns: int
    data: bytes


def scan(file: BinaryIO) -> Iterator[ScannedMessage | Metadata | None]:
    """Yield the messages and metadata of a file, open at its first record, in order, and None at the end of each chunk.

    CutOffError if the file ends early; Exception if a record is damaged, since the parsers' errors share no other base.
    """
    schemas = {0: NO_SCHEMA}
    channels: dict[int, ScannedChannel] = {}
    for opcode, data, start, end in _records(file):
        if opcode == Opcode.MESSAGE:
            channel, _, log_ns, _ = _MESSAGE_HEAD.unpack_from(data, start)
            yield ScannedMessage(channels[channel], log_ns, data[start + _MESSAGE_HEAD.size : end])
        elif opcode == Opcode.CHUNK:
            yield None
        elif opcode == Opcode.METADATA:
            yield read_record(data[start:end], Metadata)
        elif opcode == Opcode.SCHEMA:
            schema = read_schema(data[start:end])
            schemas[schema.id] = schema
        else:
            found = read_channel(data[start:end])
            schema = schemas[found.schema_id]
            channels[found.id] = ScannedChannel(
                topic=found.topic,
                type=schema.name,
                encoding=found.message_encoding,
                schema_encoding=schema.encoding,
                schema=schema.data,
                has_qos="offered_qos_profiles" in found.metadata,
            )


def _records(file: BinaryIO) -> Iterator[tuple[int, bytes, int, int]]:
    """Yield (opcode, data, start, end) of the records for `scan`, also inside chunks; an empty one ends a chunk."""
    size = os.fstat(file.fileno()).st_size
    while True:
        head = file.read(RECORD_HEAD.size)
        if len(head) < RECORD_HEAD.size:
            raise CutOffError("the end is missing")
        opcode, length = RECORD_HEAD.unpack(head)
        if length > size - file.tell():
            raise CutOffError("a record is cut off")
        if opcode in (Opcode.DATA_END, Opcode.FOOTER):
            return
        if opcode == Opcode.CHUNK:
            content = chunk_content(file.read(length))
            for inner, start, end in records_in(content):
                if inner in _IN_CHUNKS:
                    yield inner, content, start, end
            yield opcode, b"", 0, 0
        elif opcode in _IN_CHUNKS or opcode == Opcode.METADATA:
            yield opcode, file.read(length), 0, length
        else:
            file.seek(length, os.SEEK_CUR)
