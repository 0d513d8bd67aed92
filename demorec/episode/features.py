"""The input and output vectors of policies: one computation for the export and for the environments.

A policy trained on an exported dataset receives the same numbers in closed loop only if both come from the same
arithmetic. So all functions here work on rows (T frames, or one) with the four basic operations and square roots alone.
IEEE 754 rounds these equally on every CPU and for every array length, unlike NumPy's vectorised sines. The result is
rounded once, at the end, if float32 is requested.

Frames: all vectors are in the robot's base frame (equal to the world's if the robot is at its origin).
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from demorec.core.geometry import Array, Pose, quat_multiply, quat_product, rotation_rows
from demorec.episode.episode import Observations, Trajectory
from demorec.episode.info import OBSERVATION, Feature
from demorec.episode.scene import Goal, Scene
from demorec.robots.robot import RobotSpec

Vectors = NDArray[np.float32] | NDArray[np.float64]
VectorType = type[np.float32] | type[np.float64]

STATE = "observation.state"
VELOCITY = "observation.velocity"
EE_POSE = "observation.ee_pose"
EFFORT = "observation.effort"
CONTACT_FORCE = "observation.contact_force"
ENVIRONMENT_STATE = "observation.environment_state"
"""Privileged state: poses and sizes of objects, which no sensor of a real robot measures."""
ACTION = "action"
COMMAND = "command"
"""Feature of the motor commands: the action in joint space plus exploration noise."""
IMAGE_PREFIX, DEPTH_SUFFIX = "observation.images.", "_depth"
"""A camera's images are named IMAGE_PREFIX + its name; its distances also have the suffix."""

ActionKind = Literal["joint", "joint_increment", "ee", "ee_delta"]
"""Content of the action column; `action_vectors` defines each kind."""

StateKind = Literal["joint", "joint_ee"]
STATE_KINDS: tuple[StateKind, ...] = get_args(StateKind)
"""Content of `observation.state`; `observation_vectors` defines both kinds."""

NOISE_DECAY = 0.3
"""Ratio of the exploration noise on the executed commands that decays within 1/30 s, when none is added.

Shared by both sides: `demorec.loop.session.ActionNoise` shapes the noise accordingly, and increments below include this
return.
"""

NEAR = 0.02
"""Offset, metres, at which a near-field component is 0.5. A centimetre decides whether an object is at its goal, but is
a twentieth of a standard deviation of the plain offset, which a policy learns last."""

_POSITION = ("x", "y", "z")
POSE_ELEMENTS = ("x", "y", "z", "qx", "qy", "qz", "qw")
_TCP_NAMES = tuple(f"tcp.{axis}" for axis in POSE_ELEMENTS)


_Columns = Iterator[tuple[tuple[str, ...], Array]]
"""Names of components, and their numbers: (T,) or (T, number of names)."""


def state_names(robot: RobotSpec, kind: StateKind) -> tuple[str, ...]:
    """List the name of every component of `observation.state`."""
    joints = (*(f"{joint}.pos" for joint in robot.arm_joints), "gripper.width")
    return (*joints, *_TCP_NAMES) if kind == "joint_ee" else joints


def observation_names(
    robot: RobotSpec,
    scene: Scene,
    *,
    privileged: bool = False,
    state: StateKind = "joint",
    sensed: Sequence[Feature] = (),
) -> dict[str, tuple[str, ...]]:
    """List feature name -> name of every component, in the order of `observation_vectors`."""
    joints, pose = np.empty((0, len(robot.joint_names))), np.empty((0, 7))
    rows = Observations(
        joint_position=joints,
        joint_velocity=joints,
        joint_effort=joints,
        gripper_width=np.empty(0),
        base_from_tcp=pose,
        object_poses={body.name: pose for body in scene.movable},
        contact_force=np.empty(0),
        sensed={feature.name.removeprefix(OBSERVATION): joints for feature in sensed},
    )
    columns = _observations(rows, robot, scene, privileged, state, sensed)
    return {feature: tuple(name for names, _ in parts for name in names) for feature, parts in columns.items()}


def observation_vectors(
    rows: Observations,
    robot: RobotSpec,
    scene: Scene,
    *,
    privileged: bool = False,
    state: StateKind = "joint",
    sensed: Sequence[Feature] = (),
    dtype: VectorType = np.float32,
) -> dict[str, Vectors]:
    """Compute feature name -> (T, D) numbers of the requested type.

    - `observation.state`: arm joint positions (rad), gripper opening (m); with `state` "joint_ee" followed by the seven
    numbers of `observation.ee_pose`, for policies without a second input vector (LeRobot's ACT).
    - `observation.velocity`: arm joint velocities (rad/s), speed of the gripper's opening (m/s).
    - `observation.ee_pose`: base_from_tcp, xyz (m) and quaternion xyzw, with the sign that makes x >= 0: it does not
    jump for a hand that points down within 180 degrees of yaw.
    - `observation.environment_state` (only if `privileged`): see `_environment`.
    - `sensed`: the optional observations, in their units.
    """
    columns = _observations(rows, robot, scene, privileged, state, sensed)
    return {feature: _joined([numbers for _, numbers in parts], dtype) for feature, parts in columns.items()}


