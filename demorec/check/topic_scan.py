"""Every message of every topic of a recording, read once: types, times and the stamps inside."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from demorec.mcap.chunks import Block
from demorec.mcap.container import Container

_STAMP_FIRST = {
    "sensor_msgs/msg/JointState",
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/WrenchStamped",
    "sensor_msgs/msg/CompressedImage",
    "sensor_msgs/msg/Image",
    "foxglove_msgs/msg/CompressedVideo",
    "rcl_interfaces/msg/Log",
}
"""Types whose first field is a time stamp, alone or in a header."""
_STAMP = np.dtype([("seconds", "<i4"), ("nanoseconds", "<u4")])
_NONE = np.zeros(0, dtype=np.int64)
_STAMP_BYTES = 4 + _STAMP.itemsize
"""A stamp with the four bytes of CDR's head before it."""
_IMAGE_BYTES = 1 << 22
"""Of chunks with images that are read together."""


@dataclass(frozen=True, kw_only=True, eq=False)
class TopicScan:
    """What was found on one topic, in the order of the file.

    Attributes:
        schema: Its type.
        time_ns: (N,) time of each message.
        stamp_ns: (N,) time stamp inside each message; None for types without one.
        first: Bytes of the first message.
    """

    schema: str
    time_ns: NDArray[np.int64]
    stamp_ns: NDArray[np.int64] | None
    first: bytes


def scan_topics(container: Container, blocks: Mapping[str, Block]) -> dict[str, TopicScan]:
    """Topic -> what was found on it; `blocks` has all topics but those of images, which are read chunk by chunk.

    Every chunk's checksum is verified on the way, and that of every attachment.
    """
    schemas = {name: container.schemas[c.schema_id].name for name, c in container.channels.items()}
    found = {topic: _scan(schemas[topic], block) for topic, block in blocks.items()}
    images = [topic for topic in schemas if topic not in found]
    parts: dict[str, list[TopicScan]] = {topic: [] for topic in images}
    for chunks in container.blocks_by_chunk(images, num_bytes=_IMAGE_BYTES):
        for topic, block in chunks.items():
            parts[topic].append(_scan(schemas[topic], block))
    for name in container.attachment_names:
        container.attachment(name)
    found |= {topic: _joined(schemas[topic], scans) for topic, scans in parts.items()}
    return {topic: found[topic] for topic in schemas}


def _joined(schema: str, scans: Sequence[TopicScan]) -> TopicScan:
    stamps = [scan.stamp_ns for scan in scans if scan.stamp_ns is not None]
    return TopicScan(
        schema=schema,
        time_ns=np.concatenate([_NONE, *(scan.time_ns for scan in scans)]),
        stamp_ns=np.concatenate([_NONE, *stamps]) if schema in _STAMP_FIRST else None,
        first=next((scan.first for scan in scans if len(scan.time_ns)), b""),
    )


def _scan(schema: str, block: Block) -> TopicScan:
    stamps = None
    if schema in _STAMP_FIRST and len(block) and int(block.lengths.min()) >= _STAMP_BYTES:
        heads = np.ascontiguousarray(block.heads(_STAMP_BYTES)[:, 4:]).view(_STAMP).reshape(-1)
        stamps = heads["seconds"] * np.int64(1_000_000_000) + heads["nanoseconds"]
    elif schema in _STAMP_FIRST:
        stamps = np.array([_stamp(data) for data in block.messages()], dtype=np.int64)
    first = next(block.messages(), b"")
    return TopicScan(schema=schema, time_ns=block.time_ns, stamp_ns=stamps, first=first)


def _stamp(data: bytes) -> int:
    with suppress(struct.error):
        seconds, nanoseconds = struct.unpack_from("<iI", data, 4)
        return int(seconds) * 1_000_000_000 + int(nanoseconds)
    return -1
