"""A recording as the checks see it: everything is read once, when the first check asks for it."""

from __future__ import annotations

import struct
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from demorec.check.base import Form
from demorec.check.evidence import Motion, motion_of_features, motion_of_simulated
from demorec.check.films import CameraFilms, film_of_recording
from demorec.core.errors import RecordingError
from demorec.episode.episode import Table, Trajectory
from demorec.episode.roles import NO_NAMES, NamedRoles, Roles, roles_of_recording
from demorec.mcap import Recording
from demorec.mcap.container import Container
from demorec.mcap.streams import frame_times
from demorec.robots.urdf import Urdf

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


class CheckedEpisode(ExitStack):
    """One recording, closed at the end of a `with`. Properties raise RecordingError where the file does not give them.

    Args:
        path: The recording.
        named_urdf: Text of the robot's description that the user names, for a recording that is not simulated; "" for
            none.
        named: Features whose role the user names, in a recording that is not simulated.
    """

    def __init__(self, path: Path, named_urdf: str = "", named: NamedRoles = NO_NAMES) -> None:
        super().__init__()
        self.path = path
        self._named_urdf = named_urdf
        self._named = named

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
        """By whether there is a scene; one that cannot be opened counts as simulated."""
        with suppress(RecordingError):
            return "simulated" if self.recording.info.simulation is not None else "external"
        return "simulated"

    @cached_property
    def roles(self) -> Roles:
        """The roles of its features."""
        return roles_of_recording(self.recording.info, self._named)

    @cached_property
    def frame_times(self) -> NDArray[np.int64]:
        """(T,) ns: when each frame ought to be."""
        return frame_times(self.recording.num_frames, self.recording.info.fps)

    @cached_property
    def scan(self) -> dict[str, TopicScan]:
        """Every message of every topic, read once: every chunk's checksum is verified on the way."""
        return _scan_topics(self.container)

    @cached_property
    def container(self) -> Container:
        """The file's messages and metadata as they are."""
        return self.enter_context(closing(Container(self.path)))

    @cached_property
    def motions(self) -> list[Motion]:
        """The one of its robot, if it has a state."""
        info = self.recording.info
        if self.form == "external":
            table, urdf = self.recording.table(), self._named_urdf or info.urdf
            motion = motion_of_features(table.features, info.features, info.fps, urdf, table.time_ns, named=self._named)
            return [] if motion is None else [motion]
        if not self.recording.num_frames:
            return []
        return [motion_of_simulated(info, self.recording.trajectory(), Urdf.parse(self.recording.description()))]

    def numbers(self) -> Iterator[tuple[str, NDArray[Any]]]:
        """(name, (T, ...) table) of all floating-point numbers."""
        numbers: Table | Trajectory
        numbers = self.recording.table() if self.form == "external" else self.recording.trajectory()
        for name, column in vars(numbers).items():
            tables = column.items() if isinstance(column, Mapping) else [(name, column)]
            for key, table in tables:
                if isinstance(table, np.ndarray) and table.dtype.kind == "f":
                    yield key, table

    @cached_property
    def films(self) -> dict[str, CameraFilms]:
        """Camera -> its colour images."""
        colours = [camera for camera in self.recording.cameras if camera in self.recording.table().images]
        return {camera: film_of_recording(self.recording, self.recording.table(), camera) for camera in colours}

    def undecoded(self) -> Iterator[tuple[str, str]]:
        """(camera, problem) of every camera whose images do not all decode: colours, distances, labels."""
        yield from ((camera, films.error) for camera, films in self.films.items() if films.error)
        recording = self.recording
        others: list[tuple[str, Callable[[str], Iterator[Any]]]]
        others = [(camera, recording.distances) for camera in recording.depth_cameras]
        others += [
            (camera, recording.segmentation) for camera in recording.cameras if recording.has_segmentation(camera)
        ]
        for camera, read in others:
            try:
                for _ in read(camera):
                    pass
            except RecordingError as error:
                yield camera, str(error)


def _scan_topics(container: Container) -> dict[str, TopicScan]:
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
