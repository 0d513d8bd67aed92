"""Layout of an episode that demorec simulated: fixed topics, with messages and images at the times of the frames."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property, partial
from operator import attrgetter
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from demorec.core.geometry import Array, Pose
from demorec.episode.episode import Action, Frame, Observation, Trajectory, frame_time_ns
from demorec.episode.info import EpisodeInfo, Feature, SensorStream
from demorec.mcap import messages
from demorec.mcap.cdr import Layout, Slot, layout
from demorec.mcap.channels import (
    ACTION,
    COMMAND,
    DELIBERATE_MISS,
    EE_POSE,
    EVENTS,
    GRIPPER,
    JOINT_STATES,
    PHASE,
    camera_topic,
    object_topic,
    video_topic,
)
from demorec.mcap.container import Container
from demorec.mcap.streams import (
    ColumnArrays,
    FrameStream,
    TimedMessages,
    array_layout,
    concatenated,
    frame_times,
    joint_layout,
    read_columns,
)
from demorec.mcap.transforms import POSE_SLOTS, WORLD
from demorec.robots.robot import RobotSpec

if TYPE_CHECKING:
    from demorec.mcap.metadata import CameraStreams
    from demorec.mcap.scan import ScannedMessage

GRIPPER_JOINT = "gripper"
"""Name of the gripper's opening among the names of joints."""
_JOINT_STATE = ("joint_position", "joint_velocity", "joint_effort")


class FrameValues(NamedTuple):
    """The numbers of a frame; they wait for the rest of their second, and must not be changed meanwhile."""

    observation: Observation
    action: Action
    command: Action
    world_from_camera: dict[str, Pose]

    @classmethod
    def of(cls, frame: Frame) -> FrameValues:
        """Take the numbers of a frame without its images."""
        poses = {name: image.world_from_camera for name, image in frame.images.items()}
        return cls(frame.observation, frame.action, frame.command, poses)


class SimulatedLayout:
    """Topics of one simulated episode, and what its file holds at which time.

    Attributes:
        frame_topic: Topic whose messages are counted as frames.
        event_topics: Topics of events.
    """

    frame_topic = GRIPPER
    event_topics = (EVENTS,)

    def __init__(self, info: EpisodeInfo) -> None:
        self._info = info
        self._robot, self._scene = info.simulated.robot, info.simulated.scene

    @cached_property
    def streams(self) -> tuple[FrameStream, ...]:
        """Streams that become columns; the first one is dense."""
        return tuple(self._streams())

    def due_ns(self, num_frames: int) -> NDArray[np.int64]:
        """(T,) times at which all images are due: those of the frames."""
        return frame_times(num_frames, self._info.fps)

    def read(
        self, container: Container, num_frames: int, image_topics: Mapping[str, str]
    ) -> tuple[Trajectory, TimedMessages]:
        """Read the numbers, and the messages of events, which are stored among them.

        Args:
            container: The open file.
            num_frames: T.
            image_topics: Recorded camera -> topic of its images, in the order of the description.

        Raises:
            RecordingError: A stream is damaged or not at the times of the frames.
        """
        due = self.due_ns(num_frames)
        columns, others = read_columns(
            container,
            self.streams,
            due_ns=due,
            frame_topic=self.frame_topic,
            others=(PHASE, DELIBERATE_MISS, EVENTS),
        )
        for name in ("sensed", "object_poses", "world_from_camera"):
            columns.setdefault(name, {})
        poses = columns.pop("world_from_camera")
        misses = _lasting(others[DELIBERATE_MISS], messages.read_boolean, due, False)
        trajectory = Trajectory(
            **columns,
            world_from_camera={name: poses[name] for name in image_topics},
            phase=tuple(_lasting(others[PHASE], messages.read_string, due, "")),
            is_deliberate_miss=np.array(misses, dtype=np.bool_),
        )
        return trajectory, others[EVENTS]

    def whole_frames(
        self, counts: Counter[str], cameras: Mapping[str, CameraStreams]
    ) -> tuple[int, Callable[[ScannedMessage, int], bool]]:
        """Find what a crash left whole: the frames that all streams have, images included.

        Args:
            counts: Topic -> number of its messages.
            cameras: Recorded cameras.

        Returns:
            Number of frames; and whether a message belongs to them, given which one of its topic it is, from 1.
        """
        topics = {stream.topic for stream in self.streams if not stream.is_dense}
        for camera, streams in cameras.items():
            topics.add(video_topic(camera, streams.video.codec))
            kinds = ("depth", "segmentation")
            topics |= {camera_topic(camera, kind) for kind in kinds if getattr(streams, kind)}
        num_frames = min(counts[topic] for topic in topics)
        last_ns = frame_time_ns(max(num_frames - 1, 0), self._info.fps)
        return num_frames, lambda message, count: message.log_ns <= last_ns

    def _streams(self) -> Iterator[FrameStream]:
        robot = self._robot
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
        for quantity, feature in self._info.sensors.items():
            if feature.stream is not None:
                yield _sensor(quantity, feature, feature.stream)
        for body in self._scene.movable:
            yield _pose(object_topic(body.name), WORLD, "observation.object_poses", "object_poses", body.name)
        for camera in self._scene.cameras:
            topic = camera_topic(camera.name, "pose")
            yield _pose(topic, WORLD, "world_from_camera", "world_from_camera", camera.name)


def _lasting[V](found: TimedMessages, read: Callable[[bytes], V], times: NDArray[np.int64], first: V) -> list[V]:
    """Value at each time, given the messages that report its changes."""
    values = [first, *(read(data) for _, data in found)]
    changes = np.array([time_ns for time_ns, _ in found], dtype=np.int64)
    numbers = np.searchsorted(np.maximum.accumulate(changes), times, side="right")
    return [values[number] for number in numbers.tolist()]


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
    """A pose at a path in `FrameValues` that becomes the rows of `column`; or with a key one of the poses there."""
    found = attrgetter(path)

    def parts(values: FrameValues) -> Sequence[Array]:
        pose: Pose = found(values)[key] if key else found(values)
        return pose.position, pose.quat_xyzw

    def columns(values: NDArray[Any]) -> ColumnArrays:
        return {column: {key: values}} if key else {column: values}

    laid_out = layout(messages.POSE, (Slot.TIME, frame_id), POSE_SLOTS)
    return FrameStream(topic, messages.POSE, laid_out, concatenated(parts), columns)
