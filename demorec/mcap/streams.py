"""Streams with one message at each frame; writer, reader, recovery and checks use the same list of them.

A simulated episode has fixed topics, with messages at the times of the frames. Any other episode has a topic for each
feature, and `/frames`, which lists for each frame the timestamps of the features' samples, then the numbers of the
cameras' images. Feature messages are stored at the frame's time; those with a header have the sample's timestamp there.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from demorec.core.geometry import Array, Pose
from demorec.episode.episode import NO_IMAGE, Action, Frame, JointSample, Observation, SampledFrame
from demorec.episode.info import EpisodeInfo, Feature, SensorStream
from demorec.mcap import messages
from demorec.mcap.cdr import Layout, Slot, layout
from demorec.mcap.channels import (
    ACTION,
    COMMAND,
    EE_POSE,
    FRAMES,
    GRIPPER,
    JOINT_STATES,
    camera_topic,
    feature_topic,
    object_topic,
)
from demorec.robots.robot import RobotSpec

WORLD = "world"
GRIPPER_JOINT = "gripper"
"""Joint name that represents the gripper's opening."""
POSE_SLOTS = ((Slot.VALUE,) * 3, (Slot.VALUE,) * 4)
"""Position and quaternion xyzw in a layout."""
_JOINT_STATE = ("joint_position", "joint_velocity", "joint_effort")
_SKIPPED = ("", "", None)

Column = tuple[str, str, int | None]
"""Field of `Trajectory` or `Table`, key if the field is a mapping, and width; None for one number per frame."""


@dataclass(frozen=True, eq=False)
class FrameStream:
    """Stream with one message at each frame."""

    topic: str
    schema: str  # ROS 2 type
    layout: Layout  # with K values in each message
    columns: tuple[Column, ...]  # columns that the values become, in order; further values become none
    # The K values of a frame (`Frame` of a simulation, `SampledFrame` of any other episode), in parts.
    values: Callable[[Any], Sequence[ArrayLike]]
    dtype: str = "float64"  # type of the columns
    stamp_ns: Callable[[Any], int] = attrgetter("time_ns")  # timestamp in the header of a frame's message
    is_dense: bool = False  # whether there may be messages between the frames

    def add_columns(self, values: NDArray[Any], columns: dict[str, Any]) -> None:
        """Split values (T, K) into columns: field -> rows, or field -> key -> rows."""
        start = 0
        for field, key, width in self.columns:
            place = slice(start, start + width) if width is not None else start
            start += width or 1
            rows = np.ascontiguousarray(values[:, place], dtype=self.dtype)
            if key:
                columns.setdefault(field, {})[key] = rows
            elif field:
                columns[field] = rows


def frame_streams(info: EpisodeInfo) -> tuple[FrameStream, ...]:
    """List the streams that become columns; the first one of a simulated episode is dense."""
    if info.simulation is not None:
        return tuple(_simulated_streams(info))
    return (*map(_feature, info.features), _frames(info))


def frame_topic(info: EpisodeInfo) -> str:
    """Return the topic with exactly one message at each frame."""
    return FRAMES if info.simulation is None else GRIPPER


def frame_times(num_frames: int, fps: int) -> NDArray[np.int64]:
    """Compute (T,) `frame_time_ns` of every frame."""
    return (np.arange(num_frames, dtype=np.int64) * 2_000_000_000 + fps) // (2 * fps)


def _frames(info: EpisodeInfo) -> FrameStream:
    features = [feature.name for feature in info.features]
    cameras = [camera.name for camera in info.cameras]

    def values(frame: SampledFrame) -> Sequence[ArrayLike]:
        stamps = [int(frame.samples[name].stamp_ns) for name in features]
        images = [int(frame.images.get(name, NO_IMAGE)) for name in cameras]
        return (np.array(stamps + images, dtype=np.int64),)

    columns: list[Column] = [("stamps", name, None) for name in features]
    columns += [("images", name, None) for name in cameras]
    laid_out = _array_layout(messages.INT64_ARRAY, [*features, *cameras])
    return FrameStream(FRAMES, messages.INT64_ARRAY, laid_out, tuple(columns), values, "int64")


def _feature(feature: Feature) -> FrameStream:
    name = feature.name
    if any(feature.joints):  # velocity and effort are empty: they are unknown, and zeros would be invented
        joints = tuple(joint or name for name, joint in zip(feature.names, feature.joints, strict=True))
        schema = messages.JOINT_STATE
        laid_out = layout(schema, (Slot.TIME, ""), joints, (Slot.VALUE,) * len(joints), (), ())
    else:
        schema, laid_out = messages.FLOAT64_ARRAY, _array_layout(messages.FLOAT64_ARRAY, feature.names)
    return FrameStream(
        feature_topic(name),
        schema,
        laid_out,
        (("features", name, len(feature.names)),),
        lambda frame: (frame.samples[name].vector,),  # float64 represents every bit of a float32
        feature.dtype,
        stamp_ns=lambda frame: int(frame.samples[name].stamp_ns),
    )