def _observations(
    rows: Observations,
    robot: RobotSpec,
    scene: Scene,
    privileged: bool,
    state: StateKind,
    sensed: Sequence[Feature],
) -> dict[str, _Columns]:
    arm = len(robot.arm_joints)
    pose = _TCP_NAMES, _continuous(rows.base_from_tcp)
    joints = state_names(robot, "joint")
    positions = [(joints[:-1], rows.joint_position[:, :arm]), (joints[-1:], rows.gripper_width)]
    features = {
        STATE: iter([*positions, pose] if state == "joint_ee" else positions),
        VELOCITY: _velocities(rows, robot),
        EE_POSE: iter([pose]),
    }
    if privileged:
        features[ENVIRONMENT_STATE] = _environment(rows, robot, scene)
    values = {OBSERVATION + quantity: numbers for quantity, numbers in rows.sensed.items()}
    values |= {EFFORT: rows.joint_effort[:, :arm], CONTACT_FORCE: rows.contact_force}
    for feature in sensed:
        features[feature.name] = iter([(feature.names, values[feature.name])])
    return features


def _velocities(rows: Observations, robot: RobotSpec) -> _Columns:
    arm = len(robot.arm_joints)
    yield tuple(f"{joint}.vel" for joint in robot.arm_joints), rows.joint_velocity[:, :arm]
    yield ("gripper.vel",), robot.gripper.width_velocity(rows.joint_position[:, arm:], rows.joint_velocity[:, arm:])


def _environment(rows: Observations, robot: RobotSpec, scene: Scene) -> _Columns:
    """Compute first the inputs a policy learns best from, then raw poses (metres, rad; base frame).

    First the TCP: position, yaw of the hand as sine and cosine. Per goal, the object: position, full extents, position
    relative to the TCP in base axes and in hand axes. A body with a yaw symmetry of 2 pi / n also has its yaw as sine
    and cosine of n times the angle, absolute and relative to the hand. The same for the target pose (with the extents
    of the body that supports it, 0 for a goal in the world; the yaw is relative to the object). The offsets object -
    TCP, goal - TCP and goal - object follow again as near-field components d / (|d| + NEAR), in -1..1 and steep around
    0. Then the velocities of `observation.velocity`, because LeRobot's ACT takes no second state vector, and last the
    raw poses of all movable bodies.
    """
    base_from_world = scene.robot.world_from_base.inverse().vector()[np.newaxis]
    tcp = rows.base_from_tcp
    poses = {name: _compose(base_from_world, pose) for name, pose in rows.object_poses.items()}
    for body in scene.fixed:
        poses[body.name] = _compose(base_from_world, body.world_from_body.vector()[np.newaxis])
    yield _axes("tcp."), tcp[:, :3]
    yield _yaw_names("tcp.yaw", 1), _yaw(tcp, 1)
    for label, goal in _labelled_goals(scene):
        body, object_ = scene.body(goal.object), poses[goal.object]
        onto_pose = poses[goal.onto] if goal.onto else base_from_world
        onto_size = scene.body(goal.onto).shape.extents if goal.onto else (0.0, 0.0, 0.0)
        wanted = np.broadcast_to(_compose(onto_pose, goal.onto_from_goal.vector()[np.newaxis]), (len(tcp), 7))
        goal_label, from_object = f"{label}.goal", f"{label}.goal.from_{goal.object}"
        yield from _placed(label, object_, body.shape.extents, tcp)
        if n := body.yaw_symmetry:
            yaw = _yaw(object_, n)
            yield _yaw_names(f"{label}.yaw", n), yaw
            yield _yaw_names(f"{label}.from_tcp.yaw", n), _difference(yaw, _yaw(tcp, n))
        yield from _placed(goal_label, wanted, onto_size, tcp)
        yield _near(f"{label}.from_tcp", tcp, object_)
        yield _near(f"{goal_label}.from_tcp", tcp, wanted)
        yield _near(from_object, object_, wanted)
        if n := goal.yaw_symmetry:
            yaw = _yaw(wanted, n)
            yield _yaw_names(f"{goal_label}.yaw", n), yaw
            yield _yaw_names(f"{from_object}.yaw", n), _difference(yaw, _yaw(object_, n))
    yield from _velocities(rows, robot)
    for body in scene.movable:
        yield tuple(f"{body.name}.pose.{axis}" for axis in POSE_ELEMENTS), poses[body.name]


