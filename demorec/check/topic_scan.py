"""Every message of every topic of a recording, read once: types, times and the stamps inside."""

from __future__ import annotations

import struct
from collections.abc import Mapping
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
_STAMP_BYTES = 4 + _STAMP.itemsize
"""A stamp with the four bytes of CDR's head before it."""


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
    """Topic -> what was found on it; `blocks` has all topics but those of images, which are read one by one.

    Every chunk's checksum is verified on the way, and that of every attachment.
    """
    schemas = {name: container.schemas[c.schema_id].name for name, c in container.channels.items()}
    found = {topic: _scan(schemas[topic], block) for topic, block in blocks.items()}
    images = [topic for topic in schemas if topic not in found]
    times: dict[str, list[int]] = {topic: [] for topic in images}
    stamps: dict[str, list[int]] = {topic: [] for topic in images}
    first: dict[str, bytes] = {}
    for topic, time_ns, data in container.messages(images):
        times[topic].append(time_ns)
        stamps[topic].append(_stamp(data))
        first.setdefault(topic, data)
    for name in container.attachment_names:
        container.attachment(name)
    for topic in images:
        found[topic] = TopicScan(
            schema=schemas[topic],
            time_ns=np.array(times[topic], dtype=np.int64),
            stamp_ns=np.array(stamps[topic], dtype=np.int64) if schemas[topic] in _STAMP_FIRST else None,
            first=first.get(topic, b""),
        )
    return {topic: found[topic] for topic in schemas}


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
