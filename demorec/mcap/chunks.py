"""Chunks of an MCAP file: their records, and all messages of a topic as one table of bytes.

An export reads every message of every recording. So no object is created per message: one walk over a chunk finds the
offsets of its records, and NumPy splits their headers and contents, a whole topic at a time.
"""

from __future__ import annotations

import struct
import zlib
from array import array
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from io import BytesIO

import numpy as np
import zstandard
from numpy.typing import NDArray

RECORD_HEAD = struct.Struct("<BQ")
"""Opcode and content length (MCAP specification, Records)."""

_MESSAGE = 5
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
_CHUNK_HEAD = struct.Struct("<QQQII")


def records_in(content: bytes, where: str = "its chunk") -> Iterator[tuple[int, int, int]]:
    """Yield (opcode, start, end) of the contents of the records in a chunk, or in `where`, without copying.

    Raises:
        ValueError, struct.error: The records do not fill it.
    """
    position, end = 0, len(content)
    while position < end:
        opcode, length = RECORD_HEAD.unpack_from(content, position)
        start = position + RECORD_HEAD.size
        position = start + length
        if position > end:
            raise ValueError(f"a record that extends beyond {where}")
        yield opcode, start, position


def chunk_content(record: bytes | memoryview, expected_size: int | None = None) -> bytes:
    """Unpack the records of a chunk, given the content of its record; a checksum of 0 means none.

    Raises:
        ValueError, struct.error, zstandard.ZstdError: It is damaged, or has an unexpected size.
    """
    _, _, size, stored_crc, name_bytes = _CHUNK_HEAD.unpack_from(record)
    position = _CHUNK_HEAD.size
    compression = bytes(record[position : position + name_bytes])
    (num_bytes,) = struct.unpack_from("<Q", record, position + name_bytes)
    start = position + name_bytes + 8
    if expected_size is not None and size != expected_size:
        raise ValueError("a chunk differs from its index")
    if start + num_bytes > len(record):
        raise ValueError("a truncated chunk")
    stored = memoryview(record)[start : start + num_bytes]
    if compression == b"zstd":
        # If the compressed data state their size, zstandard allocates that much, regardless of the limit given here.
        if zstandard.frame_content_size(stored) not in (size, -1):
            raise ValueError("a chunk with a different size from its compressed data")
        content = zstandard.ZstdDecompressor().decompress(stored, max_output_size=size)
    elif compression == b"lz4":  # not used here, but by writers of third-party bags
        content = _lz4_content(stored, size)
    elif compression == b"":
        content = bytes(stored)
    else:
        raise ValueError(f"a chunk compressed with {compression!r}, not zstd or lz4")
    if len(content) != size or (stored_crc and zlib.crc32(content) != stored_crc):
        raise ValueError("a chunk fails its checksum")
    return content


def _lz4_content(stored: memoryview, size: int) -> bytes:
    import lz4.frame

    try:
        content: bytes = lz4.frame.LZ4FrameDecompressor().decompress(stored, max_length=size)
    except RuntimeError as error:  # the only error of lz4
        raise ValueError("a chunk that lz4 cannot unpack") from error
    return content


@dataclass(frozen=True, kw_only=True, eq=False)
class Block:
    """All messages of one topic, in the order of the file.

    Attributes:
        content: The bytes that contain them, shared by topics that were read together.
        time_ns: (N,) int64.
        starts, lengths: (N,) int64, position of each message in `content`.
    """

    content: bytes
    time_ns: NDArray[np.int64]
    starts: NDArray[np.int64]
    lengths: NDArray[np.int64]

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
        return Block(
            content=self.content,
            time_ns=self.time_ns[chosen],
            starts=self.starts[chosen],
            lengths=self.lengths[chosen],
        )

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
    """Collect topic -> its messages from the contents of chunks, given topic -> channel.

    Raises:
        ValueError, struct.error: The records do not fill their chunk.
    """
    found = array("q")
    joined = BytesIO()
    for chunk in contents:
        _find_records(chunk, joined.tell(), found.append)
        joined.write(chunk)
    content = joined.getvalue()
    values = np.frombuffer(content, dtype=np.uint8)
    starts = np.frombuffer(found, dtype=np.int64)
    starts = starts[values[starts] == _MESSAGE]
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
    """Gather (N, length) bytes after each start."""
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
