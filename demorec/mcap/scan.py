"""Sequential reading of an MCAP file, without its index, complete or truncated.

Used for third-party bags, and for recordings cut off by a crash.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from io import BytesIO
from typing import BinaryIO, NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, McapRecord, Metadata, Schema

from demorec.mcap.chunks import RECORD_HEAD, chunk_content, records_in

MESSAGE_HEAD = struct.Struct("<HIQQ")
"""Channel, sequence number, time of recording and of publishing (MCAP specification, Message)."""
_IN_CHUNKS = (Opcode.MESSAGE, Opcode.SCHEMA, Opcode.CHANNEL)
NO_SCHEMA = Schema(id=0, name="", encoding="", data=b"")
"""Schema of messages without one."""


class CutOffError(ValueError):
    """The file ends early; `str` describes where, as part of a sentence."""


@dataclass(frozen=True, kw_only=True)
class ScannedChannel:
    """Channel of one topic, type and encoding; a bag may have several channels for a topic.

    Attributes:
        topic: "/joint_states".
        type: "sensor_msgs/msg/JointState", "foxglove.CompressedImage".
        encoding: Encoding of its messages: cdr, ros1, protobuf, json.
        schema_encoding: Encoding of the definition: ros2msg, ros2idl, ros1msg, protobuf, jsonschema; "" for none.
        schema: The definition: data, never code.
        has_qos: Whether it states a quality of service; in recordings only for latched topics.
    """

    topic: str
    type: str
    encoding: str
    schema_encoding: str
    schema: bytes
    has_qos: bool = False


class ScannedMessage(NamedTuple):
    """A message as in the file, and its recording time, nanoseconds."""

    channel: ScannedChannel
    log_ns: int
    data: bytes


def read_record[R: McapRecord](content: bytes | memoryview, kind: type[R]) -> R:
    """Parse a record of a kind from its content."""
    record: R = kind.read(ReadDataStream(BytesIO(content)))
    return record


# These bytes are the same in every recording of a run, and an export opens many.
@lru_cache(maxsize=1024)
def read_channel(content: bytes) -> Channel:
    """Parse a Channel record."""
    return read_record(content, Channel)


@lru_cache(maxsize=256)
def read_schema(content: bytes) -> Schema:
    """Parse a Schema record."""
    return read_record(content, Schema)


def scan(file: BinaryIO) -> Iterator[ScannedMessage | Metadata | None]:
    """Yield the messages and metadata of a file in order, and None at the end of each chunk.

    Args:
        file: Positioned at its first record.

    Raises:
        CutOffError: The file ends early.
        Exception: A record is damaged; the parsers' own errors share no other base class.
    """
    schemas = {0: NO_SCHEMA}
    channels: dict[int, ScannedChannel] = {}
    for opcode, data, start, end in _records(file):
        if opcode == Opcode.MESSAGE:
            channel, _, log_ns, _ = MESSAGE_HEAD.unpack_from(data, start)
            yield ScannedMessage(channels[channel], log_ns, data[start + MESSAGE_HEAD.size : end])
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
