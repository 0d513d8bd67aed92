"""Random access to an MCAP file that trusts nothing: all data used are covered by a checksum, if the writer stored one
(0 means none).

The summary at the end lists each chunk's position and topics, so one topic is read without touching the others, one
chunk at a time. The mcap library parses the records; this module adds the verification, and a single error type.
"""

from __future__ import annotations

import zlib
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Footer, Metadata, MetadataIndex, Statistics

from demorec.core.errors import RecordingError, ResourceError, describe_error, resource_error
from demorec.core.files import MCAP_MAGIC, open_regular
from demorec.mcap.scan import (
    NO_SCHEMA,
    RECORD_HEAD,
    Block,
    blocks_of,
    chunk_content,
    read_channel,
    read_record,
    read_schema,
    records_in,
)

_FOOTER_BYTES = RECORD_HEAD.size + 20
_DAMAGE = (OSError, MemoryError, ValueError, KeyError, IndexError, OverflowError, EOFError)
_PARSERS = ("builtins", "mcap", "struct", "zstandard", "zstd")
"""Modules that raise errors on damaged bytes; these share no base class but Exception."""


@contextmanager
def damage_as_recording_error(path: Path) -> Iterator[None]:
    """Convert any error of a parser of damaged bytes to RecordingError, and a lack of memory to ResourceError."""
    try:
        yield
    except (RecordingError, ResourceError):
        raise
    except Exception as error:
        if not isinstance(error, _DAMAGE) and type(error).__module__.split(".")[0] not in _PARSERS:
            raise
        # zstandard has no separate error for a lack of memory
        lacking = MemoryError() if "not enough memory" in str(error) else error
        damaged = RecordingError(f"The recording is damaged ({describe_error(error)}): {path}")
        raise resource_error(lacking, path) or damaged from error


class Container:
    """An open MCAP file.

    Attributes:
        channels: topic -> channel.
        schemas: number -> schema.
        counts: topic -> number of messages.
        metadata_index: name -> position in the file.

    Raises:
        RecordingError: The file does not exist, is not MCAP, is truncated, or has a wrong checksum.
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
        """Close the file; safe to call twice."""
        self._file.close()

    def _read_summary(self) -> None:
        self._size = size = self._file.seek(0, 2)
        if size == 0:
            raise RecordingError(f"The file is empty, so it is not a recording: {self.path}")
        if self._read_at(0, min(size, len(MCAP_MAGIC))) != MCAP_MAGIC:
            raise RecordingError(f"This is not an MCAP file, so not a recording: {self.path}")
        tail_bytes = _FOOTER_BYTES + len(MCAP_MAGIC)
        if size < tail_bytes + len(MCAP_MAGIC) or self._read_at(size - len(MCAP_MAGIC), len(MCAP_MAGIC)) != MCAP_MAGIC:
            raise RecordingError(
                "The recording is cut off (missing index); recover its complete frames with demorec recover: "
                f"{self.path}"
            )
        footer_start = size - tail_bytes
        footer = read_record(self._content_at(footer_start, _FOOTER_BYTES, Opcode.FOOTER), Footer)
        if not len(MCAP_MAGIC) <= footer.summary_start < footer_start:
            raise ValueError("it has no index")
        # The checksum covers the summary and the footer up to the checksum itself.
        summary = self._read_at(footer.summary_start, footer_start - footer.summary_start + _FOOTER_BYTES - 4)
        if footer.summary_crc and zlib.crc32(summary) != footer.summary_crc:
            raise ValueError("the checksum of its index does not match")
        self._parse_summary(summary[: footer_start - footer.summary_start])

    def _parse_summary(self, summary: bytes) -> None:
        channels: dict[int, Channel] = {}
        self.schemas = {0: NO_SCHEMA}
        self._chunks: list[ChunkIndex] = []
        self.metadata_index: dict[str, MetadataIndex] = {}
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
                self._chunks.append(read_record(content, ChunkIndex))
            elif opcode == Opcode.METADATA_INDEX:
                metadata = read_record(content, MetadataIndex)
                self.metadata_index[metadata.name] = metadata
            elif opcode == Opcode.STATISTICS:
                counts = dict(read_record(content, Statistics).channel_message_counts)
        self._chunks.sort(key=lambda chunk: chunk.chunk_start_offset)
        for channel in channels.values():
            if channel.schema_id not in self.schemas:
                raise ValueError(f"no schema {channel.schema_id} for the topic {channel.topic!r}")
        self.channels = {channel.topic: channel for channel in channels.values()}
        self.counts = {channel.topic: counts.get(channel.id, 0) for channel in channels.values()}

    def _read_at(self, offset: int, length: int) -> bytes:
        if not 0 <= length <= self._size:
            raise ValueError(f"a record of {length} bytes")
        if self._file.closed:
            raise RecordingError(f"The recording was closed before it was read: {self.path}")
        self._file.seek(offset)
        data = self._file.read(length)
        if len(data) != length:
            raise ValueError("it is cut off")
        return data

    def _content_at(self, offset: int, length: int, opcode: Opcode) -> memoryview:
        data = self._read_at(offset, length)
        found, content_length = RECORD_HEAD.unpack_from(data)
        if found != opcode or content_length != length - RECORD_HEAD.size:
            raise ValueError(f"no {opcode.name.capitalize()} at the place in its index")
        return memoryview(data)[RECORD_HEAD.size :]

    def metadata(self, name: str) -> dict[str, str] | None:
        """Return a metadata record, or None; the caller checks its seal."""
        index = self.metadata_index.get(name)
        if index is None:
            return None
        with damage_as_recording_error(self.path):
            record = read_record(self._content_at(index.offset, index.length, Opcode.METADATA), Metadata)
            return dict(record.metadata)

    def messages(self, topics: Collection[str]) -> Iterator[tuple[str, int, bytes]]:
        """Yield (topic, time in ns, bytes) of the messages of some topics; those of one topic in order."""
        for blocks in self.blocks_by_chunk(topics):
            for topic, block in blocks.items():
                for time_ns, data in zip(block.time_ns.tolist(), block.messages(), strict=True):
                    yield topic, time_ns, data

    def blocks_by_chunk(self, topics: Collection[str], *, num_bytes: int = 0) -> Iterator[dict[str, Block]]:
        """Yield topic -> its messages in one or a few chunks at a time, up to `num_bytes` unpacked.

        If no chunk has any, one result without messages is yielded.
        """
        wanted = self._ids(topics)
        group: list[ChunkIndex] = []
        total = 0
        with damage_as_recording_error(self.path):
            for chunk in self._chunks_of(wanted.values()):
                if group and total + chunk.uncompressed_size > num_bytes:
                    yield blocks_of(self._unpacked(group), wanted)
                    group, total = [], 0
                group.append(chunk)
                total += chunk.uncompressed_size
            yield blocks_of(self._unpacked(group), wanted)

    def _ids(self, topics: Collection[str]) -> dict[str, int]:
        """Return topic -> number of its channel, -1 if missing."""
        return {topic: self.channels[topic].id if topic in self.channels else -1 for topic in topics}

    def _chunks_of(self, channels: Collection[int]) -> list[ChunkIndex]:
        return [chunk for chunk in self._chunks if not chunk.message_index_offsets.keys().isdisjoint(channels)]

    def _unpacked(self, chunks: Iterable[ChunkIndex]) -> Iterator[bytes]:
        for chunk in chunks:
            record = self._content_at(chunk.chunk_start_offset, chunk.chunk_length, Opcode.CHUNK)
            yield chunk_content(record, chunk.uncompressed_size)
