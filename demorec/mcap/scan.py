"""Records of an MCAP file, and the messages of a topic in its chunks.

An export reads every message of every recording. So no object is created per message: one walk over a chunk finds the
offsets of its records, and NumPy splits their headers and contents, a whole topic at a time.
"""

from __future__ import annotations

import struct
from array import array
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from io import BytesIO

import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, McapRecord, Schema
from mcap.stream_reader import get_chunk_data_stream
from numpy.typing import NDArray

RECORD_HEAD = struct.Struct("<BQ")
"""Opcode and content length (MCAP specification, Records)."""
NO_SCHEMA = Schema(id=0, name="", encoding="", data=b"")
"""Schema of messages without one."""
_MESSAGE_HEAD = np.dtype(
    [
        ("opcode", "u1"),
        ("length", "<u8"),
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("log_time", "<u8"),
        ("publish_time", "<u8"),
    ]
)
_GATHERED_ROWS = 4096
"""Messages copied from a chunk at once: the indices of their bytes take eight times as much memory as the bytes."""


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


def records_in(content: bytes, where: str = "its chunk") -> Iterator[tuple[int, int, int]]:
    """Yield (opcode, start, end) of the records' contents; ValueError or struct.error unless they fill the bytes."""
    position, end = 0, len(content)
    while position < end:
        opcode, length = RECORD_HEAD.unpack_from(content, position)
        start = position + RECORD_HEAD.size
        position = start + length
        if position > end:
            raise ValueError(f"a record that extends beyond {where}")
        yield opcode, start, position


def chunk_content(record: bytes | memoryview, expected_size: int | None = None) -> bytes:
    """Unpack a chunk's records from the content of its record; a checksum of 0 means none.

    Any exception of mcap, zstandard or lz4, or ValueError, if it is damaged or has an unexpected size.
    """
    chunk = read_record(record, Chunk)
    # If the compressed data state their size, zstandard allocates that much, whatever the chunk states.
    if chunk.compression == "zstd" and zstandard.frame_content_size(chunk.data) not in (chunk.uncompressed_size, -1):
        raise ValueError("a chunk with a different size from its compressed data")
    stream, size = get_chunk_data_stream(chunk, validate_crc=True)
    if size != chunk.uncompressed_size or expected_size not in (None, size):
        raise ValueError("a chunk has another size than stated")
    content: bytes = stream.read(size)
    return content


@dataclass(frozen=True, kw_only=True, eq=False)
class Block:
    """All messages of one topic, in the order of the file: time and position in `content` of each of N messages."""

    content: bytes  # shared by topics that were read together
    time_ns: NDArray[np.int64]  # (N,)
    starts: NDArray[np.int64]  # (N,)
    lengths: NDArray[np.int64]  # (N,)

    def __len__(self) -> int:
        return len(self.starts)

    def messages(self) -> Iterator[bytes]:
        """Yield the messages one by one."""
        ends = self.starts + self.lengths
        for start, end in zip(self.starts.tolist(), ends.tolist(), strict=True):
            yield self.content[start:end]

    def joined(self) -> bytes:
        """Concatenate the messages."""
        content, ends = memoryview(self.content), self.starts + self.lengths
        return b"".join([content[a:b] for a, b in zip(self.starts.tolist(), ends.tolist(), strict=True)])

    def select(self, chosen: NDArray[np.bool_] | NDArray[np.intp]) -> Block:
        """Select some of the messages."""
        return replace(self, time_ns=self.time_ns[chosen], starts=self.starts[chosen], lengths=self.lengths[chosen])

    def heads(self, length: int) -> NDArray[np.uint8]:
        """Return (N, length) first bytes of every message; ValueError if one is shorter."""
        if len(self) and int(self.lengths.min()) < length:
            raise ValueError(f"a message of {int(self.lengths.min())} bytes where at least {length} were expected")
        return _gathered(np.frombuffer(self.content, dtype=np.uint8), self.starts, length)

    def rows(self, length: int) -> NDArray[np.uint8]:
        """Return the messages as (N, length); ValueError unless all have that length."""
        wrong = self.lengths[self.lengths != length]
        if len(wrong):
            raise ValueError(f"a message of {wrong[0]} bytes where {length} were expected")
        return self.heads(length)


def blocks_of(contents: Iterable[bytes], topics: Mapping[str, int]) -> dict[str, Block]:
    """Collect topic -> its messages from the contents of chunks, given topic -> channel; errors as in `records_in`."""
    found = array("q")
    joined = BytesIO()
    for chunk in contents:
        _find_records(chunk, joined.tell(), found.append)
        joined.write(chunk)
    content = joined.getvalue()
    values = np.frombuffer(content, dtype=np.uint8)
    starts = np.frombuffer(found, dtype=np.int64)
    starts = starts[values[starts] == Opcode.MESSAGE]
    if len(starts) and int(starts[-1]) + _MESSAGE_HEAD.itemsize > len(values):
        raise ValueError("a message that ends within its header")
    heads = _gathered(values, starts, _MESSAGE_HEAD.itemsize).view(_MESSAGE_HEAD).reshape(-1)
    lengths = heads["length"].astype(np.int64) - (_MESSAGE_HEAD.itemsize - RECORD_HEAD.size)
    if len(lengths) and int(lengths.min()) < 0:
        raise ValueError("a message that ends within its header")
    starts = starts + _MESSAGE_HEAD.itemsize
    times = heads["log_time"].astype(np.int64)
    blocks = {}
    for topic, channel in topics.items():
        chosen = np.flatnonzero(heads["channel"] == channel)
        blocks[topic] = Block(content=content, time_ns=times[chosen], starts=starts[chosen], lengths=lengths[chosen])
    return blocks


def _gathered(values: NDArray[np.uint8], starts: NDArray[np.int64], length: int) -> NDArray[np.uint8]:
    rows = np.empty((len(starts), length), dtype=np.uint8)
    places = np.arange(length)
    for first in range(0, len(starts), _GATHERED_ROWS):
        part = slice(first, first + _GATHERED_ROWS)
        rows[part] = values[starts[part, np.newaxis] + places]
    return rows


def _find_records(content: bytes, offset: int, found: Callable[[int], None]) -> None:
    """Report the offset of each record of a chunk, counted from `offset`."""
    unpack, head_bytes = RECORD_HEAD.unpack_from, RECORD_HEAD.size
    position, end = 0, len(content)
    while position < end:
        found(offset + position)
        position += unpack(content, position)[1] + head_bytes
    if position != end:
        raise ValueError("a record that extends beyond its chunk")
