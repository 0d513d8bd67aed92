"""What a frame must be to be recorded, refused at once where it is not, in one sentence.

Of a simulated episode: vectors of the robot's lengths, poses of the scene's objects, finite numbers (`FrameCheck`). Of
any other: the features and images that its description names, at stamps that go forward (`SampledFrameCheck`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from demorec.core.errors import RecordingError
from demorec.core.registry import nearest_match
from demorec.episode.episode import CameraImages, Frame, JointSample, SampledFrame
from demorec.episode.info import Camera, EpisodeInfo
from demorec.episode.sensed import STREAMS
from demorec.mcap.lossless import DEPTH_TYPES
from demorec.mcap.metadata import CameraStreams
from demorec.robots.assets import asset_path
from demorec.robots.urdf import Urdf


def check_joint_names(info: EpisodeInfo) -> None:
    """Raise RecordingError unless the robot's joints are different ones that its URDF has."""
    robot = info.simulated.robot
    known = {joint.name for joint in Urdf.load(asset_path(robot.urdf)).joints if joint.kind != "fixed"}
    if wrong := [name for name in robot.joint_names if name not in known]:
        raise RecordingError(
            f"The robot {robot.name!r} has no joints {', '.join(wrong)}; those of its URDF are "
            f"{', '.join(sorted(known))}: {robot.urdf}"
        )
    if twice := [name for name, count in Counter(robot.joint_names).items() if count > 1]:
        raise RecordingError(f"The robot {robot.name!r} names the joints {', '.join(twice)} twice.")


class FrameCheck:
    """Checks frame after frame of one episode; takes microseconds, since it is part of every recording."""

    def __init__(self, info: EpisodeInfo) -> None:
        self._joints, self._arm = (len(info.simulated.robot.joint_names),), (len(info.simulated.robot.arm_joints),)
        self._objects = {body.name for body in info.simulated.scene.movable}
        self._cameras = {camera.name for camera in info.simulated.scene.cameras}
        self._sensed = {name: (len(row.names(info.simulated.robot)),) for name, row in STREAMS.items()}

    def __call__(self, frame: Frame) -> None:
        """Raise RecordingError for what is wrong with a frame; images are looked at when they are encoded."""
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
        """Where, what, numbers, their shape; None for the numbers of what is missing."""
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
    """A frame's images of a camera; RecordingError unless they are those that are recorded, all of its size."""
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


MAX_STAMP_NS = 2**31 * 1_000_000_000 - 1
"""The seconds of a stamp have 31 bits in ROS messages."""

MAX_SUBTASK = 1000
"""Characters."""


