"""Writer of simulated episodes: images arrive with the frames, and are written after the numbers of their second."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from demorec.core.errors import ConfigError, RecordingError
from demorec.core.geometry import Array
from demorec.episode.episode import CameraImages, Event, Frame, JointSample, frame_time_ns
from demorec.episode.info import Camera, EpisodeInfo
from demorec.mcap import messages
from demorec.mcap.cdr import encode
from demorec.mcap.channels import DELIBERATE_MISS, EVENTS, PHASE, PHASE_EVENT, Message
from demorec.mcap.images import CameraWriter
from demorec.mcap.metadata import CameraStreams
from demorec.mcap.simulated_streams import FrameValues, simulated_streams
from demorec.mcap.transforms import FrameTree
from demorec.mcap.writer import BatchWriter, PendingFrame, check_description
from demorec.robots.assets import asset_path
from demorec.robots.urdf import Urdf


class EpisodeWriter(BatchWriter):
    """Context manager that writes an episode simulated by demorec; arguments and errors as in `BatchWriter`.

    Depth and segmentation are recorded for the cameras that have them in the first frame.
    """

    def _prepare(self, info: EpisodeInfo) -> None:
        self._phase: str | None = None
        self._is_miss: bool | None = None
        check_description(info)
        self._check = FrameCheck(info)
        robot, scene = info.simulated.robot, info.simulated.scene
        urdf = Urdf.load(asset_path(robot.urdf), scale=scene.robot.scale)
        known = {joint.name for joint in urdf.joints if joint.kind != "fixed"}
        if wrong := [name for name in robot.joint_names if name not in known]:
            raise ConfigError(
                f"The robot {robot.name!r} has no joints {', '.join(wrong)}; its URDF has "
                f"{', '.join(sorted(known))}: {robot.urdf}"
            )
        self._tree = FrameTree(urdf, robot.joint_names, info.cameras, scene)
        self._objects = [body.name for body in scene.movable]
        self._streams = (*simulated_streams(info), *self._tree.streams(self._state))

    def write(self, frame: Frame) -> None:
        """Add the next frame with its images.

        Raises:
            RecordingError: Frames are out of order; vectors, objects or cameras are missing, unknown or of a wrong
                length; numbers are not finite; images are missing or have a wrong size; or the disk is full.
        """
        due = (self.num_frames, frame_time_ns(self.num_frames, self._info.fps))
        if (frame.frame_index, frame.time_ns) != due:
            raise RecordingError(
                f"Frame {frame.frame_index} at {frame.time_ns} ns arrived instead of frame {due[0]} at {due[1]} ns: "
                "write frames in order, each once."
            )
        self._check(frame)
        if not self._is_described:
            self._open_cameras(frame)
            self._write_description()
        cameras = {name: check_images(frame, one.camera, one.streams) for name, one in self._cameras.items()}
        numbers = {
            name: self._cameras[name].add(
                frame.time_ns, images.color, depth=images.depth, segmentation=images.segmentation
            )
            for name, images in cameras.items()
        }
        dense = self._dense(frame.joint_samples)
        self._add(PendingFrame(frame.time_ns, FrameValues.of(frame), numbers, self._changes(frame), dense))

    def flush(self) -> None:
        """See `BatchWriter`."""
        if frames := self._write_frames():
            self._write_images({name: number + 1 for name, number in frames[-1].images.items()})

    def _open_cameras(self, first: Frame) -> None:
        for camera in self._info.cameras:
            if (images := first.images.get(camera.name)) is None:
                raise RecordingError(f"Frame 0 has no image of the camera {camera.name!r}.")
            beside = [kind for kind in ("depth", "segmentation") if getattr(images, kind) is not None]
            self._cameras[camera.name] = CameraWriter(camera, self._video, self._info.fps, beside=beside)

    def _state(self, frames: Sequence[FrameValues]) -> tuple[Array, Array]:
        """Return joint positions (N, n_joints), and world_from_object of all movable bodies (N, 7 k)."""
        positions = np.array([frame.observation.joint_position for frame in frames])
        poses = [frame.observation.object_poses[name].vector() for frame in frames for name in self._objects]
        return positions, np.array(poses).reshape(len(frames), 7 * len(self._objects))

    def _dense(self, samples: tuple[JointSample, ...]) -> list[tuple[int, bytes]]:
        """Encode joint states between the frames in the layout of those at the frames."""
        if not samples:
            return []
        values = np.array([(s.joint_position, s.joint_velocity, s.joint_effort) for s in samples])
        times = [sample.time_ns for sample in samples]
        encoded = self._streams[0].layout.encode(np.array(times, dtype=np.int64), values.reshape(len(samples), -1))
        return list(zip(times, encoded, strict=True))

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


class FrameCheck:
    """Checks one episode frame by frame; takes microseconds, since it is part of every recording."""

    def __init__(self, info: EpisodeInfo) -> None:
        self._joints, self._arm = (len(info.simulated.robot.joint_names),), (len(info.simulated.robot.arm_joints),)
        self._objects = {body.name for body in info.simulated.scene.movable}
        self._cameras = {camera.name for camera in info.simulated.scene.cameras}
        self._sensed = {name: (len(feature.names),) for name, feature in info.sensors.items()}

    def __call__(self, frame: Frame) -> None:
        """Raise RecordingError if a frame is invalid; images are checked when they are encoded."""
        poses, images = frame.observation.object_poses, frame.images
        for what, found, known, fits in (
            ("poses of the objects", poses, self._objects, poses.keys() == self._objects),
            ("images of the cameras", images, self._cameras, images.keys() <= self._cameras),
        ):
            if not fits:
                raise RecordingError(
                    f"Frame {frame.frame_index} has {what} {', '.join(sorted(found)) or 'none'}, the scene has "
                    f"{', '.join(sorted(known)) or 'none'}."
                )
        vectors = list(self._vectors(frame))
        for owner, name, vector, shape in vectors:
            if vector is None or vector.shape != shape:
                given = f"no {name}" if vector is None else f"a {name} of shape {vector.shape}"
                raise RecordingError(
                    f"Frame {frame.frame_index} has {given} in its {owner}, it must be of shape {shape}."
                )
        if not np.isfinite(np.concatenate([vector for _, _, vector, _ in vectors])).all():
            owner, name = next((owner, name) for owner, name, vector, _ in vectors if not np.isfinite(vector).all())
            raise RecordingError(f"Frame {frame.frame_index} has a {name} in its {owner} that is not finite.")

    def _vectors(self, frame: Frame) -> Iterator[tuple[str, str, Any, tuple[int, ...]]]:
        """Yield owner, name, numbers and expected shape of each vector; None for missing numbers."""
        seen = frame.observation
        for state in (seen, *frame.joint_samples):
            owner = f"joint sample at {state.time_ns} ns" if isinstance(state, JointSample) else "observation"
            for name in ("joint_position", "joint_velocity", "joint_effort"):
                yield owner, name, getattr(state, name), self._joints
        for name in ("gripper_width", "contact_force"):
            yield "observation", name, np.array([getattr(seen, name)]), (1,)
        for name, shape in self._sensed.items():
            yield "observation", name, seen.sensed.get(name), shape
        for owner, action in (("action", frame.action), ("command", frame.command)):
            yield owner, "joint_target", action.joint_target, self._arm
            yield owner, "gripper_target", np.array([action.gripper_target]), (1,)
            yield owner, "base_from_tcp_target", action.base_from_tcp_target.vector(), (7,)
        yield "observation", "base_from_tcp", seen.base_from_tcp.vector(), (7,)
        for pose in seen.object_poses.values():
            yield "observation", "object_poses", pose.vector(), (7,)
        for camera, images in frame.images.items():
            yield f"image of {camera}", "world_from_camera", images.world_from_camera.vector(), (7,)


def check_images(frame: Frame, camera: Camera, streams: CameraStreams) -> CameraImages:
    """Return a frame's images of a camera; RecordingError unless they match the recorded streams and size."""
    images = frame.images.get(camera.name)
    if images is None:
        raise RecordingError(f"Frame {frame.frame_index} has no image of the camera {camera.name!r}.")
    size = (camera.height, camera.width)
    for kind, pixels, is_recorded in (
        ("colour", images.color, True),
        ("depth", images.depth, streams.depth),
        ("segmentation", images.segmentation, streams.segmentation),
    ):
        if (pixels is not None) != is_recorded or (pixels is not None and pixels.shape[:2] != size):
            found = "is missing" if pixels is None else f"has shape {pixels.shape}"
            raise RecordingError(
                f"The {kind} image of the camera {camera.name!r} at frame {frame.frame_index} {found}: every frame has "
                f"the same images of {camera.width}x{camera.height} pixels."
            )
    return images
