"""The streams with one message a frame, one row each: topic, ROS 2 type, layout, encoding and decoding.

`frame_streams` is the table of an episode. A row says which values of frames its messages hold (`rows`) and which
columns of `Columns` they become when a recording is read (`columns`); the writer, the reader, recovery and the checks
go through the rows and know no topic by name.

A simulated episode has a fixed set of streams. Any other has a topic for each feature, and `/frames`, which says which
sample of every feature and which image of every camera a frame holds: the features' stamps, then the cameras' image
numbers. Messages of features are stored with the frame's time; those that begin with a header have the sample's stamp
there.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from demorec.core.geometry import Array, Pose
from demorec.episode.episode import NO_IMAGE, Action, Frame, Observation, SampledFrame
from demorec.episode.info import EpisodeInfo, Feature
from demorec.episode.sensed import STREAMS, Sensed
from demorec.mcap import messages
from demorec.mcap.cdr import Layout, Slot, layout
from demorec.mcap.channels import (
    ACTION,
    COMMAND,
    EE_POSE,
    GRIPPER,
    JOINT_STATES,
    TF,
    camera_topic,
    object_topic,
)
from demorec.mcap.transforms import POSE_SLOTS, WORLD, FrameTree, transforms_layout
from demorec.robots.robot import RobotSpec

GRIPPER_JOINT = "gripper"
"""Name of the gripper's opening beside the joints' names."""

ColumnArrays = dict[str, NDArray[Any] | dict[str, NDArray[Any]]]
"""Field of `Columns` -> its rows, or name -> rows where the field is a mapping."""


class FrameValues(NamedTuple):
    """The numbers of a frame; they wait for the rest of their second, and must not be changed meanwhile."""

    observation: Observation
    action: Action
    command: Action
    world_from_camera: dict[str, Pose]

    @classmethod
    def of(cls, frame: Frame) -> FrameValues:
        """Those of a frame, without its images."""
        poses = {name: image.world_from_camera for name, image in frame.images.items()}
        return cls(frame.observation, frame.action, frame.command, poses)


@dataclass(frozen=True, eq=False)
class FrameStream:
    """One stream that has a message at each frame.

    Attributes:
        topic: Where.
        schema: ROS 2 type.
        layout: Of its messages, which hold K values.
        rows: Of N frames (`FrameValues`, or `SampledFrame` where demorec did not simulate) the values, (N, K).
        columns: The K values of T messages, (T, K), as columns.
        stamp_ns: What the header of a frame's message says; None: the frame's time.
    """

    topic: str
    schema: str
    layout: Layout
    rows: Callable[[Sequence[Any]], NDArray[Any]]
    columns: Callable[[NDArray[Any]], ColumnArrays]
    stamp_ns: Callable[[Any], int] | None = None

    def encode(self, frames: Sequence[Any], time_ns: Sequence[int]) -> list[bytes]:
        """One message for each frame, at its time."""
        stamps = time_ns if self.stamp_ns is None else list(map(self.stamp_ns, frames))
        return self.layout.encode(np.array(stamps, dtype=np.int64), self.rows(frames))


def frame_streams(info: EpisodeInfo, tree: FrameTree | None = None) -> tuple[FrameStream, ...]:
    """The streams of a recording, with a tree also that of its moving frames.

    `/joint_states` of a simulated episode comes first; it may have more messages between the frames.
    """
    moving: tuple[FrameStream, ...] = ()
    if tree is not None and tree.moving:  # what moves follows from other streams, so it becomes no column
        moving = (FrameStream(TF, messages.TRANSFORMS, transforms_layout(tree.moving), tree.rows, lambda values: {}),)
    if info.simulation is None:
        return (*(_feature(feature) for feature in info.features), *moving, _held(info))
    return (*_simulated_streams(info), *moving)


def _simulated_streams(info: EpisodeInfo) -> Iterator[FrameStream]:
    """The streams of a simulated episode."""
    robot, scene = info.simulated.robot, info.simulated.scene
    arm_and_gripper = (*robot.arm_joints, GRIPPER_JOINT)
    base = robot.base_link
    joint_state = attrgetter(*(f"observation.{name}" for name in _JOINT_STATE))
    yield _joints(JOINT_STATES, robot.joint_names, _gathered(joint_state), _joint_state_columns)
    yield _joints(GRIPPER, (GRIPPER_JOINT,), _gathered(partial(_gripper_parts, robot)), _gripper_columns)
    for topic, kind in ((ACTION, "action"), (COMMAND, "command")):
        yield _joints(topic, arm_and_gripper, partial(_targets, kind), partial(_target_columns, kind))
    yield _pose(EE_POSE, base, "observation.base_from_tcp", "base_from_tcp")
    yield _pose(ACTION + EE_POSE, base, "action.base_from_tcp_target", "action_base_from_tcp")
    yield _pose(COMMAND + EE_POSE, base, "command.base_from_tcp_target", "command_base_from_tcp")
    yield from (_sensed(row, robot) for row in STREAMS.values())
    for body in scene.movable:
        yield _pose(object_topic(body.name), WORLD, "observation.object_poses", "object_poses", body.name)
    for camera in scene.cameras:
        topic = camera_topic(camera.name, "pose")
        yield _pose(topic, WORLD, "world_from_camera", "world_from_camera", camera.name)


# ------------------------------------------------------------------------------------ what the rows are made of


def _gathered(parts: Callable[[Any], Sequence[Array]]) -> Callable[[Sequence[Any]], Array]:
    """The `rows` of a stream whose messages hold these pieces of a frame, one behind the other."""

    def rows(frames: Sequence[Any]) -> Array:
        pieces = [piece for frame in frames for piece in parts(frame)]
        return np.concatenate(pieces).reshape(len(frames), -1)

    return rows


_JOINT_STATE = ("joint_position", "joint_velocity", "joint_effort")


def _joint_state_columns(values: Array) -> ColumnArrays:
    return {name: part.copy() for name, part in zip(_JOINT_STATE, np.split(values, 3, axis=1), strict=True)}


def _gripper_parts(robot: RobotSpec, values: FrameValues) -> Sequence[Array]:
    # The force on the fingers stands in for the effort.
    observation, n = values.observation, len(robot.arm_joints)
    velocity = float(robot.gripper.width_velocity(observation.joint_position[n:], observation.joint_velocity[n:]))
    return (np.array((observation.gripper_width, velocity, observation.contact_force)),)


def _gripper_columns(values: Array) -> ColumnArrays:
    return {"gripper_width": values[:, 0].copy(), "contact_force": values[:, 2].copy()}


def _targets(kind: str, frames: Sequence[FrameValues]) -> Array:
    # No velocity or effort is commanded; zeros, since a viewer makes an empty plot of an empty array.
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
) -> FrameStream:
    slots = (Slot.VALUE,) * len(names)  # position, velocity, effort
    laid_out = layout(messages.JOINT_STATE, (Slot.TIME, ""), tuple(names), slots, slots, slots)
    return FrameStream(topic, messages.JOINT_STATE, laid_out, rows, columns)


def _sensed(row: Sensed, robot: RobotSpec) -> FrameStream:
    if row.layout == "wrench":
        schema, force_and_torque = messages.WRENCH, ((Slot.VALUE,) * 3, (Slot.VALUE,) * 3)
        laid_out = layout(schema, (Slot.TIME, robot.hand_link), force_and_torque)
    else:
        schema, laid_out = messages.FLOAT64_ARRAY, _array_layout(messages.FLOAT64_ARRAY, row.names(robot))
    rows = _gathered(lambda values: (values.observation.sensed[row.quantity],))
    return FrameStream(row.topic, schema, laid_out, rows, lambda values: {"sensed": {row.quantity: values}})


def _pose(topic: str, frame_id: str, path: str, column: str, key: str = "") -> FrameStream:
    """A pose at a path in `FrameValues` that becomes the rows of `column`; or with a key one of the poses there."""
    found = attrgetter(path)

    def parts(values: FrameValues) -> Sequence[Array]:
        pose: Pose = found(values)[key] if key else found(values)
        return pose.position, pose.quat_xyzw

    def columns(values: NDArray[Any]) -> ColumnArrays:
        return {column: {key: values}} if key else {column: values}

    laid_out = layout(messages.POSE, (Slot.TIME, frame_id), POSE_SLOTS)
    return FrameStream(topic, messages.POSE, laid_out, _gathered(parts), columns)


FRAMES = "/frames"
SUBTASK = "/language/subtask"
"""What is begun at a frame, where somebody said it: std_msgs/String."""


def _feature(feature: Feature) -> FrameStream:
    """The messages of a feature: sensor_msgs/JointState where there are joints, else std_msgs/Float64MultiArray."""
    name = feature.name
    if any(feature.joints):  # velocity and effort are empty: they are not known, and zeros would be invented
        joints = tuple(joint or name for name, joint in zip(feature.names, feature.joints, strict=True))
        schema = messages.JOINT_STATE
        laid_out = layout(schema, (Slot.TIME, ""), joints, (Slot.VALUE,) * len(joints), (), ())
    else:
        schema, laid_out = messages.FLOAT64_ARRAY, _array_layout(messages.FLOAT64_ARRAY, feature.names)
    return FrameStream(
        "/" + name.replace(".", "/"),
        schema,
        laid_out,
        _gathered(lambda frame: (frame.samples[name].vector,)),  # float64 holds every bit of a float32
        lambda values: {"features": {name: values.astype(feature.dtype)}},
        stamp_ns=lambda frame: int(frame.samples[name].stamp_ns),
    )


def _held(info: EpisodeInfo) -> FrameStream:
    """`/frames`: std_msgs/Int64MultiArray, whose label names the columns."""
    features, cameras = [feature.name for feature in info.features], [camera.name for camera in info.cameras]

    def rows(frames: Sequence[SampledFrame]) -> NDArray[np.int64]:
        table = [
            [int(frame.samples[name].stamp_ns) for name in features]
            + [int(frame.images.get(name, NO_IMAGE)) for name in cameras]
            for frame in frames
        ]
        return np.array(table, dtype=np.int64)

    def columns(values: NDArray[Any]) -> ColumnArrays:
        taken = iter(values.T.copy())
        return {
            column: {name: next(taken) for name in names}
            for column, names in (("stamps", features), ("images", cameras))
        }

    laid_out = _array_layout(messages.INT64_ARRAY, [*features, *cameras])
    return FrameStream(FRAMES, messages.INT64_ARRAY, laid_out, rows, columns)


def _array_layout(schema: str, columns: Sequence[str]) -> Layout:
    count = len(columns)
    dimension = (",".join(columns), count, count)
    return layout(schema, ((dimension,), 0), (Slot.VALUE,) * count)
