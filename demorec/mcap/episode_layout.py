"""Topics of an episode's file, the times of its messages and images, and its numbers as columns."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from demorec.core.errors import RecordingError
from demorec.episode.episode import NO_IMAGE, Table, Trajectory, frame_time_ns
from demorec.episode.info import EpisodeInfo
from demorec.mcap import messages
from demorec.mcap.channels import DELIBERATE_MISS, EVENTS, FRAMES, GRIPPER, PHASE, TF, camera_topic, video_topic
from demorec.mcap.container import Container, damage_as_recording_error
from demorec.mcap.streams import frame_streams, frame_times

if TYPE_CHECKING:
    from demorec.mcap.metadata import CameraStreams
    from demorec.mcap.scan import ScannedMessage

_TABLE_BYTES = 1 << 20
"""Size of chunks that are decoded together: decoding takes several times as much memory."""

TimedMessages = list[tuple[int, bytes]]
"""(time_ns, data) of messages that are not sent at each frame."""


class EpisodeLayout:
    """Layout of one episode's file.

    In a simulated episode all messages and images are at the times of the frames. In any other one the cameras decide
    the times of images, and `/frames` lists the samples and images of each frame.
    """

    def __init__(self, info: EpisodeInfo) -> None:
        self._info = info
        self._is_on_time = info.simulation is not None  # all messages at the times of the frames
        self.streams = frame_streams(info)
        self.frame_topic = GRIPPER if self._is_on_time else FRAMES

    def due_ns(self, num_frames: int) -> NDArray[np.int64] | None:
        """Compute (T,) due times of all images; None if the cameras decide."""
        return frame_times(num_frames, self._info.fps) if self._is_on_time else None

    def read(
        self, container: Container, num_frames: int, image_topics: Mapping[str, str]
    ) -> tuple[Table | Trajectory, TimedMessages]:
        """Read the numbers, and the messages of events, which are stored among them.

        Args:
            image_topics: Recorded camera -> topic of its images, in the order of the description.

        Raises:
            RecordingError: A stream is damaged or not at the times of the frames, or a frame shows an unknown image.
        """
        due = self.due_ns(num_frames)
        columns, others = self._columns(container, due, (PHASE, DELIBERATE_MISS, EVENTS) if self._is_on_time else ())
        if due is None:
            stamps = _image_stamps(container, image_topics)
            _check_images(columns["images"], stamps, container)
            return Table(**columns, image_stamps=stamps), []
        poses = columns.pop("world_from_camera")
        misses = _lasting(others[DELIBERATE_MISS], messages.read_boolean, due, False)
        trajectory = Trajectory(
            **columns,
            world_from_camera={name: poses[name] for name in image_topics},
            phase=tuple(_lasting(others[PHASE], messages.read_string, due, "")),
            is_deliberate_miss=np.array(misses, dtype=np.bool_),
        )
        return trajectory, others[EVENTS]

    def _columns(
        self, container: Container, due_ns: NDArray[np.int64] | None, others: Sequence[str]
    ) -> tuple[dict[str, Any], dict[str, TimedMessages]]:
        """Read all streams, and other topics as undecoded messages, in one pass."""
        found: dict[str, TimedMessages] = {topic: [] for topic in others}
        times = defaultdict[str, list[NDArray[np.int64]]](list)
        values = defaultdict[str, list[NDArray[Any]]](list)
        topics = (*(stream.topic for stream in self.streams), *others)
        with damage_as_recording_error(container.path):
            for blocks in container.blocks_by_chunk(topics, num_bytes=_TABLE_BYTES):
                for stream in self.streams:
                    block = blocks[stream.topic]
                    if stream.is_dense and due_ns is not None:
                        block = block.select(np.isin(block.time_ns, due_ns))
                    times[stream.topic].append(block.time_ns)
                    values[stream.topic].append(stream.layout.decode(block.rows(len(stream.layout.constant))))
                for topic, timed in found.items():
                    timed += zip(blocks[topic].time_ns.tolist(), blocks[topic].messages(), strict=True)
        time_ns = np.concatenate(times[self.frame_topic]) if due_ns is None else due_ns
        if len(time_ns) > 1 and int(np.diff(time_ns).min()) <= 0:
            raise RecordingError(f"The frames of the recording are not in chronological order: {container.path}")
        kinds = (
            ("sensed", "object_poses", "world_from_camera") if self._is_on_time else ("features", "stamps", "images")
        )
        columns: dict[str, Any] = {"time_ns": time_ns, **{kind: {} for kind in kinds}}
        for stream in self.streams:
            at = np.concatenate(times[stream.topic])
            if not np.array_equal(at, time_ns):
                raise RecordingError(
                    f"The recording has {len(at)} messages on {stream.topic} at other times than its {len(time_ns)} "
                    f"frames: {container.path}"
                )
            stream.add_columns(np.concatenate(values[stream.topic]), columns)
        return columns, found

    def whole_frames(
        self, counts: Counter[str], cameras: Mapping[str, CameraStreams]
    ) -> tuple[int, Callable[[ScannedMessage, int], bool]]:
        """Find the complete frames after a crash: those present in all streams, images included.

        In an episode that was not simulated, images precede their frames.

        Returns:
            Number of frames; and whether a message belongs to them, given its number in its topic, from 1.
        """
        topics = {stream.topic for stream in self.streams if not stream.is_dense}
        if not self._is_on_time:
            num_frames = min(counts[topic] for topic in topics)
            topics.add(TF)
            return num_frames, lambda message, count: message.channel.topic not in topics or count <= num_frames
        for camera, streams in cameras.items():
            topics.add(video_topic(camera, streams.video.codec))
            topics |= {camera_topic(camera, kind) for kind in ("depth", "segmentation") if getattr(streams, kind)}
        num_frames = min(counts[topic] for topic in topics)
        last_ns = frame_time_ns(max(num_frames - 1, 0), self._info.fps)
        return num_frames, lambda message, count: message.log_ns <= last_ns


def _lasting[V](found: TimedMessages, read: Callable[[bytes], V], times: NDArray[np.int64], first: V) -> list[V]:
    """Compute the value at each time, given the messages that report its changes."""
    values = [first, *(read(data) for _, data in found)]
    changes = np.array([time_ns for time_ns, _ in found], dtype=np.int64)
    numbers = np.searchsorted(np.maximum.accumulate(changes), times, side="right")
    return [values[number] for number in numbers.tolist()]


def _image_stamps(container: Container, topics: Mapping[str, str]) -> dict[str, NDArray[np.int64]]:
    """Read camera -> (P,) timestamps of its images, one chunk at a time: all images may take gigabytes."""
    found = defaultdict[str, list[NDArray[np.int64]]](list)
    for blocks in container.blocks_by_chunk(topics.values()):
        for name, topic in topics.items():
            found[name].append(blocks[topic].time_ns)
    return {name: np.concatenate(times) for name, times in found.items()}


def _check_images(
    shown: Mapping[str, NDArray[np.int64]], stamps: Mapping[str, NDArray[np.int64]], container: Container
) -> None:
    for name, numbers in shown.items():
        count = len(stamps[name])
        if len(numbers) and not NO_IMAGE <= int(numbers.min()) <= int(numbers.max()) < count:
            raise RecordingError(
                f"A frame refers to an image of the camera {name!r} outside its {count}: {container.path}"
            )
