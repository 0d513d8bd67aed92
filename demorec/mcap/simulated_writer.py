"""Writer of simulated episodes: images arrive with the frames, and are written after the numbers of their second."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from demorec.core.errors import RecordingError
from demorec.core.geometry import Array
from demorec.episode.episode import CameraImages, Event, Frame, JointSample, frame_time_ns
from demorec.episode.info import Camera, EpisodeInfo
from demorec.mcap import messages
from demorec.mcap.cdr import encode
from demorec.mcap.channels import (
    DELIBERATE_MISS,
    EVENTS,
    JOINT_STATES,
    PHASE,
    PHASE_EVENT,
    Message,
    object_topic,
)
from demorec.mcap.images import CameraWriter
from demorec.mcap.metadata import CameraStreams
from demorec.mcap.streams import joint_state
from demorec.mcap.transforms import FrameTree
from demorec.mcap.writer import BatchWriter
from demorec.robots.assets import asset_path
from demorec.robots.urdf import Urdf


class EpisodeWriter(BatchWriter):
    """Context manager that writes an episode simulated by demorec; arguments and errors as in `BatchWriter`.

    Depth and segmentation are recorded for the cameras that have them in the first frame.
    """

    def _prepare(self, info: EpisodeInfo) -> FrameTree:
        self._phase: str | None = None
        self._is_miss: bool | None = None
        robot, scene = info.simulated.robot, info.simulated.scene
        urdf = Urdf.load(asset_path(robot.urdf), scale=scene.robot.scale)
        self._objects = [body.name for body in scene.movable]
        return FrameTree(urdf, robot.joint_names, info.cameras, scene)

    def write(self, frame: Frame) -> None:
        """Add the next frame with its images.

        Raises:
            RecordingError: Frames are out of order; vectors have a wrong length; numbers are not finite; images are
                missing or have a wrong size; or the disk is full.
            KeyError: Objects, sensors or cameras are missing.
        """
        due = (self.num_frames, frame_time_ns(self.num_frames, self._info.fps))
        if (frame.frame_index, frame.time_ns) != due:
            raise RecordingError(
                f"Frame {frame.frame_index} at {frame.time_ns} ns arrived instead of frame {due[0]} at {due[1]} ns: "
                "write frames in order, each once."
            )
        if not self._is_described:
            self._open_cameras(frame.images)
        for name, writer in self._cameras.items():
            _check_images(frame, writer.camera, writer.streams, frame.images[name])
        numbers = {}
        for name, writer in self._cameras.items():
            images = frame.images[name]
            numbers[name] = writer.add(
                frame.time_ns, images.color, depth=images.depth, segmentation=images.segmentation
            )
        dense = [(sample.time_ns, self._dense(sample)) for sample in frame.joint_samples]
        self._add(frame, numbers, self._changes(frame), dense)

    def flush(self) -> None:
        """See `BatchWriter`."""
        if frames := self._write_frames():
            self._write_images({name: number + 1 for name, number in frames[-1].images.items()})

    def _open_cameras(self, first: Mapping[str, CameraImages]) -> None:
        for camera in self._info.cameras:
            beside = [kind for kind in ("depth", "segmentation") if getattr(first[camera.name], kind) is not None]
            self._cameras[camera.name] = CameraWriter(camera, self._video, self._info.fps, beside=beside)

    def _state(self, vectors: Mapping[str, Array]) -> tuple[Array, Array]:
        joints = vectors[JOINT_STATES]
        poses = [vectors[object_topic(name)] for name in self._objects]
        return np.split(joints, 3, axis=1)[0], np.concatenate([np.empty((len(joints), 0)), *poses], axis=1)

    def _dense(self, sample: JointSample) -> bytes:
        values = self._vector(self._streams[0], joint_state(sample))
        (data,) = self._streams[0].layout.encode(np.array([sample.time_ns]), values[np.newaxis])
        return data

    def _changes(self, frame: Frame) -> list[Message]:
        if frame.phase == self._phase and frame.is_deliberate_miss == self._is_miss and not frame.events:
            return []  # nearly always
        result = []
        if any(event.name == PHASE_EVENT for event in frame.events):
            raise RecordingError(f"Frame {frame.frame_index} has an event {PHASE_EVENT!r}, a reserved name.")
        events = list(frame.events)
        if frame.phase != self._phase:
            self._phase = frame.phase
            events.insert(0, Event(name=PHASE_EVENT, message=frame.phase))
            result.append((PHASE, messages.STRING, encode(messages.STRING, frame.phase)))
        if frame.is_deliberate_miss != self._is_miss:
            self._is_miss = frame.is_deliberate_miss
            data = encode(messages.BOOL, frame.is_deliberate_miss)
            result.append((DELIBERATE_MISS, messages.BOOL, data))
        return result + [(EVENTS, messages.LOG, messages.log(frame.time_ns, event)) for event in events]


def _check_images(frame: Frame, camera: Camera, streams: CameraStreams, images: CameraImages) -> None:
    for kind, pixels, is_recorded in (
        ("colour", images.color, True),
        ("depth", images.depth, streams.depth),
        ("segmentation", images.segmentation, streams.segmentation),
    ):
        size = (camera.height, camera.width)
        if (pixels is not None) != is_recorded or (pixels is not None and pixels.shape[:2] != size):
            found = "is missing" if pixels is None else f"has shape {pixels.shape}"
            raise RecordingError(
                f"The {kind} image of the camera {camera.name!r} at frame {frame.frame_index} {found}: every frame has "
                f"the same images of {camera.width}x{camera.height} pixels."
            )
