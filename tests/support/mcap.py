"""MCAP files with arbitrary content: written record by record by the specification, without the library.

https://mcap.dev/spec lists the records; numbers are little endian, strings and maps have a length of four bytes.
"""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from mcap.reader import make_reader
from mcap.records import Channel, Chunk, Schema
from mcap.stream_reader import StreamReader

MAGIC = b"\x89MCAP0\r\n"


def record(opcode: int, content: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(content)) + content


def string(text: str) -> bytes:
    data = text.encode(errors="surrogatepass")
    return struct.pack("<I", len(data)) + data


def message_record(channel: int, time_ns: int, data: bytes) -> bytes:
    return record(5, struct.pack("<HIQQ", channel, 0, time_ns, time_ns) + data)


def chunk_record(packed: bytes, *, size: int, crc: int) -> bytes:
    """A chunk of zstd data whose declared size is `size` bytes."""
    head = struct.pack("<QQQI", 0, 0, size, crc) + string("zstd") + struct.pack("<Q", len(packed))
    return record(6, head + packed)


def metadata_record(name: str, values: Mapping[str, str]) -> bytes:
    pairs = b"".join(string(key) + string(value) for key, value in values.items())
    return record(12, string(name) + struct.pack("<I", len(pairs)) + pairs)


def sealed(values: Mapping[str, str]) -> dict[str, str]:
    """Metadata with the checksum that demorec's own have (docs/recording.md)."""
    content = {key: value for key, value in values.items() if key != "crc32"}
    return {**content, "crc32": f"{zlib.crc32(json.dumps(content, sort_keys=True).encode()):08x}"}


def metadata_of(source: Path) -> dict[str, dict[str, str]]:
    """Name -> values of all metadata records, as the library's reader finds them."""
    with source.open("rb") as file:
        return {item.name: dict(item.metadata) for item in make_reader(file).iter_metadata()}


def rewritten(
    source: Path,
    *,
    extra_chunks: Sequence[bytes] = (),
    change: Mapping[str, Mapping[str, str]] | None = None,
    metadata: Mapping[str, Mapping[str, str]] | None = None,
    messages: Callable[[str, bytes], bytes] | None = None,
    counts: Callable[[str, int], int] | None = None,
    with_checksums: bool = True,
) -> bytes:
    """Write the content of `source` as another MCAP file, returned as bytes.

    Args:
        source: A recording.
        extra_chunks: Additional chunk records; the index lists messages of every topic in them.
        change: Name -> values that replace those of metadata records, which are sealed again.
        metadata: Name -> metadata records that replace those of the source as they are.
        messages: (topic, message) -> its replacement.
        counts: (topic, number of messages) -> number in the statistics.
        with_checksums: Whether chunks and summary get theirs.
    """
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    rows: list[tuple[int, int, bytes]] = []
    described: dict[str, Mapping[str, str]] = {**metadata_of(source)}
    with source.open("rb") as file:
        for item in StreamReader(file).records:
            assert not isinstance(item, Chunk)  # the reader opens them
            if isinstance(item, Schema):
                schemas[item.id] = item
            elif isinstance(item, Channel):
                channels[item.id] = item
            elif type(item).__name__ == "Message":
                rows.append((item.channel_id, item.log_time, item.data))
    for name, values in (change or {}).items():
        described[name] = sealed({**described[name], **values})
    described.update(metadata or {})
    definitions = b"".join(
        record(
            3, struct.pack("<H", s.id) + string(s.name) + string(s.encoding) + struct.pack("<I", len(s.data)) + s.data
        )
        for s in schemas.values()
    )
    for c in channels.values():
        pairs = b"".join(string(key) + string(value) for key, value in c.metadata.items())
        content = struct.pack("<HH", c.id, c.schema_id) + string(c.topic) + string(c.message_encoding)
        definitions += record(4, content + struct.pack("<I", len(pairs)) + pairs)
    content = b"".join(
        message_record(channel, time_ns, data if messages is None else messages(channels[channel].topic, data))
        for channel, time_ns, data in rows
    )
    crc = zlib.crc32(content) if with_checksums else 0
    plain_chunk = record(
        6, struct.pack("<QQQI", 0, 0, len(content), crc) + string("") + struct.pack("<Q", len(content)) + content
    )
    body = MAGIC + record(1, string("ros2") + string("")) + definitions
    indexes = b""
    for name, values in described.items():
        data = metadata_record(name, values)
        indexes += record(13, struct.pack("<QQ", len(body), len(data)) + string(name))
        body += data
    offsets = b"".join(struct.pack("<HQ", channel, 0) for channel in channels)
    for chunk in (plain_chunk, *extra_chunks):
        (size,) = struct.unpack_from("<Q", chunk, 9 + 16)
        compression = chunk[9 + 28 : 9 + 28 + 4 + struct.unpack_from("<I", chunk, 9 + 28)[0]]
        (num_bytes,) = struct.unpack_from("<Q", chunk, 9 + 28 + len(compression))
        head = struct.pack("<QQQQI", 0, 0, len(body), len(chunk), len(offsets)) + offsets + struct.pack("<Q", 0)
        indexes += record(8, head + compression + struct.pack("<QQ", num_bytes, size))
        body += chunk
    body += record(15, struct.pack("<I", 0))
    found: dict[int, int] = {}
    for channel, _, _ in rows:
        found[channel] = found.get(channel, 0) + 1
    told = {c: count if counts is None else counts(channels[c].topic, count) for c, count in found.items()}
    pairs = b"".join(struct.pack("<HQ", channel, count) for channel, count in told.items())
    head = struct.pack("<QHIIIIQQ", min(sum(told.values()), 2**63), len(schemas), len(channels), 0, len(described),
                       1 + len(extra_chunks), 0, 0)  # fmt: skip
    summary = definitions + record(11, head + struct.pack("<I", len(pairs)) + pairs) + indexes
    footer = struct.pack("<BQQQ", 2, 20, len(body), 0)
    crc = zlib.crc32(summary + footer) if with_checksums else 0
    return body + summary + footer + struct.pack("<I", crc) + MAGIC