class SampledFrameCheck:
    """Looks at images and frames in the order in which they come, and notes those that were taken.

    Attributes:
        features: By name, of the episode.
        image_stamps: Camera -> stamp of the last image that was taken.
    """

    def __init__(self, info: EpisodeInfo) -> None:
        self.features = {feature.name: feature for feature in info.features}
        self._cameras = {camera.name: camera for camera in info.cameras}
        self.image_stamps: dict[str, int] = {}
        self._sample_stamps: dict[str, int] = {}
        self._frame_stamp = -1
        self._num_images = dict.fromkeys(self._cameras, 0)
        self._num_frames = 0

    def check_image(self, camera: str, stamp_ns: int, data: NDArray[Any] | bytes) -> None:
        """Raise RecordingError unless it can be the next image of the camera."""
        known = self._cameras.get(camera)
        if known is None:
            raise RecordingError(
                f"Unknown camera {camera!r}.{nearest_match(camera, self._cameras)} The cameras are: "
                f"{', '.join(self._cameras) or 'none'}."
            )
        _check_image(known, data)
        _check_stamp(f"The image of the camera {camera!r}", self.image_stamps.get(camera, -1), stamp_ns)

    def note_image(self, camera: str, stamp_ns: int) -> None:
        """The camera's next image was taken."""
        self.image_stamps[camera] = int(stamp_ns)
        self._num_images[camera] += 1

    def check_frame(self, frame: SampledFrame) -> None:
        """Raise RecordingError unless it can be the next frame."""
        what = f"frame {self._num_frames}"
        if unknown := [name for name in frame.samples if name not in self.features]:
            raise RecordingError(
                f"{what.capitalize()} has an unknown feature {unknown[0]!r}."
                f"{nearest_match(unknown[0], self.features)} The features are: {', '.join(self.features)}."
            )
        if missing := [name for name in self.features if name not in frame.samples]:
            raise RecordingError(
                f"{what.capitalize()} lacks the feature {', '.join(missing)}: every frame has every feature."
            )
        for name, feature in self.features.items():
            vector, count = frame.samples[name].vector, len(feature.names)
            if not isinstance(vector, np.ndarray) or vector.dtype != feature.dtype or vector.shape != (count,):
                found = f"{getattr(vector, 'dtype', type(vector).__name__)} of shape {np.shape(vector)}"
                raise RecordingError(
                    f"The feature {name!r} of {what} is {found}, it must be {feature.dtype} of shape ({count},)."
                )
            if not np.isfinite(vector).all():
                wrong = int(np.flatnonzero(~np.isfinite(vector))[0])
                raise RecordingError(
                    f"The feature {name!r} of {what} is {vector[wrong]} in its element {feature.names[wrong]!r}, "
                    "numbers must be finite."
                )
        for camera, number in frame.images.items():
            if camera not in self._cameras or not 0 <= number < self._num_images[camera]:
                count = self._num_images.get(camera, 0)
                raise RecordingError(f"The camera {camera!r} has no image {number} for {what}, it has {count} so far.")
        if len(frame.subtask) > MAX_SUBTASK or not frame.subtask.isprintable():
            raise RecordingError(f"The subtask of {what} is no single line of at most {MAX_SUBTASK} characters.")
        for name in self.features:
            stamp = frame.samples[name].stamp_ns
            last = self._sample_stamps.get(name, -1)
            _check_stamp(f"The feature {name!r} of {what}", last, stamp, may_repeat=True)
        _check_stamp(what.capitalize(), self._frame_stamp, frame.time_ns)

    def note_frame(self, frame: SampledFrame) -> None:
        """The next frame was taken."""
        for name in self.features:
            self._sample_stamps[name] = int(frame.samples[name].stamp_ns)
        self._frame_stamp = int(frame.time_ns)
        self._num_frames += 1


def _check_stamp(what: str, last: int, stamp_ns: int, *, may_repeat: bool = False) -> None:
    if not isinstance(stamp_ns, int | np.integer) or isinstance(stamp_ns, bool):
        raise RecordingError(f"{what} has the stamp {stamp_ns!r}, it must be a whole number of nanoseconds.")
    if not 0 <= stamp_ns <= MAX_STAMP_NS:
        raise RecordingError(f"{what} has the stamp {stamp_ns} ns, allowed are 0 to {MAX_STAMP_NS} ns.")
    if stamp_ns < last or (stamp_ns == last and not may_repeat):
        raise RecordingError(
            f"{what} has the stamp {stamp_ns} ns, the one before it {last} ns: stamps must not "
            f"{'go backwards' if stamp_ns < last else 'stand still'}."
        )


def _check_image(camera: Camera, data: NDArray[Any] | bytes) -> None:
    if camera.kept and not camera.is_depth:
        if not isinstance(data, bytes) or not data:
            raise RecordingError(
                f"The image of the camera {camera.name!r} is {type(data).__name__}, it must be bytes of {camera.kept}."
            )
        return
    kind = np.dtype(DEPTH_TYPES.get(camera.kept, np.uint8))
    shape: tuple[int, ...] = (camera.height, camera.width) if camera.is_depth else (camera.height, camera.width, 3)
    if not isinstance(data, np.ndarray) or data.dtype != kind or data.shape != shape:
        found = f"{data.dtype} of shape {data.shape}" if isinstance(data, np.ndarray) else type(data).__name__
        raise RecordingError(
            f"The image of the camera {camera.name!r} is {found}, it must be {kind} of shape {shape}: height, "
            f"width{'' if camera.is_depth else ', RGB'}."
        )
