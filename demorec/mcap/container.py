"""Random access to an MCAP file that trusts nothing: every byte that is used was covered by a checksum, where its
writer left one (0 stands for none), and nothing unpacks to more than `Limits` allows.

The summary at the end states where each chunk is and which topics it holds, so one topic is read without touching the
others, one chunk at a time. The mcap library parses the records; what this adds is the checking, and one error.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO, NamedTuple

from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Footer,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)

from demorec.core.errors import DemorecError, RecordingError, ResourceError, describe_error, resource_error
from demorec.core.files import open_regular
from demorec.mcap.chunks import MAX_RECORD_BYTES, RECORD_HEAD, Block, ChunkPlace, blocks_of, chunk_content, records_in
from demorec.mcap.limits import LimitError, Limits
from demorec.mcap.scan import MAX_METADATA_BYTES, MESSAGE_HEAD, read_channel, read_record, read_schema

MAGIC = b"\x89MCAP0\r\n"
_FOOTER_BYTES = RECORD_HEAD.size + 20


class Message(NamedTuple):
    """One message: its topic, time and bytes."""

    topic: str
    time_ns: int
    data: bytes


@contextmanager
def damage_as_recording_error(path: Path) -> Iterator[None]:
    """Turn whatever a parser of damaged bytes raises into RecordingError, and a lack of memory into ResourceError."""
    try:
        yield
    except (RecordingError, ResourceError):
        raise
    except LimitError as error:
        raise RecordingError(f"The recording is not read, {error}: {path}") from error
    except (OSError, MemoryError, ValueError, KeyError, IndexError, OverflowError, EOFError, struct.error) as error:
        raise _damage(error, path) from error
    except Exception as error:
        # The parsers' own errors (mcap, zstandard) share no base class but Exception.
        if type(error).__module__.split(".")[0] not in ("mcap", "zstandard", "zstd", "builtins"):
            raise
        raise _damage(error, path) from error


def _damage(error: BaseException, path: Path) -> DemorecError:
    if "not enough memory" in str(error):  # zstandard has no error of its own for that
        error = MemoryError()
    return resource_error(error, path) or RecordingError(f"The recording is damaged ({describe_error(error)}): {path}")


class Container:
    """An open MCAP file.

    Attributes:
        channels: topic -> channel.
        counts: topic -> number of messages.

    Raises:
        RecordingError: No such file, no MCAP, cut off, or a checksum that does not match.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self._file: BinaryIO = open_regular(path)
        except OSError as error:
            unreadable = RecordingError(f"The recording cannot be read ({error.strerror}): {path}")
            raise resource_error(error, path) or unreadable from error
        try:
            with damage_as_recording_error(path):
                self._read_summary()
        except BaseException:
            self._file.close()
            raise

    def close(self) -> None:
        """Close the file; harmless when called twice."""
        self._file.close()

    def _read_summary(self) -> None:
        size = self._file.seek(0, 2)
        self._limits = Limits.of_file(size)
        if size == 0:
            raise RecordingError(f"The file is empty, so no recording: {self.path}")
        if self._read_at(0, min(size, len(MAGIC))) != MAGIC:
            raise RecordingError(f"The file is no MCAP file, so no recording: {self.path}")
        tail_bytes = _FOOTER_BYTES + len(MAGIC)
        if size < tail_bytes + len(MAGIC) or self._read_at(size - len(MAGIC), len(MAGIC)) != MAGIC:
            raise RecordingError(
                f"The recording is cut off, its index is missing; demorec recover keeps what is whole: {self.path}"
            )
        footer_start = size - tail_bytes
        footer = self._record_at(footer_start, _FOOTER_BYTES, Opcode.FOOTER, Footer)
        if not len(MAGIC) <= footer.summary_start < footer_start:
            raise RecordingError(f"The recording is damaged or has no index: {self.path}")
        # The checksum covers the summary and the footer up to the checksum itself.
        summary = self._read_at(footer.summary_start, footer_start - footer.summary_start + _FOOTER_BYTES - 4)
        if footer.summary_crc and zlib.crc32(summary) != footer.summary_crc:
            raise RecordingError(f"The recording is damaged: the checksum of its index does not match: {self.path}")
        self._parse_summary(summary[: footer_start - footer.summary_start])

    def _parse_summary(self, summary: bytes) -> None:
        channels: dict[int, Channel] = {}
        self.schemas = {0: Schema(id=0, name="", encoding="", data=b"")}  # 0: messages without one
        self._chunks: list[ChunkPlace] = []
        self._metadata: dict[str, MetadataIndex] = {}
        self._attachments: dict[str, AttachmentIndex] = {}
        counts: dict[int, int] = {}
        for opcode, start, end in records_in(summary, "the file's index"):
            content = summary[start:end]
            if opcode == Opcode.CHANNEL:
                channel = read_channel(content)
                channels[channel.id] = channel
            elif opcode == Opcode.SCHEMA:
                schema = read_schema(content)
                self.schemas[schema.id] = schema
            elif opcode == Opcode.CHUNK_INDEX:
                self._chunks.append(ChunkPlace.read(content))
            elif opcode == Opcode.METADATA_INDEX:
                metadata = read_record(content, MetadataIndex)
                self._metadata[metadata.name] = metadata
            elif opcode == Opcode.ATTACHMENT_INDEX:
                attachment = read_record(content, AttachmentIndex)
                self._attachments[attachment.name] = attachment
            elif opcode == Opcode.STATISTICS:
                counts = dict(read_record(content, Statistics).channel_message_counts)
        self._chunks.sort(key=lambda chunk: chunk.start)
        self._limits.check_total(sum(chunk.uncompressed_size for chunk in self._chunks))
        self._limits.check_records(sum(counts.values()))
        for channel in channels.values():
            if channel.schema_id not in self.schemas:
                raise ValueError(f"no schema {channel.schema_id} for the topic {channel.topic!r}")
        self.channels = {channel.topic: channel for channel in channels.values()}
        self.counts = {channel.topic: counts.get(channel.id, 0) for channel in channels.values()}

    def _read_at(self, offset: int, length: int) -> bytes:
        if not 0 <= length <= MAX_RECORD_BYTES:
            raise RecordingError(f"The recording is damaged: a record of {length} bytes: {self.path}")
        if self._file.closed:
            raise RecordingError(f"The recording was closed before it was read: {self.path}")
        self._file.seek(offset)
        data = self._file.read(length)
        if len(data) != length:
            raise RecordingError(f"The recording is damaged or cut off: {self.path}")
        return data

    def _content_at(self, offset: int, length: int, opcode: Opcode) -> memoryview:
        data = self._read_at(offset, length)
        found, content_length = RECORD_HEAD.unpack_from(data)
        if found != opcode or content_length != length - RECORD_HEAD.size:
            raise RecordingError(
                f"The recording is damaged: no {opcode.name.capitalize()} where its index says: {self.path}"
            )
        return memoryview(data)[RECORD_HEAD.size :]

    def _record_at[R: McapRecord](self, offset: int, length: int, opcode: Opcode, kind: type[R]) -> R:
        return read_record(self._content_at(offset, length, opcode), kind)

    @property
    def metadata_names(self) -> tuple[str, ...]:
        """Names of all metadata records."""
        return tuple(self._metadata)

    def metadata(self, name: str) -> dict[str, str] | None:
        """A metadata record, or None; the caller checks its seal."""
        index = self._metadata.get(name)
        if index is None:
            return None
        if index.length > MAX_METADATA_BYTES:
            raise RecordingError(
                f"The metadata {name} have {index.length / 1e6:,.0f} MB, those of recordings a few kB: {self.path}"
            )
        with damage_as_recording_error(self.path):
            record = self._record_at(index.offset, index.length, Opcode.METADATA, Metadata)
            return dict(record.metadata)

    @property
    def attachment_names(self) -> tuple[str, ...]:
        """Names of all attachments."""
        return tuple(self._attachments)

    def attachment(self, name: str) -> bytes:
        """The bytes of an attachment; KeyError when there is none of that name."""
        index = self._attachments[name]
        with damage_as_recording_error(self.path):
            data = self._read_at(index.offset, index.length)
            content, stored = data[RECORD_HEAD.size : -4], int.from_bytes(data[-4:], "little")
            if stored and zlib.crc32(content) != stored:
                raise RecordingError(
                    f"The recording is damaged: the attachment {name!r} fails its checksum: {self.path}"
                )
            record = self._record_at(index.offset, index.length, Opcode.ATTACHMENT, Attachment)
            return bytes(record.data)

    def messages(self, topics: Collection[str]) -> Iterator[Message]:
        """Messages of some topics in the order of the file; chunks without them are not read."""
        wanted = {self.channels[topic].id: topic for topic in topics if topic in self.channels}
        with damage_as_recording_error(self.path):
            yield from _messages_of(self._unpacked(self._places(wanted)), wanted, self._limits)

    def blocks(self, topics: Collection[str]) -> dict[str, Block]:
        """topic -> all its messages; the chunks that hold any of them are in memory together."""
        wanted = {topic: self.channels[topic].id if topic in self.channels else -1 for topic in topics}
        with damage_as_recording_error(self.path):
            return blocks_of(self._unpacked(self._places(wanted.values())), wanted, self._limits)

    def blocks_by_chunk(self, topics: Collection[str], *, num_bytes: int = 0) -> Iterator[dict[str, Block]]:
        """As `blocks`, one chunk after the other, or a few of them: no more than have that many bytes unpacked."""
        wanted = {topic: self.channels[topic].id if topic in self.channels else -1 for topic in topics}
        with damage_as_recording_error(self.path):
            for places in ChunkPlace.together(self._places(wanted.values()), num_bytes):
                yield blocks_of(self._unpacked(places), wanted, self._limits)

    def _places(self, channels: Collection[int]) -> list[ChunkPlace]:
        return [place for place in self._chunks if not place.channels.isdisjoint(channels)]

    def _unpacked(self, places: Iterable[ChunkPlace]) -> Iterator[bytes]:
        for place in places:
            record = self._content_at(place.start, place.length, Opcode.CHUNK)
            yield chunk_content(record, self._limits, place.uncompressed_size)


def _messages_of(contents: Iterable[bytes], wanted: dict[int, str], limits: Limits) -> Iterator[Message]:
    count = 0
    for content in contents:
        for opcode, start, end in records_in(content):
            count += 1
            if opcode == Opcode.MESSAGE:
                channel_id, _, log_time, _ = MESSAGE_HEAD.unpack_from(content, start)
                topic = wanted.get(channel_id)
                if topic is not None:
                    yield Message(topic, log_time, content[start + MESSAGE_HEAD.size : end])
        limits.check_records(count)
