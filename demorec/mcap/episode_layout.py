"""Topics of an episode's file, and the times of its messages and images."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Mapping
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from demorec.core.errors import RecordingError
from demorec.episode.episode import NO_IMAGE, Table, Trajectory, frame_time_ns
from demorec.episode.info import EpisodeInfo
from demorec.mcap import messages
from demorec.mcap.channels import DELIBERATE_MISS, EVENTS, FRAMES, GRIPPER, PHASE, TF, camera_topic, video_topic
from demorec.mcap.container import Container
from demorec.mcap.sampled_streams import sampled_streams
from demorec.mcap.simulated_streams import simulated_streams
from demorec.mcap.streams import FrameStream, TimedMessages, frame_times, read_columns

if TYPE_CHECKING:
    from demorec.mcap.metadata import CameraStreams
    from demorec.mcap.scan import ScannedMessage


class EpisodeLayout:
    """Layout of one episode's file.

    In a simulated episode all messages and images are at the times of the frames. In any other one the cameras decide
    the times of images, and `/frames` lists the samples and images of each frame.

    Attributes:
        frame_topic: Topic with one message per frame.
        event_topics: Topics of events.
    """

    def __init__(self, info: EpisodeInfo) -> None:
        self._info = info
        self._is_on_time = info.simulation is not None  # all messages at the times of the frames
        self.frame_topic = GRIPPER if self._is_on_time else FRAMES
        self.event_topics = (EVENTS,) if self._is_on_time else ()

    @cached_property
    def streams(self) -> tuple[FrameStream, ...]:
        """Streams that become columns; the first one of a simulated episode is dense."""
        return tuple(simulated_streams(self._info) if self._is_on_time else sampled_streams(self._info))

    def due_ns(self, num_frames: int) -> NDArray[np.int64] | None:
        """Compute (T,) due times of all images; None if the cameras decide."""
        return frame_times(num_frames, self._info.fps) if self._is_on_time else None

    def read(
        self, container: Container, num_frames: int, image_topics: Mapping[str, str]
    ) -> tuple[Table | Trajectory, TimedMessages]:
        """Read the numbers, and the messages of events, which are stored among them.

        Args:
            container: The open file.
            num_frames: T.
            image_topics: Recorded camera -> topic of its images, in the order of the description.

        Raises:
            RecordingError: A stream is damaged or does not match the times of the frames, or a frame shows an unknown
                image.
        """
        due, changes = self.due_ns(num_frames), (PHASE, DELIBERATE_MISS) if self._is_on_time else ()
        columns, others = read_columns(
            container,
            self.streams,
            due_ns=due,
            frame_topic=self.frame_topic,
            others=(*changes, *self.event_topics),
        )
        if due is None:
            image_stamps = _image_stamps(container, image_topics)
            _check_images(columns["images"], image_stamps, container)
            return Table(**columns, image_stamps=image_stamps), []
        for name in ("sensed", "object_poses", "world_from_camera"):
            columns.setdefault(name, {})
        poses = columns.pop("world_from_camera")
        misses = _lasting(others[DELIBERATE_MISS], messages.read_boolean, due, False)
        trajectory = Trajectory(
            **columns,
            world_from_camera={name: poses[name] for name in image_topics},
            phase=tuple(_lasting(others[PHASE], messages.read_string, due, "")),
            is_deliberate_miss=np.array(misses, dtype=np.bool_),
        )
        return trajectory, others[EVENTS]

    def whole_frames(
        self, counts: Counter[str], cameras: Mapping[str, CameraStreams]
    ) -> tuple[int, Callable[[ScannedMessage, int], bool]]:
        """Find the complete frames after a crash: those present in all streams, images included.

        In an episode that was not simulated, images precede their frames.

        Args:
            counts: Topic -> number of its messages.
            cameras: Recorded cameras.

        Returns:
            Number of frames; and a function that checks whether a message belongs to them, given its number in its
            topic, from 1.
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
