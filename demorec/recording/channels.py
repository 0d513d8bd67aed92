"""Every stream of a recording: its topic, its ROS 2 type, how a frame becomes its message and how to read it back.

A stream is one row of `STATE_STREAMS` (numbers, once a frame) or one constant topic below (pictures, text, things
that are said once). A new one is a row here and, where users shall read it, a field of `EpisodeColumns`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from demorec.episode import Action, EpisodeInfo, Frame, Observation
from demorec.geometry import Array, Pose
from demorec.recording import messages
from demorec.recording.cdr import CdrWriter, Layout
from demorec.recording.description import body_description, robot_description
from demorec.recording.labels import segment_names, to_labels
from demorec.recording.transforms import WORLD, FrameTree, camera_frame

JOINT_STATES = "/joint_states"
GRIPPER = "/gripper"
ACTION = "/action"
COMMAND = "/command"
EE_POSE = "/ee_pose"
PHASE = "/phase"
EVENTS = "/events"
DELIBERATE_MISS = "/deliberate_miss"
LABELS = "/labels"
TF = "/tf"
TF_STATIC = "/tf_static"

_BACKDROP_METRES = 3.0
"""Larger bodies (floors, walls) are not described: a viewer would stand so far off that the robot is a dot."""

GRIPPER_JOINT = "gripper"
"""Name of the gripper's opening beside the joints' names."""


def object_topic(name: str) -> str:
    """Pose of a movable body."""
    return f"/object/{name}/pose"


def description_topic(body: str = "") -> str:
    """URDF of a body, or of the robot."""
    return f"/object/{body}/robot_description" if body else "/robot_description"


def camera_topic(camera: str, stream: str) -> str:
    """A stream of a camera: pose, camera_info, h264, video, image/compressed, depth, segmentation, histogram."""
    return f"/camera/{camera}/{stream}"


class Numbers(NamedTuple):
    """The numbers of a frame; they wait for the rest of their second, and must not be changed meanwhile."""

    observation: Observation
    action: Action
    command: Action
    world_from_camera: dict[str, Pose]

    @classmethod
    def of(cls, frame: Frame) -> Numbers:
        """Those of a frame, without its pictures."""
        poses = {name: image.world_from_camera for name, image in frame.images.items()}
        return cls(frame.observation, frame.action, frame.command, poses)


@dataclass(frozen=True, kw_only=True, eq=False)
class StateStream:
    """One stream of numbers.

    Attributes:
        topic: Where.
        schema: ROS 2 type.
        layout: Of its messages.
        parts: The numbers of a frame, in pieces.
        arrange: All pieces of N frames, (N, ...), to the layout's values (N, K); None when they are these already.
    """

    topic: str
    schema: str
    layout: Layout
    parts: Callable[[Numbers], Sequence[Array]]
    arrange: Callable[[Array], Array] | None = None

    def rows(self, numbers: Sequence[Numbers]) -> Array:
        """All pieces of N frames, (N, ...)."""
        pieces = [piece for frame in numbers for piece in self.parts(frame)]
        return np.concatenate(pieces).reshape(len(numbers), -1)

    def encode(self, time_ns: Sequence[int], values: Array) -> list[bytes]:
        """One message for each row of all pieces (N, ...)."""
        if self.arrange is not None:
            values = self.arrange(values)
        return self.layout.encode(np.array(time_ns, dtype=np.int64), values)


def state_streams(info: EpisodeInfo) -> Iterator[StateStream]:
    """The streams that have one message a frame, `/joint_states` first, which may have more in between."""
    arm_and_gripper = (*info.robot.arm_joints, GRIPPER_JOINT)
    base = info.robot.base_link
    yield _joints(JOINT_STATES, info.robot.joint_names, _joint_state_parts)
    yield _joints(GRIPPER, (GRIPPER_JOINT,), _gripper_values(len(info.robot.gripper_joints)))
    yield _joints(ACTION, arm_and_gripper, lambda numbers: _targets(numbers.action), _with_zeros)
    yield _joints(COMMAND, arm_and_gripper, lambda numbers: _targets(numbers.command), _with_zeros)
    yield _pose(EE_POSE, base, lambda numbers: numbers.observation.base_from_tcp)
    yield _pose(ACTION + EE_POSE, base, lambda numbers: numbers.action.base_from_tcp_target)
    yield _pose(COMMAND + EE_POSE, base, lambda numbers: numbers.command.base_from_tcp_target)
    for body in info.scene.movable:
        yield _pose(object_topic(body.name), WORLD, _object_pose(body.name))
    for camera in info.scene.cameras:
        yield _pose(camera_topic(camera.name, "pose"), WORLD, _camera_pose(camera.name))


def _object_pose(name: str) -> Callable[[Numbers], Pose]:
    return lambda numbers: numbers.observation.object_poses[name]


def _camera_pose(name: str) -> Callable[[Numbers], Pose]:
    return lambda numbers: numbers.world_from_camera[name]


def _joint_state_parts(numbers: Numbers) -> Sequence[Array]:
    observation = numbers.observation
    return observation.joint_position, observation.joint_velocity, observation.joint_effort


def _gripper_values(num_fingers: int) -> Callable[[Numbers], Sequence[Array]]:
    # The opening's velocity is the sum of the fingers' velocities; the force on them stands in for the effort.
    def values(numbers: Numbers) -> Sequence[Array]:
        observation = numbers.observation
        velocity = sum(observation.joint_velocity[-num_fingers:].tolist())
        return (np.array((observation.gripper_width, velocity, observation.contact_force)),)

    return values


def _targets(action: Action) -> Sequence[Array]:
    return action.joint_target, np.array((action.gripper_target,))


def _with_zeros(targets: Array) -> Array:
    # No velocity or effort is commanded; zeros, since a viewer makes an empty plot of an empty array.
    return np.concatenate((targets, np.zeros((len(targets), 2 * targets.shape[1]))), axis=1)


def tf_stream(frames: FrameTree) -> StateStream:
    """The moving coordinate frames; derived from other streams, so not read back."""
    message = CdrWriter()
    message.u32(len(frames.moving))
    for parent, child in frames.moving:
        message.header(parent)
        message.text(child)
        message.value_slot(7)
    return StateStream(
        topic=TF,
        schema=messages.TRANSFORMS,
        layout=message.layout(),
        parts=lambda numbers: frames.parts(numbers.observation),
        arrange=frames.arrange,
    )


def said_once(info: EpisodeInfo, frames: FrameTree, *, has_labels: bool) -> Iterator[tuple[str, str, bytes]]:
    """(topic, type, message) of what holds for the whole episode."""
    yield TF_STATIC, messages.TRANSFORMS, messages.transforms(frames.static)
    robot = robot_description(info.robot.urdf, info.scene.robot.scale)
    yield description_topic(), messages.STRING, messages.string(robot)
    for body in info.scene.bodies:
        if max(body.shape.extents) > _BACKDROP_METRES:
            continue
        yield description_topic(body.name), messages.STRING, messages.string(body_description(body))
    for camera in info.scene.cameras:
        data = messages.camera_info(camera, camera_frame(camera.name))
        yield camera_topic(camera.name, "camera_info"), messages.CAMERA_INFO, data
    if has_labels:
        values, names = zip(*segment_names(info), strict=True)
        numbers = to_labels(np.array([values], dtype=np.int32))[0].tolist()
        yield LABELS, messages.LABEL_INFO, messages.label_info(list(zip(numbers, names, strict=True)))


def _joints(
    topic: str,
    names: Sequence[str],
    parts: Callable[[Numbers], Sequence[Array]],
    arrange: Callable[[Array], Array] | None = None,
) -> StateStream:
    layout = _joints_layout(tuple(names))
    return StateStream(topic=topic, schema=messages.JOINT_STATE, layout=layout, parts=parts, arrange=arrange)


def _pose(topic: str, frame_id: str, pose: Callable[[Numbers], Pose]) -> StateStream:
    return StateStream(
        topic=topic,
        schema=messages.POSE,
        layout=_pose_layout(frame_id),
        parts=lambda numbers: ((found := pose(numbers)).position, found.quat_xyzw),
    )


# The recordings of a run have the same few layouts, and an export opens many.
@lru_cache(maxsize=64)
def _joints_layout(names: tuple[str, ...]) -> Layout:
    message = CdrWriter()
    message.header("")
    message.u32(len(names))
    for name in names:
        message.text(name)
    for _ in range(3):  # position, velocity, effort
        message.u32(len(names))
        message.value_slot(len(names))
    return message.layout()


@lru_cache(maxsize=64)
def _pose_layout(frame_id: str) -> Layout:
    message = CdrWriter()
    message.header(frame_id)
    message.value_slot(7)
    return message.layout()


PHASE_EVENT = "phase"
"""Name of the events that the writer adds at each change of phase, so that a log shows them too."""

_VIDEO_STREAMS = {"h264": "h264", "av1": "video", "jpeg": "image/compressed"}


def video_topic(camera: str, codec: str) -> str:
    """Where the coded colour pictures of a camera are read from."""
    return camera_topic(camera, _VIDEO_STREAMS[codec])
