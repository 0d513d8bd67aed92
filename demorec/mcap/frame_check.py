"""What a frame must be to be recorded: vectors of the robot's lengths, poses of the scene's objects, finite numbers."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields
from typing import Any

import numpy as np

from demorec.core.errors import RecordingError
from demorec.core.geometry import Array, Pose
from demorec.episode.episode import Frame, SimulatedInfo
from demorec.mcap.channels import WRENCH
from demorec.mcap.streams import frame_streams
from demorec.robots.assets import asset_path
from demorec.robots.urdf import Urdf


def check_joint_names(info: SimulatedInfo) -> None:
    """Raise RecordingError unless the robot's joints are different ones that its URDF has."""
    robot = info.robot
    known = {joint.name for joint in Urdf.load(asset_path(robot.urdf)).joints if joint.kind != "fixed"}
    wrong = [name for name in robot.joint_names if name not in known]
    if wrong:
        raise RecordingError(
            f"The robot {robot.name!r} has no joints {', '.join(wrong)}; those of its URDF are "
            f"{', '.join(sorted(known))}: {robot.urdf}"
        )
    twice = [name for name, count in Counter(robot.joint_names).items() if count > 1]
    if twice:
        raise RecordingError(f"The robot {robot.name!r} names the joints {', '.join(twice)} twice.")


class FrameCheck:
    """Checks frame after frame of one episode; takes microseconds, since it is part of every recording."""

    def __init__(self, info: SimulatedInfo) -> None:
        self._joints, self._arm = (len(info.robot.joint_names),), (len(info.robot.arm_joints),)
        self._objects = {body.name for body in info.scene.movable}
        self._cameras = {camera.name for camera in info.scene.cameras}
        self._version = info.format_version
        self._has_wrench = any(stream.topic == WRENCH for stream in frame_streams(info))

    def __call__(self, frame: Frame) -> None:
        """Raise RecordingError for what is wrong with a frame; missing pictures are found by who codes them."""
        seen, action, command = frame.observation, frame.action, frame.command
        joints = [seen.joint_position, seen.joint_velocity, seen.joint_effort]
        for sample in frame.joint_samples:
            joints += (sample.joint_position, sample.joint_velocity, sample.joint_effort)
        targets = [action.joint_target, command.joint_target]
        if {vector.shape for vector in joints} != {self._joints} or {vector.shape for vector in targets} != {self._arm}:
            raise _wrong_shape(frame, self._joints, joints, self._arm, targets)
        wrenches = []
        if self._has_wrench:
            if seen.wrench is None or seen.wrench.shape != (6,):
                raise self._wrong_wrench(frame)
            wrenches.append(seen.wrench)
        if seen.object_poses.keys() != self._objects:
            raise _other_names(frame, "poses of the objects", seen.object_poses, self._objects)
        if not frame.images.keys() <= self._cameras:
            raise _other_names(frame, "pictures of the cameras", frame.images, self._cameras)
        poses = [seen.base_from_tcp, action.base_from_tcp_target, command.base_from_tcp_target]
        poses += seen.object_poses.values()
        poses += [images.world_from_camera for images in frame.images.values()]
        numbers = np.concatenate(
            joints + targets + wrenches + [part for pose in poses for part in (pose.position, pose.quat_xyzw)]
        )
        scalars = (seen.gripper_width, seen.contact_force, action.gripper_target, command.gripper_target)
        # One sum in place of sixty questions; it is finite unless a summand is not, or all are absurdly large.
        if not math.isfinite(numbers.sum() + sum(scalars)):
            _refuse_not_finite(frame)

    def _wrong_wrench(self, frame: Frame) -> RecordingError:
        wrench = frame.observation.wrench
        found = "no wrench" if wrench is None else f"a wrench of shape {wrench.shape}"
        return RecordingError(
            f"Frame {frame.frame_index} has {found}; recordings of format version {self._version} have one of shape "
            "(6,) at each frame, zeros where there is no force-torque sensor."
        )


def _wrong_shape(
    frame: Frame, joints: tuple[int], found: Sequence[Array], arm: tuple[int], targets: Sequence[Array]
) -> RecordingError:
    vector, wanted = next(
        (vector, wanted)
        for wanted, vectors in ((joints, found), (arm, targets))
        for vector in vectors
        if vector.shape != wanted
    )
    what = "joint target" if any(vector is target for target in targets) else "joint vector"
    return RecordingError(f"Frame {frame.frame_index} has a {what} of shape {vector.shape}, the robot's is {wanted}.")


def _other_names(frame: Frame, what: str, found: Iterable[str], known: Iterable[str]) -> RecordingError:
    return RecordingError(
        f"Frame {frame.frame_index} has {what} {', '.join(sorted(found)) or 'none'}, the scene has "
        f"{', '.join(sorted(known)) or 'none'}."
    )


def _refuse_not_finite(frame: Frame) -> None:
    owners: dict[str, Any] = {"observation": frame.observation, "action": frame.action, "command": frame.command}
    owners |= {f"joint sample at {sample.time_ns} ns": sample for sample in frame.joint_samples}
    owners |= {f"picture of {name}": images for name, images in frame.images.items()}
    for owner, value in owners.items():
        for field in fields(value):
            if not _is_finite(getattr(value, field.name)):
                raise RecordingError(f"Frame {frame.frame_index} has a {field.name} in its {owner} that is not finite.")


def _is_finite(value: Any) -> bool:
    if isinstance(value, Pose):
        return bool(np.isfinite(value.vector()).all())
    if isinstance(value, Mapping):
        return all(_is_finite(item) for item in value.values())
    is_number = isinstance(value, float) or (isinstance(value, np.ndarray) and value.dtype == np.float64)
    return not is_number or bool(np.isfinite(value).all())
