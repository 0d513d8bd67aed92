"""Write an episode as it happens into NAME.mcap.part, which becomes NAME.mcap when it is complete.

Frames are collected for one second and then written at once, each stream as a batch, numbers and images in separate
chunks. So a reader of the numbers never decompresses an image, the recorder costs little, and a crash loses at most the
last second.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from functools import partial
from heapq import merge
from itertools import takewhile
from pathlib import Path
from typing import NamedTuple

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Metadata
from numpy.typing import ArrayLike, NDArray

from demorec.core.config import VideoConfig
from demorec.core.errors import ConfigError, RecordingError
from demorec.core.files import MCAP_MAGIC, Closing, open_regular
from demorec.core.geometry import Array
from demorec.episode.episode import Frame, Outcome, SampledFrame
from demorec.episode.info import EpisodeInfo, Origin
from demorec.episode.simulated import scene_of
from demorec.episode.validity import find_problems
from demorec.mcap import messages, metadata
from demorec.mcap.cdr import encode
from demorec.mcap.channels import LABELS, TF, TF_STATIC, Message, camera_topic, description_topic
from demorec.mcap.container import damage_as_recording_error
from demorec.mcap.description import body_description, robot_description
from demorec.mcap.images import CameraWriter
from demorec.mcap.lossless import segment_names, to_labels
from demorec.mcap.part_file import PartFile
from demorec.mcap.scan import RECORD_HEAD, read_record
from demorec.mcap.streams import FrameStream, frame_streams
from demorec.mcap.transforms import FrameTree, camera_frame

_SECOND_NS = 1_000_000_000
_BACKDROP_METRES = 3.0
"""Size, metres, above which bodies (floors, walls) are not described: a viewer would zoom out until the robot is a dot.
"""


class _PendingFrame(NamedTuple):
    """A queued frame without its images."""

    time_ns: int
    stamps: list[int]  # of each stream
    vectors: list[NDArray[np.generic]]  # of each stream
    images: Mapping[str, int]  # camera -> number of the image that the frame shows
    changes: list[Message]  # written only when something changes
    dense: list[tuple[int, bytes]]  # time_ns and data of messages on the dense stream since the previous frame


class BatchWriter(Closing, ABC):
    """Context manager that writes one episode in batches of a second.

    Args:
        path: The file to create; its folder must exist.
        info: Description of the episode.
        video: Encoding of images that arrive as pixels.
        overwrite: Whether a recording of that name may be replaced.
        keeps_part: Whether NAME.mcap.part stays for `recover` if the context exits without `finish`.

    Attributes:
        num_frames: Number of written frames.

    Raises:
        ConfigError: The description is invalid, or a file of that name, or an unfinished one, exists and must not be
            replaced. The remains of a killed import, replay or rendering of the same origin are replaced.
        RecordingError: The file cannot be written.
    """

    def __init__(
        self,
        path: Path,
        info: EpisodeInfo,
        *,
        video: VideoConfig | None = None,
        overwrite: bool = False,
        keeps_part: bool = True,
    ) -> None:
        if wrong := find_problems(info):
            raise ConfigError(f"The episode cannot be recorded: {'; '.join(wrong)}.")
        self.num_frames = 0
        self._info, self._video, self._keeps_part = info, video or VideoConfig(), keeps_part
        self._cameras: dict[str, CameraWriter] = {}
        self._pending: list[_PendingFrame] = []
        self._is_described = False
        self._streams = frame_streams(info)
        self._tree = self._prepare(info)
        self._file = PartFile(path, overwrite=overwrite, is_worthless=partial(_can_be_made_again, origin=info.origin))

    @abstractmethod
    def _prepare(self, info: EpisodeInfo) -> FrameTree | None:
        """Prepare for an episode before a file is opened; None without the robot's URDF."""

    @abstractmethod
    def _state(self, vectors: Mapping[str, Array]) -> tuple[Array, Array]:
        """Return joint positions (N, n) and world_from_object of all movable bodies (N, 7 k), given topic -> (N, K)."""

    @abstractmethod
    def flush(self) -> None:
        """Write all complete frames, which then survive the end of this process; RecordingError if the disk is full."""

    def _add(
        self,
        frame: Frame | SampledFrame,
        images: Mapping[str, int],
        changes: list[Message],
        dense: list[tuple[int, bytes]],
    ) -> None:
        """Queue a frame; RecordingError if its numbers are not those of the streams."""
        if not self._is_described:
            self._write_description()
        stamps = [stream.stamp_ns(frame) for stream in self._streams]
        vectors = [self._vector(stream, stream.values(frame)) for stream in self._streams]
        self._pending.append(_PendingFrame(frame.time_ns, stamps, vectors, images, changes, dense))
        self.num_frames += 1
        if len(self._pending) >= self._info.fps or frame.time_ns - self._pending[0].time_ns >= _SECOND_NS:
            self.flush()

    def _vector(self, stream: FrameStream, parts: Sequence[ArrayLike]) -> NDArray[np.generic]:
        vector = np.concatenate(parts)
        count = len(stream.layout.value_slots)
        if len(vector) != count:
            raise RecordingError(
                f"Frame {self.num_frames} has {len(vector)} numbers for {stream.topic}, it must have {count}."
            )
        if not np.isfinite(vector).all():
            raise RecordingError(f"Frame {self.num_frames} has a number for {stream.topic} that is not finite.")
        return vector

    def _write_description(self) -> None:
        """Write the latched messages; on failure the file is removed."""
        self._is_described = True
        streams = {name: camera.streams for name, camera in self._cameras.items()}
        try:
            self._file.metadata(metadata.EPISODE, metadata.episode_metadata(self._info, streams))
            has_labels = any(camera.segmentation for camera in streams.values())
            for topic, schema, data in _latched_messages(self._info, self._tree, has_labels=has_labels):
                self._file.log(topic, schema, data, 0, latched=True)
            self._file.flush()
        except BaseException:
            self._file.discard()
            raise

    def _write_images(self, until: Mapping[str, int]) -> None:
        taken = [self._cameras[name].take(number) for name, number in until.items()]
        for stamp_ns, found in merge(*taken, key=lambda image: image[0]):
            for topic, schema, data in found:
                self._file.log(topic, schema, data, stamp_ns)
        if any(taken):
            self._file.flush()

    def _write_frames(self) -> list[_PendingFrame]:
        """Write the frames with fully encoded images, and return them."""
        frames = list(takewhile(self._has_its_images, self._pending))
        if not frames:
            return frames
        logs = [self._file.logger(stream.topic, stream.schema) for stream in self._streams]
        encoded, found = [], {}
        for number, stream in enumerate(self._streams):
            stamps = np.array([frame.stamps[number] for frame in frames], dtype=np.int64)
            found[stream.topic] = np.array([frame.vectors[number] for frame in frames])
            encoded.append(stream.layout.encode(stamps, found[stream.topic]))
        if self._tree is not None and self._tree.layout is not None:
            times = np.array([frame.time_ns for frame in frames], dtype=np.int64)
            logs.append(self._file.logger(TF, messages.TRANSFORMS))
            encoded.append(self._tree.layout.encode(times, self._tree.rows(*self._state(found))))
        for frame, *rows in zip(frames, *encoded, strict=True):
            for sample_ns, sample in frame.dense:
                logs[0](sample, log_time=sample_ns)
            for log, data in zip(logs, rows, strict=True):
                log(data, log_time=frame.time_ns)
            for topic, schema, data in frame.changes:
                self._file.log(topic, schema, data, frame.time_ns)
        self._file.flush()
        del self._pending[: len(frames)]
        return frames

    def _has_its_images(self, frame: _PendingFrame) -> bool:
        return all(number < self._cameras[name].num_ready for name, number in frame.images.items())

    def finish(self, outcome: Outcome) -> Path:
        """Write the rest, make the file durable and rename it; returns its final path.

        Raises:
            ConfigError: A file of that name has appeared meanwhile.
            RecordingError: The outcome has a different number of frames, an encoder does not return all images, or the
                disk is full.
        """
        if outcome.num_frames != self.num_frames:
            raise RecordingError(
                f"The outcome has {outcome.num_frames} frames, but the recording has {self.num_frames}."
            )
        for camera in self._cameras.values():
            camera.end()
        if not self._is_described:
            self._write_description()
        self.flush()
        if self._pending:
            raise RecordingError(
                f"The video encoder did not return the images of the last {len(self._pending)} frames."
            )
        for camera in self._cameras.values():
            if (statistics := camera.statistics()) is not None:
                self._file.log(*statistics, camera.last_ns)
        self._file.metadata(metadata.OUTCOME, metadata.outcome_metadata(outcome))
        self._file.publish()
        return self._file.path

    def close(self) -> None:
        """End the file and keep it as NAME.mcap.part, or remove it; safe to call twice, and after `finish`."""
        if self._keeps_part:
            self._file.close()
        else:
            self._file.discard()

    def discard(self) -> None:
        """Abandon the episode and remove its file."""
        self._file.discard()


def _can_be_made_again(part: Path, *, origin: str | Origin) -> bool:
    """Check whether an unfinished recording is still empty, or was derived from the given origin."""
    with open_regular(part) as file, suppress(RecordingError), damage_as_recording_error(part):
        size = file.seek(0, 2)
        file.seek(len(MCAP_MAGIC))
        while len(head := file.read(RECORD_HEAD.size)) == RECORD_HEAD.size:
            opcode, length = RECORD_HEAD.unpack(head)
            if opcode == Opcode.DATA_END:
                break
            if opcode not in (Opcode.HEADER, Opcode.METADATA) or length > size - file.tell():
                return False
            content = file.read(length)
            if opcode == Opcode.METADATA:
                info, _, _ = metadata.read_episode_metadata(read_record(content, Metadata).metadata)
                return info.origin == origin and origin not in ("", Origin())
        return True  # the writer ended before the first frame
    return False


def _latched_messages(info: EpisodeInfo, tree: FrameTree | None, *, has_labels: bool) -> Iterator[Message]:
    """Yield the messages that apply to the whole episode."""
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
