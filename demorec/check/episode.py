"""A recording for its checks: each part is read once, when the first check needs it."""

from __future__ import annotations

import struct
from collections import defaultdict
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from demorec.check.base import Form
from demorec.core.errors import RecordingError
from demorec.mcap import Recording
from demorec.mcap.container import Container
from demorec.mcap.streams import frame_times

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
"""Size of the CDR header before the first field, in bytes."""


@dataclass(frozen=True, kw_only=True, eq=False)
class TopicScan:
    """Messages of one topic, in file order.

    Attributes:
        schema: Its message type.
        time_ns: (N,) time of each message.
        stamp_ns: (N,) timestamp inside each message; None for types without one.
    """

    schema: str
    time_ns: NDArray[np.int64]
    stamp_ns: NDArray[np.int64] | None


class CheckedEpisode(ExitStack):
    """One recording, closed at the end of a `with`. Properties raise RecordingError for missing data.

    Args:
        path: The recording.
        colours: Whether the image check decodes colour images.
    """

    def __init__(self, path: Path, *, colours: bool = True) -> None:
        super().__init__()
        self.path = path
        self.colours = colours

    def __exit__(self, *error: Any) -> bool | None:
        """Free everything: parts that refer to the whole would keep its images until the next garbage collection."""
        result = super().__exit__(*error)
        vars(self).clear()
        return result

    @cached_property
    def recording(self) -> Recording:
        """The open recording."""
        return self.enter_context(Recording(self.path))

    @cached_property
    def form(self) -> Form:
        """Simulated if there is a scene; a recording that cannot be opened counts as simulated."""
        with suppress(RecordingError):
            return "simulated" if self.recording.info.simulation is not None else "external"
        return "simulated"

    @cached_property
    def frame_times(self) -> NDArray[np.int64]:
        """(T,) nominal time of each frame, ns."""
        return frame_times(self.recording.num_frames, self.recording.info.fps)

    @cached_property
    def scan(self) -> dict[str, TopicScan]:
        """Every message of every topic, read once; this verifies every chunk's checksum."""
        return _scan_topics(self.container)

    @cached_property
    def container(self) -> Container:
        """Unprocessed messages and metadata of the file."""
        return self.enter_context(closing(Container(self.path)))


def _scan_topics(container: Container) -> dict[str, TopicScan]:
    """Read all messages by topic, and all attachments; this verifies every chunk's checksum."""
    schemas = {name: container.schemas[channel.schema_id].name for name, channel in container.channels.items()}
    times: dict[str, list[int]] = defaultdict(list)
    stamps: dict[str, list[int]] = defaultdict(list)
    for topic, time_ns, data in container.messages(list(schemas)):
        times[topic].append(time_ns)
        if schemas[topic] in _STAMP_FIRST:
            stamps[topic].append(_stamp_ns(data))
    for name in container.attachments:
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
    """First field of a message; -1 for a message that is too short."""
    if len(data) < _STAMP_OFFSET + _STAMP.size:
        return -1
    seconds, nanoseconds = _STAMP.unpack_from(data, _STAMP_OFFSET)
    return int(seconds) * 1_000_000_000 + int(nanoseconds)
