"""Streams of an episode that demorec simulated: fixed topics, with messages at the times of the frames."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from operator import attrgetter
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from demorec.core.geometry import Array, Pose
from demorec.episode.episode import Action, Frame, Observation
from demorec.episode.info import EpisodeInfo, Feature, SensorStream
from demorec.mcap import messages
from demorec.mcap.cdr import Layout, Slot, layout
from demorec.mcap.channels import (
    ACTION,
    COMMAND,
    EE_POSE,
    GRIPPER,
    JOINT_STATES,
    camera_topic,
    object_topic,
)
from demorec.mcap.streams import (
    ColumnArrays,
    FrameStream,
    array_layout,
    concatenated,
    joint_layout,
)
from demorec.mcap.transforms import POSE_SLOTS, WORLD
from demorec.robots.robot import RobotSpec

if TYPE_CHECKING:
    pass

GRIPPER_JOINT = "gripper"
"""Joint name that represents the gripper's opening."""
_JOINT_STATE = ("joint_position", "joint_velocity", "joint_effort")


class FrameValues(NamedTuple):
    """The numbers of a frame, queued until its second is complete; must not be changed meanwhile."""

    observation: Observation
    action: Action
    command: Action
    world_from_camera: dict[str, Pose]

    @classmethod
    def of(cls, frame: Frame) -> FrameValues:
        """Take the numbers of a frame without its images."""
        poses = {name: image.world_from_camera for name, image in frame.images.items()}
        return cls(frame.observation, frame.action, frame.command, poses)


def simulated_streams(info: EpisodeInfo) -> Iterator[FrameStream]:
    """Yield the streams that become columns; the first one is dense."""
    robot, scene = info.simulated.robot, info.simulated.scene
    arm_and_gripper = (*robot.arm_joints, GRIPPER_JOINT)
    joint_state = concatenated(attrgetter(*(f"observation.{name}" for name in _JOINT_STATE)))
    yield _joints(JOINT_STATES, robot.joint_names, joint_state, _joint_state_columns, is_dense=True)
    yield _joints(GRIPPER, (GRIPPER_JOINT,), concatenated(partial(_gripper_parts, robot)), _gripper_columns)
    for topic, kind in ((ACTION, "action"), (COMMAND, "command")):
        yield _joints(topic, arm_and_gripper, partial(_targets, kind), partial(_target_columns, kind))
    base = robot.base_link
    yield _pose(EE_POSE, base, "observation.base_from_tcp", "base_from_tcp")
    yield _pose(ACTION + EE_POSE, base, "action.base_from_tcp_target", "action_base_from_tcp")
    yield _pose(COMMAND + EE_POSE, base, "command.base_from_tcp_target", "command_base_from_tcp")
    for quantity, feature in info.sensors.items():
        if feature.stream is not None:
            yield _sensor(quantity, feature, feature.stream)
    for body in scene.movable:
        yield _pose(object_topic(body.name), WORLD, "observation.object_poses", "object_poses", body.name)
    for camera in scene.cameras:
        topic = camera_topic(camera.name, "pose")
        yield _pose(topic, WORLD, "world_from_camera", "world_from_camera", camera.name)


def _joint_state_columns(values: Array) -> ColumnArrays:
    return {name: part.copy() for name, part in zip(_JOINT_STATE, np.split(values, 3, axis=1), strict=True)}


def _gripper_parts(robot: RobotSpec, values: FrameValues) -> Sequence[Array]:
    # The force on the fingers is stored as the effort.
    observation, n = values.observation, len(robot.arm_joints)
    velocity = float(robot.gripper.width_velocity(observation.joint_position[n:], observation.joint_velocity[n:]))
    return (np.array((observation.gripper_width, velocity, observation.contact_force)),)


def _gripper_columns(values: Array) -> ColumnArrays:
    return {"gripper_width": values[:, 0].copy(), "contact_force": values[:, 2].copy()}


def _targets(kind: str, frames: Sequence[FrameValues]) -> Array:
    # Velocity and effort are not commanded; zeros, since a viewer draws an empty plot for an empty array.
    actions: list[Action] = [getattr(values, kind) for values in frames]
    targets = [part for action in actions for part in (action.joint_target, (action.gripper_target,))]
    rows = np.concatenate(targets).reshape(len(frames), -1)
    return np.concatenate((rows, np.zeros((len(rows), 2 * rows.shape[1]))), axis=1)


def _target_columns(kind: str, values: NDArray[Any]) -> ColumnArrays:
    num_arm = values.shape[1] // 3 - 1
    return {f"{kind}_joint_target": values[:, :num_arm].copy(), f"{kind}_gripper": values[:, num_arm].copy()}


def _joints(
    topic: str,
    names: Sequence[str],
    rows: Callable[[Sequence[Any]], Array],
    columns: Callable[[NDArray[Any]], ColumnArrays],
    *,
    is_dense: bool = False,
) -> FrameStream:
    return FrameStream(topic, messages.JOINT_STATE, joint_layout(names), rows, columns, is_dense=is_dense)


def _sensor(quantity: str, feature: Feature, stream: SensorStream) -> FrameStream:
    laid_out: Layout
    if stream.layout == "wrench":
        schema, force_and_torque = messages.WRENCH, ((Slot.VALUE,) * 3, (Slot.VALUE,) * 3)
        laid_out = layout(schema, (Slot.TIME, stream.frame), force_and_torque)
    else:
        schema, laid_out = messages.FLOAT64_ARRAY, array_layout(messages.FLOAT64_ARRAY, feature.names)
    rows = concatenated(lambda values: (values.observation.sensed[quantity],))
    return FrameStream(stream.topic, schema, laid_out, rows, lambda values: {"sensed": {quantity: values}})


def _pose(topic: str, frame_id: str, path: str, column: str, key: str = "") -> FrameStream:
    """Build the stream of a pose in `FrameValues`, stored in `column`; `key` selects one of several poses."""
    found = attrgetter(path)

    def parts(values: FrameValues) -> Sequence[Array]:
        pose: Pose = found(values)[key] if key else found(values)
        return pose.position, pose.quat_xyzw

    def columns(values: NDArray[Any]) -> ColumnArrays:
        return {column: {key: values}} if key else {column: values}

    laid_out = layout(messages.POSE, (Slot.TIME, frame_id), POSE_SLOTS)
    return FrameStream(topic, messages.POSE, laid_out, concatenated(parts), columns)
