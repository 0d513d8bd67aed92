"""Write an episode as it happens into NAME.mcap.part, which becomes NAME.mcap when it is complete.

Frames are gathered for one second and then written at once, each stream as a batch, the numbers and the images in
chunks of their own. So a reader of the numbers never decompresses an image, the recorder costs little, and a crash
loses at most the last second.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from heapq import merge
from itertools import takewhile
from pathlib import Path
from typing import NamedTuple

import numpy as np

from demorec.core.config import VideoConfig
from demorec.core.errors import ConfigError, RecordingError
from demorec.core.files import Closing
from demorec.episode.episode import Outcome, SampledFrame
from demorec.episode.info import EpisodeInfo
from demorec.episode.simulated import scene_of
from demorec.episode.validity import find_problems
from demorec.mcap import messages, metadata
from demorec.mcap.cdr import encode
from demorec.mcap.channels import LABELS, TF_STATIC, Message, camera_topic, description_topic
from demorec.mcap.description import body_description, robot_description
from demorec.mcap.images import CameraWriter
from demorec.mcap.lossless import segment_names, to_labels
from demorec.mcap.part_file import PartFile
from demorec.mcap.recover import can_be_made_again
from demorec.mcap.simulated_streams import FrameValues
from demorec.mcap.streams import FrameStream
from demorec.mcap.transforms import FrameTree, camera_frame

_SECOND_NS = 1_000_000_000
_BACKDROP_METRES = 3.0
"""Size above which bodies (floors, walls) are not described: a viewer would place itself so far off that the robot is a
dot."""


class PendingFrame(NamedTuple):
    """A frame that waits to be written, without its images."""

    time_ns: int
    values: FrameValues | SampledFrame
    images: Mapping[str, int]  # camera -> number of the image that the frame shows
    changes: list[Message]  # written only when something changes
    dense: list[tuple[int, bytes]]  # time_ns and data of messages on the dense stream since the frame before


class BatchWriter(Closing, ABC):
    """Context manager that writes one episode in batches of a second.

    Frames must not be changed after they were given.

    Args:
        path: The file to be made; its folder must exist.
        info: Description of the episode.
        video: How images are encoded that come as pixels.
        overwrite: Whether a recording of that name may be replaced.
        keeps_part: Whether NAME.mcap.part stays for `recover` when it is left without `finish`.

    Attributes:
        num_frames: Number of written frames.

    Raises:
        ConfigError: The description is impossible, or a file of that name, or an unfinished one, is there already and
            not to be replaced. What a killed import, replay or rendering of the same origin left is replaced.
        RecordingError: It cannot be written.
    """

    _tree: FrameTree | None
    _streams: Sequence[FrameStream]

    def __init__(
        self,
        path: Path,
        info: EpisodeInfo,
        *,
        video: VideoConfig | None = None,
        overwrite: bool = False,
        keeps_part: bool = True,
    ) -> None:
        self.num_frames = 0
        self._info, self._video, self._keeps_part = info, video or VideoConfig(), keeps_part
        self._cameras: dict[str, CameraWriter] = {}
        self._pending: list[PendingFrame] = []
        self._is_described = False
        self._prepare(info)
        self._file = PartFile(path, overwrite=overwrite, is_worthless=partial(can_be_made_again, origin=info.origin))

    @abstractmethod
    def _prepare(self, info: EpisodeInfo) -> None:
        """Prepare for an episode before a file is opened. Raises ConfigError if the description is impossible."""

    @abstractmethod
    def flush(self) -> None:
        """Write everything complete, which then survives the end of this process.

        Raises:
            RecordingError: The disk is full or gone.
        """

    def _add(self, frame: PendingFrame) -> None:
        self._pending.append(frame)
        self.num_frames += 1
        if len(self._pending) >= self._info.fps or frame.time_ns - self._pending[0].time_ns >= _SECOND_NS:
            self.flush()

    def _write_description(self) -> None:
        """Write the messages that come once, or leave nothing."""
        self._is_described = True
        streams = {name: camera.streams for name, camera in self._cameras.items()}
        try:
            self._file.metadata(metadata.EPISODE, metadata.episode_metadata(self._info, streams))
            has_labels = any(camera.segmentation for camera in streams.values())
            for topic, schema, data in latched_messages(self._info, self._tree, has_labels=has_labels):
                self._file.log(topic, schema, data, 0, latched=True)
            self._file.flush()
        except BaseException:
            self._file.discard()
            raise

    def _write_images(self, until: Mapping[str, int]) -> None:
        """Write the images of each camera before that number, in the order of their stamps."""
        taken = [self._cameras[name].take(number) for name, number in until.items()]
        for stamp_ns, found in merge(*taken, key=lambda image: image[0]):
            for topic, schema, data in found:
                self._file.log(topic, schema, data, stamp_ns)
        if any(taken):
            self._file.flush()

    def _write_frames(self) -> list[PendingFrame]:
        """Write the frames whose images have left the encoders, and return them."""
        frames = list(takewhile(self._has_its_images, self._pending))
        if not frames:
            return frames
        time_ns = [frame.time_ns for frame in frames]
        values = [frame.values for frame in frames]
        logs = [self._file.logger(stream.topic, stream.schema) for stream in self._streams]
        encoded = [stream.encode(values, time_ns) for stream in self._streams]
        for time, frame, *rows in zip(time_ns, frames, *encoded, strict=True):
            for sample_ns, sample in frame.dense:
                logs[0](sample, log_time=sample_ns)
            for log, data in zip(logs, rows, strict=True):
                log(data, log_time=time)
            for topic, schema, data in frame.changes:
                self._file.log(topic, schema, data, time)
        self._file.flush()
        del self._pending[: len(frames)]
        return frames

    def _has_its_images(self, frame: PendingFrame) -> bool:
        return all(number < self._cameras[name].num_ready for name, number in frame.images.items())

    def finish(self, outcome: Outcome) -> Path:
        """Write the rest, make the file durable and give it its name, which is returned.

        Raises:
            ConfigError: A file of that name has appeared meanwhile.
            RecordingError: The outcome has another number of frames, an encoder keeps images to itself, or the disk is
                full.
        """
        if outcome.num_frames != self.num_frames:
            raise RecordingError(f"The outcome has {outcome.num_frames} frames, the recording {self.num_frames}.")
        for camera in self._cameras.values():
            camera.end()
        if not self._is_described:
            self._write_description()
        self.flush()
        if self._pending:
            raise RecordingError(f"The video encoder kept images of the last {len(self._pending)} frames to itself.")
        for camera in self._cameras.values():
            if (statistics := camera.statistics()) is not None:
                self._file.log(*statistics, camera.last_ns)
        self._file.metadata(metadata.OUTCOME, metadata.outcome_metadata(outcome))
        self._file.publish()
        return self._file.path

    def close(self) -> None:
        """End it, and leave NAME.mcap.part as it is or nothing; harmless when called twice, and after `finish`."""
        if self._keeps_part:
            self._file.close()
        else:
            self._file.discard()

    def discard(self) -> None:
        """Give the episode up and remove its file."""
        self._file.discard()


def check_description(info: EpisodeInfo) -> None:
    """Raise ConfigError for an episode that cannot be recorded."""
    if wrong := find_problems(info):
        raise ConfigError(f"The episode cannot be recorded: {'; '.join(wrong)}.")


def latched_messages(info: EpisodeInfo, tree: FrameTree | None, *, has_labels: bool) -> Iterator[Message]:
    """Messages that hold for the whole episode, written before the first frame.

    Args:
        info: Description of the episode.
        tree: Coordinate frames; None for a robot without a URDF.
        has_labels: Whether there are segmentation images.
    """
    scene = scene_of(info)
    if tree is not None:
        yield TF_STATIC, messages.TRANSFORMS, messages.transforms(tree.static)
        urdf = info.urdf or robot_description(info.simulated.robot.urdf, info.simulated.scene.robot.scale)
        yield description_topic(), messages.STRING, encode(messages.STRING, urdf)
    for body in () if scene is None else scene.bodies:
        if max(body.shape.extents) <= _BACKDROP_METRES:
            yield description_topic(body.name), messages.STRING, encode(messages.STRING, body_description(body))
    for camera in info.cameras:
        if camera.intrinsics is not None:
            size, intrinsics = (camera.height, camera.width), np.array(camera.intrinsics).reshape(3, 3)
            distortion = camera.distortion or (0.0,) * 5
            data = messages.camera_info(camera_frame(camera.name), size, intrinsics, distortion)
            yield camera_topic(camera.name, "camera_info"), messages.CAMERA_INFO, data
    if has_labels:
        values, names = zip(*segment_names(info), strict=True)
        numbers = to_labels(np.array([values], dtype=np.int32))[0].tolist()
        yield LABELS, messages.LABEL_INFO, messages.label_info(list(zip(numbers, names, strict=True)))
