"""Writes an episode as it happens into NAME.mcap.part, which becomes NAME.mcap when it is complete.

Frames are gathered for one simulated second and then written at once, each stream as a batch, the numbers and the
images in chunks of their own: so a reader of the numbers never decompresses an image, the recorder costs little,
and a crash loses at most the last second.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from demorec.core.config import VideoConfig
from demorec.core.errors import RecordingError
from demorec.episode.episode import CameraImages, Event, Frame, JointSample, frame_time_ns
from demorec.episode.info import Camera, EpisodeInfo
from demorec.mcap import channels, messages, metadata
from demorec.mcap.cdr import encode
from demorec.mcap.channels import camera_topic
from demorec.mcap.file_writer import FileWriter
from demorec.mcap.frame_check import FrameCheck, check_joint_names
from demorec.mcap.lossless import DEPTH_FORMAT, LABELS_FORMAT, encode_depth, encode_labels
from demorec.mcap.metadata import CameraStreams
from demorec.mcap.pictures import Message, PictureCoder
from demorec.mcap.streams import FrameValues, frame_streams, tf_stream
from demorec.mcap.transforms import FrameTree, camera_frame

_OTHERS: dict[str, tuple[str, Callable[[Any], bytes]]] = {
    "depth": (DEPTH_FORMAT, encode_depth),
    "segmentation": (LABELS_FORMAT, encode_labels),
}
"""Images beside colour: stream -> its format, and how one is encoded."""


class CameraRecorder(PictureCoder):
    """Codes what a camera sees and keeps it until it is written.

    Attributes:
        streams: What is recorded; depth and segmentation when the first frame has them.
    """

    def __init__(self, camera: Camera, first: CameraImages, *, video: VideoConfig, fps: int) -> None:
        self._camera = camera
        super().__init__(camera, video, fps, compiled=True)
        self.streams = CameraStreams(
            video=self.settings, depth=first.depth is not None, segmentation=first.segmentation is not None
        )
        frame_id = camera_frame(camera.name)
        self._layouts = {kind: messages.PictureMessages(frame_id, form) for kind, (form, _) in _OTHERS.items()}
        self._others: list[list[Message]] = []

    def add(self, frame: Frame) -> None:
        """Take the camera's images of the next frame.

        Raises:
            RecordingError: An image is missing or of another size.
        """
        name = self._camera.name
        images = frame.images.get(name)
        if images is None:
            raise RecordingError(f"Frame {frame.frame_index} has no image of the camera {name!r}.")
        self._check(frame.frame_index, "colour", images.color, True)
        for kind in _OTHERS:
            self._check(frame.frame_index, kind, getattr(images, kind), getattr(self.streams, kind))
        self._code(images.color)
        self.last_ns = frame.time_ns
        others: list[Message] = []
        for kind, (_, pack) in _OTHERS.items():
            if (pixels := getattr(images, kind)) is not None:
                data = self._layouts[kind].compressed_image(frame.time_ns, pack(pixels))
                others.append((camera_topic(name, kind), messages.COMPRESSED_IMAGE, data))
        self._others.append(others)

    def _check(self, frame_index: int, kind: str, pixels: NDArray[Any] | None, is_recorded: bool) -> None:
        size = (self._camera.height, self._camera.width)
        if (pixels is not None) != is_recorded or (pixels is not None and pixels.shape[:2] != size):
            found = "is missing" if pixels is None else f"has shape {pixels.shape}"
            raise RecordingError(
                f"The {kind} image of the camera {self._camera.name!r} at frame {frame_index} {found}: every frame "
                f"has the same images of {size[1]}x{size[0]} pixels."
            )

    def take_messages(self, time_ns: list[int]) -> Iterator[list[Message]]:
        """The messages of the oldest frames that are not yet written, one list a frame."""
        count = len(time_ns)
        for time, packet, others in zip(time_ns, self._packets[:count], self._others[:count], strict=True):
            yield self.topics.of(time, packet) + others
        del self._packets[:count]
        del self._others[:count]


class _Pending(NamedTuple):
    """A frame that waits to be written, without its images.

    Attributes:
        time_ns: When.
        values: What the streams that have one message a frame are made of.
        joint_samples: Joint states since the frame before.
        changes: (topic, type, message) of events and of what is written only when it changes.
    """

    time_ns: int
    values: FrameValues
    joint_samples: tuple[JointSample, ...]
    changes: list[tuple[str, str, bytes]]


class SimulatedWriter(FileWriter[CameraRecorder]):
    """Context manager that writes one episode; leaving it without `finish` leaves NAME.mcap.part for `recover`.

    Depth and segmentation are recorded when the first frame has them.

    Args:
        path: The file to be made; its folder must exist.
        info: Written first.
        video: How colour images are encoded.
        overwrite: Whether a recording of that name may be replaced.

    Raises:
        ConfigError: The file, or an unfinished one of that name, is there already and not to be replaced. What a killed
            replay or rendering of the same recording left is replaced.
        RecordingError: It cannot be written, or the robot's joints are not those of its URDF.
    """

    def __init__(
        self, path: Path, info: EpisodeInfo, *, video: VideoConfig | None = None, overwrite: bool = False
    ) -> None:
        check_joint_names(info)
        self._info = info
        self._check = FrameCheck(info)
        self._video = video or VideoConfig()
        self._tree = FrameTree(info)
        self._streams = [*frame_streams(info), tf_stream(self._tree)]
        self._cameras: dict[str, CameraRecorder] = {}
        self._pending: list[_Pending] = []
        self._num_written = 0
        self._phase: str | None = None
        self._is_miss: bool | None = None
        super().__init__(path, info, overwrite=overwrite)

    def write(self, frame: Frame) -> None:
        """Add the next frame.

        Raises:
            RecordingError: Frames out of order, vectors of another length, other objects or cameras than the scene's,
                numbers that are not finite, images missing or of another size, or a full disk.
        """
        due = (self.num_frames, frame_time_ns(self.num_frames, self._info.fps))
        if (frame.frame_index, frame.time_ns) != due:
            raise RecordingError(
                f"Frame {frame.frame_index} at {frame.time_ns} ns came where frame {due[0]} at {due[1]} ns was due: "
                "frames are written in order, one each."
            )
        self._check(frame)
        if self.num_frames == 0:
            self._begin(frame)
        for camera in self._cameras.values():
            camera.add(frame)
        self._pending.append(
            _Pending(
                time_ns=frame.time_ns,
                values=FrameValues.of(frame),
                joint_samples=frame.joint_samples,
                changes=self._changes(frame),
            )
        )
        self.num_frames += 1
        if len(self._pending) >= self._info.fps:
            self._write_pending()

    def _begin(self, first: Frame | None) -> None:
        """Write what is said once, as soon as it is known which images there are."""
        for camera in self._info.cameras if first is not None else ():
            assert first is not None
            if camera.name not in first.images:
                raise RecordingError(f"Frame 0 has no image of the camera {camera.name!r}.")
            self._cameras[camera.name] = CameraRecorder(
                camera, first.images[camera.name], video=self._video, fps=self._info.fps
            )
        streams = {name: camera.streams for name, camera in self._cameras.items()}
        self._file.metadata(metadata.EPISODE, metadata.episode_metadata(self._info, streams))
        has_labels = any(camera.segmentation for camera in streams.values())
        for topic, schema, data in channels.latched_messages(self._info, self._tree, has_labels=has_labels):
            self._file.log(topic, schema, data, 0, latched=True)
        self._file.flush()

    def _write_pending(self) -> None:
        """Write the frames whose images have all left the encoders: numbers first, then images."""
        num_ready = min((camera.num_ready for camera in self._cameras.values()), default=self.num_frames)
        frames = self._pending[: num_ready - self._num_written]
        if not frames:
            return
        time_ns = [frame.time_ns for frame in frames]
        values = [frame.values for frame in frames]
        logs = [self._file.logger(stream.topic, stream.schema) for stream in self._streams]
        encoded = [stream.encode(time_ns, stream.rows(values)) for stream in self._streams]
        samples = iter(self._sample_messages(frames))
        for time, frame, *rows in zip(time_ns, frames, *encoded, strict=True):
            for sample, data in islice(samples, len(frame.joint_samples)):
                logs[0](data, log_time=sample)
            for log, data in zip(logs, rows, strict=True):
                log(data, log_time=time)
            for topic, schema, data in frame.changes:
                self._file.log(topic, schema, data, time)
        self._file.flush()
        if self._cameras:
            pictures = (camera.take_messages(time_ns) for camera in self._cameras.values())
            for time, *cameras in zip(time_ns, *pictures, strict=True):
                for topic, schema, data in (message for camera in cameras for message in camera):
                    self._file.log(topic, schema, data, time)
            self._file.flush()
        del self._pending[: len(frames)]
        self._num_written += len(frames)

    def _sample_messages(self, frames: list[_Pending]) -> list[tuple[int, bytes]]:
        """Joint states between the frames: when, and the message."""
        samples = [sample for frame in frames for sample in frame.joint_samples]
        if not samples:
            return []
        times = [sample.time_ns for sample in samples]
        values = np.array([(s.joint_position, s.joint_velocity, s.joint_effort) for s in samples])
        data = self._streams[0].encode(times, values.reshape(len(samples), -1))
        return list(zip(times, data, strict=True))

    def _changes(self, frame: Frame) -> list[tuple[str, str, bytes]]:
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

    def _write_rest(self) -> None:
        if self.num_frames == 0:
            self._begin(None)
        self._write_pending()
        if self._pending:
            raise RecordingError(f"The video encoder kept the last {len(self._pending)} images to itself.")
