"""Writes an episode as it happens into NAME.mcap.part, which becomes NAME.mcap when it is complete.

Frames are gathered for one second and then written at once, each stream as a batch, the numbers and the images in
chunks of their own: so a reader of the numbers never decompresses an image, the recorder costs little, and a crash
loses at most the last second.

A simulated episode has its images with its frames, which are written behind the numbers of the same second. Of any
other, images come when they come, and one may be held by several frames: they are written in front of the frames that
hold them, so that whatever a crash leaves of the frames has its images.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from heapq import merge
from itertools import takewhile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from demorec.core.config import VideoConfig
from demorec.core.errors import ConfigError, RecordingError
from demorec.core.files import Closing
from demorec.episode.episode import Event, Frame, JointSample, Outcome, SampledFrame, frame_time_ns
from demorec.episode.info import EpisodeInfo
from demorec.episode.validity import find_problems
from demorec.mcap import channels, messages, metadata
from demorec.mcap.cdr import encode
from demorec.mcap.channels import Message
from demorec.mcap.frame_check import FrameCheck, SampledFrameCheck, check_images, check_joint_names
from demorec.mcap.images import CameraWriter
from demorec.mcap.part_file import PartFile
from demorec.mcap.recover import can_be_made_again
from demorec.mcap.streams import SUBTASK, FrameValues, frame_streams
from demorec.mcap.transforms import FrameTree

_SECOND_NS = 1_000_000_000


class _Pending(NamedTuple):
    """A frame that waits to be written, without its images."""

    time_ns: int
    values: FrameValues | SampledFrame
    images: Mapping[str, int]  # camera -> number of the image that it holds
    changes: list[Message]  # of what is written only when it changes
    joint_samples: tuple[JointSample, ...] = ()


class EpisodeWriter(Closing):
    """Context manager that writes one episode.

    Frames must not be changed after they were given. Depth and segmentation of simulated cameras are recorded when the
    first frame has them.

    Args:
        path: The file to be made; its folder must exist.
        info: Written first.
        video: How images are encoded that come as pixels.
        overwrite: Whether a recording of that name may be replaced.
        begins: Whether all of `info` is known. Else only file and encoders are opened, and `begin` must follow.
        keeps_part: Whether NAME.mcap.part stays for `recover` when it is left without `finish`.

    Attributes:
        num_frames: So far.

    Raises:
        ConfigError: The description is impossible, or the file, or an unfinished one of that name, is there already and
            not to be replaced. What a killed import, replay or rendering of the same origin left is replaced.
        RecordingError: It cannot be written, or the robot's joints are not those of its URDF.
    """

    def __init__(
        self,
        path: Path,
        info: EpisodeInfo,
        *,
        video: VideoConfig | None = None,
        overwrite: bool = False,
        begins: bool = True,
        keeps_part: bool = True,
    ) -> None:
        self.num_frames, self._keeps_part = 0, keeps_part
        self._info, self._video = info, video or VideoConfig()
        self._pending: list[_Pending] = []
        self._is_begun = False
        self._phase: str | None = None
        self._is_miss: bool | None = None
        if begins:
            self._describe(info)
        # Which images a simulation gives, its first frame says.
        cameras = () if info.simulation is not None else info.cameras
        self._cameras = {camera.name: CameraWriter(camera, self._video, info.fps) for camera in cameras}
        self._file = PartFile(path, overwrite=overwrite, is_worthless=partial(can_be_made_again, origin=info.origin))
        if begins and info.simulation is None:
            self._write_description()

    def begin(self, info: EpisodeInfo) -> None:
        """Say what the episode is, of which only the cameras were known; before its first image and frame.

        Raises:
            ConfigError: The description is impossible.
            RecordingError: The disk is full; nothing of the episode is left then.
        """
        self._describe(info)
        self._write_description()

    def _describe(self, info: EpisodeInfo) -> None:
        self._info = info
        if info.simulation is not None:
            check_joint_names(info)
            self._check_simulated = FrameCheck(info)
        elif wrong := find_problems(info):
            raise ConfigError(f"The episode cannot be recorded: {'; '.join(wrong)}.")
        else:
            self._check = SampledFrameCheck(info)
        self._tree = FrameTree(info) if info.simulation is not None or info.urdf else None
        self._streams = frame_streams(info, self._tree)

    def _write_description(self) -> None:
        """Write what is said once, or leave nothing."""
        self._is_begun = True
        try:
            streams = {name: camera.streams for name, camera in self._cameras.items()}
            self._file.metadata(metadata.EPISODE, metadata.episode_metadata(self._info, streams))
            has_labels = any(camera.segmentation for camera in streams.values())
            for topic, schema, data in channels.latched_messages(self._info, self._tree, has_labels=has_labels):
                self._file.log(topic, schema, data, 0, latched=True)
            self._file.flush()
        except BaseException:
            self._file.discard()
            raise

    def image(self, camera: str, stamp_ns: int, data: NDArray[Any] | bytes) -> int:
        """Add the next image of a camera, and return its number, by which frames hold it; not of a simulated episode.

        Args:
            camera: One of the episode's.
            stamp_ns: When it was taken, by the camera's clock; later than the one before.
            data: (H, W, 3) uint8 RGB; for a camera whose images are kept an access unit (H.264 and H.265 with start
                codes), a temporal unit (AV1) or a JPEG file, which stays as it is; for a depth camera (H, W) uint16
                millimetres or float32 metres.

        Raises:
            RecordingError: An unknown camera, another size or type, or a stamp that goes backwards.
        """
        self._check.check_image(camera, stamp_ns, data)
        self._check.note_image(camera, stamp_ns)
        return self._cameras[camera].add(int(stamp_ns), data)

    def write(self, frame: Frame | SampledFrame) -> None:
        """Add the next frame: a `Frame` with its images of a simulated episode, a `SampledFrame` of any other.

        Raises:
            RecordingError: Frames out of order; vectors, objects, features or cameras that are missing, unknown, of
                another length or type; numbers that are not finite; images missing or of another size; a full disk.
        """
        self._pending.append(self._of_simulation(frame) if isinstance(frame, Frame) else self._of_samples(frame))
        self.num_frames += 1
        if len(self._pending) >= self._info.fps or frame.time_ns - self._pending[0].time_ns >= _SECOND_NS:
            self.flush()

    def _of_samples(self, frame: SampledFrame) -> _Pending:
        self._check.check_frame(frame)
        self._check.note_frame(frame)
        text = frame.subtask
        changes = [(SUBTASK, messages.STRING, encode(messages.STRING, text))] if text else []
        return _Pending(frame.time_ns, frame, frame.images, changes)

    def _of_simulation(self, frame: Frame) -> _Pending:
        due = (self.num_frames, frame_time_ns(self.num_frames, self._info.fps))
        if (frame.frame_index, frame.time_ns) != due:
            raise RecordingError(
                f"Frame {frame.frame_index} at {frame.time_ns} ns came where frame {due[0]} at {due[1]} ns was due: "
                "frames are written in order, one each."
            )
        self._check_simulated(frame)
        if not self._is_begun:
            self._open_cameras(frame)
            self._write_description()
        cameras = {name: check_images(frame, one.camera, one.streams) for name, one in self._cameras.items()}
        numbers = {
            name: self._cameras[name].add(
                frame.time_ns, images.color, depth=images.depth, segmentation=images.segmentation
            )
            for name, images in cameras.items()
        }
        return _Pending(frame.time_ns, FrameValues.of(frame), numbers, self._changes(frame), frame.joint_samples)

    def _open_cameras(self, first: Frame) -> None:
        for camera in self._info.cameras:
            if (images := first.images.get(camera.name)) is None:
                raise RecordingError(f"Frame 0 has no image of the camera {camera.name!r}.")
            beside = [kind for kind in ("depth", "segmentation") if getattr(images, kind) is not None]
            self._cameras[camera.name] = CameraWriter(camera, self._video, self._info.fps, beside=beside)

    def _changes(self, frame: Frame) -> list[Message]:
        if frame.phase == self._phase and frame.is_deliberate_miss == self._is_miss and not frame.events:
            return []  # nearly always
        result = []
        if any(event.name == channels.PHASE_EVENT for event in frame.events):
            raise RecordingError(f"Frame {frame.frame_index} has an event {channels.PHASE_EVENT!r}, a reserved name.")
        events = list(frame.events)
        if frame.phase != self._phase:
            self._phase = frame.phase
            events.insert(0, Event(name=channels.PHASE_EVENT, message=frame.phase))
            result.append((channels.PHASE, messages.STRING, encode(messages.STRING, frame.phase)))
        if frame.is_deliberate_miss != self._is_miss:
            self._is_miss = frame.is_deliberate_miss
            data = encode(messages.BOOL, frame.is_deliberate_miss)
            result.append((channels.DELIBERATE_MISS, messages.BOOL, data))
        return result + [(channels.EVENTS, messages.LOG, messages.log(frame.time_ns, event)) for event in events]

    def flush(self) -> None:
        """Write what is complete: when this returns, it survives the end of this process.

        Raises:
            RecordingError: The disk is full or gone.
        """
        is_simulated = self._info.simulation is not None
        if not is_simulated:
            self._write_images({name: camera.num_ready for name, camera in self._cameras.items()})
        frames = list(takewhile(self._has_its_images, self._pending))
        if not frames:
            return
        self._write_numbers(frames)
        if is_simulated:
            self._write_images({name: number + 1 for name, number in frames[-1].images.items()})
        del self._pending[: len(frames)]

    def _has_its_images(self, frame: _Pending) -> bool:
        """Whether all images of a frame have left the encoders."""
        return all(number < self._cameras[name].num_ready for name, number in frame.images.items())

    def _write_images(self, until: Mapping[str, int]) -> None:
        """Write the images of each camera before that number, in the order of their stamps."""
        taken = [self._cameras[name].take(number) for name, number in until.items()]
        for stamp_ns, found in merge(*taken, key=lambda image: image[0]):
            for topic, schema, data in found:
                self._file.log(topic, schema, data, stamp_ns)
        if any(taken):
            self._file.flush()

    def _write_numbers(self, frames: list[_Pending]) -> None:
        time_ns = [frame.time_ns for frame in frames]
        values = [frame.values for frame in frames]
        logs = [self._file.logger(stream.topic, stream.schema) for stream in self._streams]
        encoded = [stream.encode(values, time_ns) for stream in self._streams]
        samples = iter(self._sample_messages(frames))
        for time, frame, *rows in zip(time_ns, frames, *encoded, strict=True):
            for sample in frame.joint_samples:
                logs[0](next(samples), log_time=sample.time_ns)
            for log, data in zip(logs, rows, strict=True):
                log(data, log_time=time)
            for topic, schema, data in frame.changes:
                self._file.log(topic, schema, data, time)
        self._file.flush()

    def _sample_messages(self, frames: list[_Pending]) -> list[bytes]:
        """Joint states between the frames, in the layout of those at the frames."""
        samples = [sample for frame in frames for sample in frame.joint_samples]
        if not samples:
            return []
        values = np.array([(s.joint_position, s.joint_velocity, s.joint_effort) for s in samples])
        times = np.array([sample.time_ns for sample in samples], dtype=np.int64)
        return self._streams[0].layout.encode(times, values.reshape(len(samples), -1))

    def finish(self, outcome: Outcome) -> Path:
        """Write the rest, make the file durable and give it its name, which is returned.

        Raises:
            ConfigError: A file of that name has appeared meanwhile.
            RecordingError: The outcome speaks of another number of frames, an encoder keeps images to itself, or the
                disk is full.
        """
        if outcome.num_frames != self.num_frames:
            raise RecordingError(f"The outcome has {outcome.num_frames} frames, the recording {self.num_frames}.")
        for camera in self._cameras.values():
            camera.end()
        if not self._is_begun:
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
        """Give the episode up and remove what was written of it."""
        self._file.discard()