def _placed(label: str, pose: Array, extents: tuple[float, float, float], tcp: Array) -> _Columns:
    """Yield position, extents and offset from the TCP in base axes and in hand axes, metres."""
    offset = pose[:, :3] - tcp[:, :3]
    conjugate = tcp[:, 3:] * np.array([-1.0, -1.0, -1.0, 1.0])
    yield _axes(f"{label}."), pose[:, :3]
    yield _axes(f"{label}.size."), np.broadcast_to(np.array(extents), (len(tcp), 3))
    yield _axes(f"{label}.from_tcp."), offset
    yield _axes(f"{label}.from_tcp.hand_"), _rotate(conjugate, offset)


def _near(label: str, start: Array, end: Array) -> tuple[tuple[str, ...], Array]:
    offset = end[:, :3] - start[:, :3]
    return _axes(f"{label}.near_"), offset / (np.abs(offset) + NEAR)


def _axes(prefix: str) -> tuple[str, ...]:
    return tuple(prefix + axis for axis in _POSITION)


def _yaw_names(prefix: str, n: int) -> tuple[str, str]:
    times = "" if n == 1 else str(n)
    return f"{prefix}.sin{times}", f"{prefix}.cos{times}"


def _labelled_goals(scene: Scene) -> Iterator[tuple[str, Goal]]:
    """Give each goal a unique label: its object's name, numbered from the second goal of the same object on."""
    seen: Counter[str] = Counter()
    for goal in scene.goals:
        seen[goal.object] += 1
        yield goal.object if seen[goal.object] == 1 else f"{goal.object}#{seen[goal.object]}", goal


def _yaw(pose: Array, n: int) -> Array:
    """Compute sine and cosine (T, 2) of n times the yaw of the body axis used by `demorec.episode.scene.yaw_of`."""
    rotation = _rotation(pose[:, 3:])
    vertical = np.argmax(np.abs(rotation[:, 2]), axis=1)
    horizontal = (vertical + 1) % 3
    frame = np.arange(len(pose))
    x, y = rotation[frame, 0, horizontal], rotation[frame, 1, horizontal]
    length = np.sqrt(x * x + y * y)
    sin1, cos1 = y / length, x / length
    sin, cos = sin1, cos1
    for _ in range(n - 1):
        sin, cos = sin * cos1 + cos * sin1, cos * cos1 - sin * sin1
    return np.stack([sin, cos], axis=1)


def _difference(a: Array, b: Array) -> Array:
    (sin_a, cos_a), (sin_b, cos_b) = a.T, b.T
    return np.stack([sin_a * cos_b - cos_a * sin_b, cos_a * cos_b + sin_a * sin_b], axis=1)


# --------------------------------------------------------------------------------------------------------- actions


def action_names(robot: RobotSpec, kind: ActionKind) -> tuple[str, ...]:
    """List the name of every component of `action_vectors`."""
    if kind == "joint":
        return state_names(robot, "joint")
    if kind == "joint_increment":
        return (*(f"{joint}.delta" for joint in robot.arm_joints), "gripper.width")
    if kind == "ee":
        return (*_TCP_NAMES, "gripper.width")
    return ("tcp.dx", "tcp.dy", "tcp.dz", "tcp.rx", "tcp.ry", "tcp.rz", "gripper.width")


