"""An MCAP file read from its front to its end, without its index, whole or cut off.

So are bags read, which others wrote, and what a crash left of a recording.
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
"""Of messages without one."""


class CutOffError(ValueError):
    """The file ends before its end; `str` says where, for the inside of a sentence."""


@dataclass(frozen=True, kw_only=True)
class ScannedChannel:
    """Messages of one topic, type and encoding; a bag may have several channels of a topic.

    Attributes:
        topic: "/joint_states".
        type: "sensor_msgs/msg/JointState", "foxglove.CompressedImage".
        encoding: Of its messages: cdr, ros1, protobuf, json.
        schema_encoding: Of the definition: ros2msg, ros2idl, ros1msg, protobuf, jsonschema; "" for none.
        schema: The definition: data, never code.
        has_qos: Whether it says with which quality of service it was published; of ours only what is said once does.
    """

    topic: str
    type: str
    encoding: str
    schema_encoding: str
    schema: bytes
    has_qos: bool = False


class ScannedMessage(NamedTuple):
    """A message as the file has it, and when it was recorded, nanoseconds."""

    channel: ScannedChannel
    log_ns: int
    data: bytes


def read_record[R: McapRecord](content: bytes | memoryview, kind: type[R]) -> R:
    """A record of a kind, from its content."""
    record: R = kind.read(ReadDataStream(BytesIO(content)))
    return record


# These are the same bytes in every recording of a run, and an export opens many.
@lru_cache(maxsize=1024)
def read_channel(content: bytes) -> Channel:
    """A Channel record."""
    return read_record(content, Channel)


@lru_cache(maxsize=256)
def read_schema(content: bytes) -> Schema:
    """A Schema record."""
    return read_record(content, Schema)


def scan(file: BinaryIO) -> Iterator[ScannedMessage | Metadata | None]:
    """What a file holds: messages and metadata in its order, and None at the end of each chunk.

    Args:
        file: At its first record.

    Raises:
        CutOffError: It ends before its end.
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
    """(opcode, data, start, end) of the records that `scan` reads, in chunks too; an empty one ends a chunk's."""
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
