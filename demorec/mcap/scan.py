"""An MCAP file read from its front to its end, without its index: in bounded memory and time, whole or cut off.

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

from demorec.mcap.chunks import MAX_RECORD_BYTES, RECORD_HEAD, chunk_content, records_in
from demorec.mcap.limits import Unpacked

MAX_METADATA_BYTES = 4 << 20
"""Of a metadata record: ours have some 20 kB."""
MAX_SCHEMA_BYTES = 1 << 20
"""Of a message type's definition; the largest of ROS with all that it refers to have some 30 kB."""
MAX_CHANNELS = 4096
"""Of a file; large systems have some hundred topics."""
MESSAGE_HEAD = struct.Struct("<HIQQ")
"""Channel, sequence number, time of recording and of publishing (MCAP specification, Message)."""
_READ = frozenset((Opcode.METADATA, Opcode.SCHEMA, Opcode.CHANNEL, Opcode.CHUNK, Opcode.MESSAGE))


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
    """A message as the file has it.

    Attributes:
        channel: Of which topic and type it is.
        log_ns: When it was recorded, nanoseconds.
        data: Its bytes.
    """

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


def scan(file: BinaryIO, unpacked: Unpacked) -> Iterator[ScannedMessage | Metadata | None]:
    """What a file holds: messages and metadata in its order, and None at the end of each chunk.

    Args:
        file: At its first record.
        unpacked: What has been unpacked until now.

    Raises:
        CutOffError: It ends before its end.
        LimitError: It would unpack to more than is allowed.
        Exception: A record is damaged; the parsers' own errors share no other base class.
    """
    size = os.fstat(file.fileno()).st_size
    records = _Records(unpacked)
    while True:
        head = file.read(RECORD_HEAD.size)
        if len(head) < RECORD_HEAD.size:
            raise CutOffError("the end is missing")
        opcode, length = RECORD_HEAD.unpack(head)
        if length > min(size - file.tell(), MAX_RECORD_BYTES):
            raise CutOffError("a record is cut off")
        if opcode in (Opcode.DATA_END, Opcode.FOOTER):
            return
        if opcode not in _READ or (opcode == Opcode.METADATA and length > MAX_METADATA_BYTES):
            file.seek(length, os.SEEK_CUR)
        elif opcode == Opcode.METADATA:
            yield read_record(file.read(length), Metadata)
        elif opcode == Opcode.CHUNK:
            yield from records.in_chunk(file.read(length))
            yield None
        elif (message := records.read(opcode, file.read(length))) is not None:
            yield message


class _Records:
    """What has been learnt from the records so far."""

    def __init__(self, unpacked: Unpacked) -> None:
        self._unpacked = unpacked
        self._schemas = {0: Schema(id=0, name="", encoding="", data=b"")}
        self._channels: dict[int, ScannedChannel] = {}

    def read(self, opcode: int, content: bytes) -> ScannedMessage | None:
        """The message in a record; None for one that says what messages are."""
        if opcode == Opcode.MESSAGE:
            channel, _, log_ns, _ = MESSAGE_HEAD.unpack_from(content)
            return ScannedMessage(self._channels[channel], log_ns, content[MESSAGE_HEAD.size :])
        if opcode == Opcode.SCHEMA:
            schema = read_schema(content)
            if len(schema.data) > MAX_SCHEMA_BYTES:
                raise ValueError(f"the definition of {schema.name[:80]!r} has {len(schema.data):,} bytes")
            self._schemas[schema.id] = schema
        else:
            found = read_channel(content)
            if found.id not in self._channels and len(self._channels) >= MAX_CHANNELS:
                raise ValueError("too many channels")
            schema = self._schemas[found.schema_id]
            self._channels[found.id] = ScannedChannel(
                topic=found.topic,
                type=schema.name,
                encoding=found.message_encoding,
                schema_encoding=schema.encoding,
                schema=schema.data,
                has_qos="offered_qos_profiles" in found.metadata,
            )
        return None

    def in_chunk(self, content: bytes) -> Iterator[ScannedMessage]:
        """The messages in a chunk."""
        unpacked = chunk_content(content, self._unpacked.limits)
        self._unpacked.add(len(unpacked))
        count = 0
        for opcode, start, end in records_in(unpacked):
            count += 1
            if opcode == Opcode.MESSAGE:
                channel, _, log_ns, _ = MESSAGE_HEAD.unpack_from(unpacked, start)
                yield ScannedMessage(self._channels[channel], log_ns, unpacked[start + MESSAGE_HEAD.size : end])
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self.read(opcode, unpacked[start:end])
        self._unpacked.add(0, count)