def _simulated_streams(info: EpisodeInfo) -> Iterator[FrameStream]:
    robot, scene, base = info.simulated.robot, info.simulated.scene, info.simulated.robot.base_link
    yield _joints(
        JOINT_STATES,
        robot.joint_names,
        tuple((name, "", len(robot.joint_names)) for name in _JOINT_STATE),
        lambda frame: joint_state(frame.observation),
        is_dense=True,
    )
    # The force on the fingers is stored as the effort.
    width_and_force: tuple[Column, ...] = (("gripper_width", "", None), _SKIPPED, ("contact_force", "", None))
    yield _joints(GRIPPER, (GRIPPER_JOINT,), width_and_force, lambda frame: (_gripper(robot, frame.observation),))
    yield _targets(ACTION, "action", robot)
    yield _targets(COMMAND, "command", robot)
    yield _pose(EE_POSE, base, lambda frame: frame.observation.base_from_tcp, "base_from_tcp")
    yield _pose(ACTION + EE_POSE, base, lambda frame: frame.action.base_from_tcp_target, "action_base_from_tcp")
    yield _pose(COMMAND + EE_POSE, base, lambda frame: frame.command.base_from_tcp_target, "command_base_from_tcp")
    for quantity, feature in info.sensors.items():
        if feature.stream is not None:
            yield _sensor(quantity, feature, feature.stream)
    for body in scene.movable:
        yield _object_pose(body.name)
    for camera in scene.cameras:
        yield _camera_pose(camera.name)


def joint_state(sample: Observation | JointSample) -> tuple[Array, Array, Array]:
    """Return position, velocity and effort of the joints, as on `/joint_states`."""
    return sample.joint_position, sample.joint_velocity, sample.joint_effort


def _gripper(robot: RobotSpec, seen: Observation) -> tuple[float, float, float]:
    n = len(robot.arm_joints)
    velocity = float(robot.gripper.width_velocity(seen.joint_position[n:], seen.joint_velocity[n:]))
    return seen.gripper_width, velocity, seen.contact_force


def _targets(topic: str, kind: Literal["action", "command"], robot: RobotSpec) -> FrameStream:
    names = (*robot.arm_joints, GRIPPER_JOINT)
    # Velocity and effort are not commanded; zeros, since a viewer draws an empty plot for an empty array.
    zeros = np.zeros(2 * len(names))

    def values(frame: Frame) -> Sequence[ArrayLike]:
        action: Action = getattr(frame, kind)
        return action.joint_target, (action.gripper_target,), zeros

    columns: tuple[Column, ...] = (
        (f"{kind}_joint_target", "", len(robot.arm_joints)),
        (f"{kind}_gripper", "", None),
    )
    return _joints(topic, names, columns, values)


def _joints(
    topic: str,
    names: Sequence[str],
    columns: tuple[Column, ...],
    values: Callable[[Frame], Sequence[ArrayLike]],
    *,
    is_dense: bool = False,
) -> FrameStream:
    slots = (Slot.VALUE,) * len(names)
    laid_out = layout(messages.JOINT_STATE, (Slot.TIME, ""), tuple(names), slots, slots, slots)
    return FrameStream(topic, messages.JOINT_STATE, laid_out, columns, values, is_dense=is_dense)


def _sensor(quantity: str, feature: Feature, stream: SensorStream) -> FrameStream:
    if stream.layout == "wrench":
        schema, force_and_torque = messages.WRENCH, ((Slot.VALUE,) * 3, (Slot.VALUE,) * 3)
        laid_out = layout(schema, (Slot.TIME, stream.frame), force_and_torque)
    else:
        schema, laid_out = messages.FLOAT64_ARRAY, _array_layout(messages.FLOAT64_ARRAY, feature.names)
    columns: tuple[Column, ...] = (("sensed", quantity, len(feature.names)),)
    return FrameStream(stream.topic, schema, laid_out, columns, lambda frame: (frame.observation.sensed[quantity],))


def _object_pose(name: str) -> FrameStream:
    return _pose(object_topic(name), WORLD, lambda frame: frame.observation.object_poses[name], "object_poses", name)


def _camera_pose(name: str) -> FrameStream:
    topic = camera_topic(name, "pose")
    return _pose(topic, WORLD, lambda frame: frame.images[name].world_from_camera, "world_from_camera", name)


def _pose(topic: str, frame_id: str, pose: Callable[[Frame], Pose], field: str, key: str = "") -> FrameStream:
    def values(frame: Frame) -> Sequence[ArrayLike]:
        found = pose(frame)
        return found.position, found.quat_xyzw

    laid_out = layout(messages.POSE, (Slot.TIME, frame_id), POSE_SLOTS)
    return FrameStream(topic, messages.POSE, laid_out, ((field, key, 7),), values)


def _array_layout(schema: str, names: Sequence[str]) -> Layout:
    """Lay out std_msgs/Float64MultiArray or Int64MultiArray, with a label that names the values."""
    count = len(names)
    dimension = (",".join(names), count, count)
    return layout(schema, ((dimension,), 0), (Slot.VALUE,) * count)
