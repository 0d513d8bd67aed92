"""Every message of every topic of a recording, read once: types, times and the timestamps inside."""

from __future__ import annotations

import struct
from collections import defaultdict
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

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
"""Types whose first field is a timestamp, alone or in a header."""
_STAMP = struct.Struct("<iI")
_STAMP_OFFSET = 4
"""Bytes of CDR's head before the first field."""


@dataclass(frozen=True, kw_only=True, eq=False)
class TopicScan:
    """The messages of one topic, in the order of the file.

    Attributes:
        schema: Its type.
        time_ns: (N,) time of each message.
        stamp_ns: (N,) timestamp inside each message; None for types without one.
    """

    schema: str
    time_ns: NDArray[np.int64]
    stamp_ns: NDArray[np.int64] | None


def scan_topics(container: Container) -> dict[str, TopicScan]:
    """Read all messages by topic, and all attachments; the checksum of every chunk is verified on the way."""
    schemas = {name: container.schemas[channel.schema_id].name for name, channel in container.channels.items()}
    times: dict[str, list[int]] = defaultdict(list)
    stamps: dict[str, list[int]] = defaultdict(list)
    for topic, time_ns, data in container.messages(list(schemas)):
        times[topic].append(time_ns)
        if schemas[topic] in _STAMP_FIRST:
            stamps[topic].append(_stamp_ns(data))
    for name in container.attachment_names:
        container.attachment(name)
    return {
        topic: TopicScan(
            schema=schema,
            time_ns=np.array(times[topic], dtype=np.int64),
            stamp_ns=np.array(stamps[topic], dtype=np.int64) if schema in _STAMP_FIRST else None,
        )
        for topic, schema in schemas.items()
    }


def _stamp_ns(data: bytes) -> int:
    """The first field of a message; -1 for one that is too short."""
    if len(data) < _STAMP_OFFSET + _STAMP.size:
        return -1
    seconds, nanoseconds = _STAMP.unpack_from(data, _STAMP_OFFSET)
    return int(seconds) * 1_000_000_000 + int(nanoseconds)