def action_vectors(
    trajectory: Trajectory,
    scene: Scene,
    kind: ActionKind,
    *,
    dtype: VectorType = np.float32,
) -> Vectors:
    """Compute (T, D) numbers of the expert's intended actions, ending with the absolute gripper opening (m).

    - `joint`: absolute joint targets, rad.
    - `joint_increment`: joint target minus that of the previous frame; the first minus the scene's initial joint
    positions. To execute them, sum them up (`joint_target_from_increment`). If the previous frame's executed command
    included noise, the increment also removes the part that decays within a frame (`NOISE_DECAY`): it is then the
    expected motion from the robot's actual state. Otherwise noise would teach a policy to stay off the path, since
    increments of the clean targets do not reflect the deviation.
    - `ee`: absolute base_from_tcp target, xyz (m) and quaternion xyzw with x >= 0.
    - `ee_delta`: change of that pose since the previous frame, the first since the TCP pose observed at frame 0:
    translation in base axes (m), then rotation vector in base axes (rad, |r| <= pi), applied from the left
    (`pose_from_delta`); noise is removed as in `joint_increment`, with rotation vectors added.
    """
    gripper = trajectory.action_gripper
    if kind == "joint":
        return _joined([trajectory.action_joint_target, gripper], dtype)
    if kind == "joint_increment":
        targets, commands = trajectory.action_joint_target, trajectory.command_joint_target
        increments = targets - np.concatenate([np.array([scene.robot.joint_position]), targets[:-1]])
        increments[1:] += _noise_share(trajectory.time_ns) * (targets[:-1] - commands[:-1])
        return _joined([increments, gripper], dtype)
    poses, executed = trajectory.action_base_from_tcp, trajectory.command_base_from_tcp
    if kind == "ee":
        return _joined([_continuous(poses), gripper], dtype)
    before = np.concatenate([trajectory.base_from_tcp[:1], poses[:-1]])
    shifts, turns = poses[:, :3] - before[:, :3], _rotation_vectors(before[:, 3:], poses[:, 3:])
    share = _noise_share(trajectory.time_ns)
    shifts[1:] += share * (poses[:-1, :3] - executed[:-1, :3])
    turns[1:] += share * _rotation_vectors(executed[:-1, 3:], poses[:-1, 3:])
    return _joined([shifts, turns, gripper], dtype)


def _noise_share(time_ns: NDArray[np.int64]) -> float:
    """Compute `NOISE_DECAY` for the interval between these frames."""
    if len(time_ns) < 2:
        return 0.0
    return float(1.0 - (1.0 - NOISE_DECAY) ** (30.0 * 1e-9 * int(time_ns[1] - time_ns[0])))


def joint_target_from_increment(previous: Array, action: NDArray[np.floating]) -> Array:
    """Compute the (n_arm,) joint target after one `joint_increment` action; start from the initial positions."""
    return np.asarray(previous + np.asarray(action, dtype=np.float64)[: len(previous)], dtype=np.float64)


def pose_from_delta(previous: Pose, action: NDArray[np.floating]) -> Pose:
    """Compute the base_from_tcp target after one action of kind `ee_delta`; start from the observed TCP pose."""
    delta = np.asarray(action, dtype=np.float64)
    angle = math.sqrt(float(delta[3]) ** 2 + float(delta[4]) ** 2 + float(delta[5]) ** 2)
    scale = math.sin(angle / 2) / angle if angle > 0 else 0.5
    turn = np.array([delta[3] * scale, delta[4] * scale, delta[5] * scale, math.cos(angle / 2)])
    return Pose(position=previous.position + delta[:3], quat_xyzw=quat_multiply(turn, previous.quat_xyzw))


def _rotation_vectors(before: Array, after: Array) -> Array:
    """Compute the (T, 3) rotation vector from `before` to `after`, applied from the left.

    Uses Python's scalar functions, since NumPy's round differently between CPUs.
    """
    vectors = np.empty((len(after), 3))
    for t, (a, b) in enumerate(zip(after, before, strict=True)):
        x, y, z, w = quat_multiply(a, [-b[0], -b[1], -b[2], b[3]]).tolist()
        if w < 0:
            x, y, z, w = -x, -y, -z, -w
        sine = math.sqrt(x * x + y * y + z * z)
        scale = 2 * math.atan2(sine, w) / sine if sine > 0 else 2.0
        vectors[t] = x * scale, y * scale, z * scale
    return vectors


# ---------------------------------------------------------------------------------------------- arithmetic on rows


def _joined(columns: Sequence[Array], dtype: VectorType) -> Vectors:
    joined: Array = np.column_stack(columns)
    return joined if dtype is np.float64 else joined.astype(np.float32)


def _continuous(pose: Array) -> Array:
    """Flip quaternions of poses to x >= 0."""
    sign = np.where(pose[:, 3:4] < 0, -1.0, 1.0)
    return np.concatenate([pose[:, :3], pose[:, 3:] * sign], axis=1)


def _compose(a: Array, b: Array) -> Array:
    """Compute (T, 7) a @ b; either may have one row."""
    position = a[:, :3] + _rotate(a[:, 3:], b[:, :3])
    return np.concatenate([position, np.stack(quat_product(a[:, 3:].T, b[:, 3:].T), axis=1)], axis=1)


def _rotation(quat: Array) -> Array:
    """Compute (T, 3, 3) rotations of unit quaternions (T, 4) xyzw."""
    return np.stack([np.stack(row, axis=1) for row in rotation_rows(*quat.T)], axis=1)


def _rotate(quat: Array, vector: Array) -> Array:
    r = _rotation(quat)
    return np.asarray(r[:, :, 0] * vector[:, 0:1] + r[:, :, 1] * vector[:, 1:2] + r[:, :, 2] * vector[:, 2:3])
