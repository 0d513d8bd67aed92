"""The motion of a robot in each episode: the one form in which the checks of any episode see it.

State, action and grippers are found by `demorec.episode.roles`. The state's elements are identified by the recording,
the sidecar, the URDF that the user names, or the known robot whose joints have their names. What is unknown is absent.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from demorec.core.geometry import Array, signs_of_course
from demorec.datasets.lerobot.layout import DatasetInfo
from demorec.datasets.lerobot.robots import DatasetRobot, recognised_robot
from demorec.episode.element_names import joint_of
from demorec.episode.episode import Trajectory
from demorec.episode.features import EE_POSE, ENVIRONMENT_STATE, STATE
from demorec.episode.info import EpisodeInfo, Feature
from demorec.episode.roles import NamedRoles, Roles, roles_of_features
from demorec.robots.urdf import Urdf

GRIPPER = "gripper.width"
"""The element that is the opening of a simulated gripper, metres."""
_POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")

MIN_FRAMES = 30
"""Frames below which an episode is too short to judge its lag or its kinematics."""
MIN_RANGE = 1e-3
"""Range, rad or m, below which an element does not move."""

Flags = NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True, eq=False)
class Motion:
    """The motion of a robot in one episode; elements are those of the state.

    Attributes:
        where: "episode 3", or "" where there is only one.
        fps: Frames per second.
        steps_s: (T - 1,) time from each frame to the next, seconds.
        names: Of the D elements.
        grippers: (D,) which of them are grippers or their fingers.
        state: (T, D) rad or m where the joint is known, otherwise as recorded; quaternions by `course_of`.
        velocity, action: (T, D) of the same elements and units, NaN where an element has none; None for no element.
        lower, upper: (D,) limits; infinite where they are not known.
        joints: (D,) of the URDF, "" where it is not known.
        urdf: The joint tree, None where it is not known.
        ee_pose: (T, 7) of the hand, position and quaternion xyzw, if recorded.
        tcp_link: The link that `ee_pose` is the pose of, "" where that is not known.
        sensors: Name -> (T, n) of the other measured quantities.
    """

    where: str
    fps: float
    steps_s: Array
    names: tuple[str, ...]
    grippers: Flags
    state: Array
    velocity: Array | None = None
    action: Array | None = None
    lower: Array
    upper: Array
    joints: tuple[str, ...] = ()
    urdf: Urdf | None = None
    ee_pose: Array | None = None
    tcp_link: str = ""
    sensors: Mapping[str, Array] = field(default_factory=dict)

    @property
    def joint_position(self) -> dict[str, Array]:
        """Joint of the URDF -> (T,)."""
        return {joint: column for joint, column in zip(self.joints, self.state.T, strict=False) if joint}


def without_gaps(values: Array) -> Array:
    """(T, D) values with the last number before each gap in its place; gaps at the start take the first number.

    A column without any number stays as it is.
    """
    known = np.isfinite(values)
    if known.all():
        return values
    frames = np.arange(len(values))[:, None]
    last = np.maximum.accumulate(np.where(known, frames, -1), axis=0)
    source = np.where(last >= 0, last, known.argmax(axis=0))
    return np.asarray(np.take_along_axis(values, source, axis=0))


def quaternion_places(names: Sequence[str]) -> list[int]:
    """The first of each four adjacent elements that are x, y, z and w of one rotation: orientation.x, or qw to qz."""
    fours = [(start, names[start : start + 4]) for start in range(len(names) - 3)]
    return [
        start
        for start, four in fours
        if "".join(each[-1:] for each in four) in ("xyzw", "wxyz") and len({each[:-1] for each in four}) == 1
    ]


def course_of(state: Array, names: Sequence[str]) -> Array:
    """(T, D) states whose quaternions are as near as they can be to those before: both signs mean the same rotation."""
    course = state.astype(np.float64)
    for place in quaternion_places(names):
        course[:, place : place + 4] *= signs_of_course(course[:, place : place + 4])[:, None]
    return course


def motion_of_simulated(info: EpisodeInfo, c: Trajectory, urdf: Urdf) -> Motion:
    """The motion of a recording that demorec simulated, of which everything is known."""
    robot = info.simulated.robot
    n = len(robot.arm_joints)
    return Motion(
        where="",
        fps=info.fps,
        steps_s=np.full(max(c.num_frames - 1, 0), 1 / info.fps),
        names=(*robot.arm_joints, GRIPPER),
        grippers=np.array([*[False] * n, True]),
        state=np.column_stack([c.joint_position[:, :n], c.gripper_width]),
        velocity=np.column_stack([c.joint_velocity[:, :n], np.full(c.num_frames, np.nan)]),
        action=np.column_stack([c.action_joint_target, c.action_gripper]),
        lower=np.array([*robot.position_lower, 0.0]),
        upper=np.array([*robot.position_upper, robot.gripper.max_width]),
        joints=(*robot.arm_joints, ""),
        urdf=urdf,
        ee_pose=c.base_from_tcp,
        tcp_link=robot.tcp_link,
        sensors={
            "velocities": c.joint_velocity[:, :n],
            "efforts": c.joint_effort[:, :n],
            "EE pose": c.base_from_tcp,
            "contact force": c.contact_force[:, None],
            **{name: table.reshape(len(table), -1) for name, table in c.sensed.items()},
        },
    )


def motion_of_features(
    features: Mapping[str, NDArray[Any]],
    described: Iterable[Feature],
    fps: float,
    urdf: str = "",
    time_ns: NDArray[np.int64] | None = None,
    *,
    named: NamedRoles,
) -> Motion | None:
    """The motion in arrays (T, D) by their names; None without a state.

    Args:
        features: Name -> recorded values, (T, D).
        described: Names, units and joints of each.
        fps: Frames per second.
        urdf: Text of the robot's description; "" for the robot whose joints the state's names are.
        time_ns: (T,) of the frames, where they have timestamps of their own.
        named: Features whose role the user names.
    """
    known = {feature.name: feature for feature in described}
    roles = roles_of_features(known.values(), named)
    if not roles.state or not len(features[roles.state[0]]):
        return None
    arm = _arm(roles.elements(roles.state), urdf, _joints([known[part] for part in roles.state]))
    return _motion("", fps, features, known, roles, arm=arm, time_ns=time_ns)


def motions_of_dataset(
    info: DatasetInfo,
    roles: Roles,
    rows_of: Mapping[int, Mapping[str, NDArray[Any]]],
    robots: Mapping[int, DatasetRobot],
    urdf: str,
) -> Iterator[Motion]:
    """The motion of every episode that has a state; by its own robot, otherwise by the URDF that the user names."""
    if not roles.state:
        return
    described = {name: Feature(name=name, names=item.elements) for name, item in roles.columns.items() if item.elements}
    unnamed: _Arm | None = None  # recognising a robot takes time
    for number, rows in rows_of.items():
        robot = robots.get(number)
        where = f"episode {number}"
        if robot is None:
            unnamed = unnamed or _arm(roles.elements(roles.state), urdf)
            yield _motion(where, info.fps, rows, described, roles, arm=unnamed)
            continue
        spec = robot.record.spec
        opening = math.inf if spec is None else spec.gripper.max_width
        known = {name: robot.record.described(feature, roles.usual_name(name)) for name, feature in described.items()}
        arm = _Arm(urdf=robot.model, joints=_joints([known[part] for part in roles.state]))
        motion = _motion(where, info.fps, rows, known, roles, arm=arm, opening=opening)
        yield motion if spec is None else replace(motion, tcp_link=spec.tcp_link)


def _joints(parts: Sequence[Feature]) -> tuple[str, ...]:
    """The joints of the elements of joined features, empty where none is known."""
    joints = tuple(joint for part in parts for joint in part.joints or ("",) * len(part.names))
    return joints if any(joints) else ()


@dataclass(frozen=True, kw_only=True)
class _Arm:
    """The joint tree of a robot as far as it is known, and the joints of the state's elements."""

    urdf: Urdf | None = None
    joints: Sequence[str] = ()


def _arm(names: Sequence[str], urdf: str, joints: Sequence[str] = ()) -> _Arm:
    """By a URDF (its text, "" for none), whose joints the elements are named after or follow, or by their names."""
    if urdf:
        tree = Urdf.parse(urdf)
        movable = [joint.name for joint in tree.depth_first() if joint.kind != "fixed"]
        stems = [joint_of(name) for name in names]
        if not any(joints):
            joints = [stem if stem in movable else "" for stem in stems]
        if not any(joints) and len(movable) >= len(names) - 1 and len(movable) - len(names) in (-1, 0):
            joints = [*movable, ""][: len(names)]  # in the order of the tree; the last one is a gripper
        return _Arm(urdf=tree, joints=joints)
    robot = recognised_robot(tuple(names))
    return _Arm() if robot is None else _Arm(urdf=robot.model, joints=robot.record.joints[STATE])


def _motion(
    where: str,
    fps: float,
    features: Mapping[str, NDArray[Any]],
    described: Mapping[str, Feature],
    roles: Roles,
    *,
    arm: _Arm,
    opening: float = math.inf,
    time_ns: NDArray[np.int64] | None = None,
) -> Motion:
    elements = roles.elements(roles.state)
    tree = {} if arm.urdf is None else {joint.name: joint for joint in arm.urdf.joints}
    found = [tree.get(joint) for joint in arm.joints] or [None] * len(elements)
    lower = np.array([-math.inf if joint is None else joint.lower for joint in found])
    upper = np.array([math.inf if joint is None else joint.upper for joint in found])
    if opening < math.inf and GRIPPER in elements:
        place = list(elements).index(GRIPPER)
        lower[place], upper[place] = 0.0, opening
    state = course_of(_joined(roles.state, features, described), elements)
    action = _same_elements(roles.action, features, described, roles)
    if action is not None:
        _turn_nearest(action, state, elements)
    return Motion(
        where=where,
        fps=fps,
        steps_s=np.full(len(state) - 1, 1 / fps) if time_ns is None else np.maximum(np.diff(time_ns) / 1e9, 0.5 / fps),
        names=elements,
        grippers=roles.grippers(),
        state=state,
        velocity=_same_elements(roles.having("velocity"), features, described, roles),
        action=action,
        lower=lower,
        upper=upper,
        joints=tuple(arm.joints),
        urdf=arm.urdf if any(arm.joints) else None,
        ee_pose=_poses(features, roles),
        sensors=_sensors(features, roles),
    )


def _joined(parts: Sequence[str], features: Mapping[str, NDArray[Any]], described: Mapping[str, Feature]) -> Array:
    """(T, D) of features one behind the other, each in SI by its own units: a leader may record degrees."""
    return np.concatenate([described[part].in_si(features[part]) for part in parts], axis=1)


def _same_elements(
    parts: Sequence[str], features: Mapping[str, NDArray[Any]], described: Mapping[str, Feature], roles: Roles
) -> Array | None:
    """(T, D) of the elements of features that are those of the state, NaN for others; None where none is."""
    columns = roles.in_state(parts) if parts else []
    if all(column is None for column in columns):
        return None
    values = _joined(parts, features, described)
    missing = np.full(len(values), np.nan)
    return np.stack([missing if column is None else values[:, column] for column in columns], axis=1)


def _turn_nearest(action: Array, state: Array, names: Sequence[str]) -> None:
    """Give the quaternions of actions (T, D), in place, the sign that brings them nearest to the state's."""
    for place in quaternion_places(names):
        turn = slice(place, place + 4)
        action[:, turn] *= np.where((action[:, turn] * state[:, turn]).sum(axis=1) < 0, -1.0, 1.0)[:, None]


def _sensors(features: Mapping[str, NDArray[Any]], roles: Roles) -> dict[str, NDArray[Any]]:
    """The observations other than the state, without the simulator's truth."""
    measured = roles.having("sensor", "velocity", "pose", "gripper")
    return {
        name: features[name].reshape(len(features[name]), -1)
        for name in measured
        if roles.columns[name].elements and name not in (ENVIRONMENT_STATE, *roles.state)
    }


def _poses(features: Mapping[str, NDArray[Any]], roles: Roles) -> Array | None:
    """(T, 7) position and quaternion xyzw of the EE pose, or of a pose at the end of the state."""
    for feature in (EE_POSE, *roles.state):
        names = roles.columns[feature].elements if feature in roles.columns else ()
        if len(names) < len(_POSE):
            continue
        words = [name.rpartition(".")[2].rpartition("_")[2] for name in names[-7:]]
        is_ordered = set(_POSE[3:]) <= set(words[3:])
        is_pose = len(names) == 7 if feature == EE_POSE else words[:3] == [*_POSE[:3]] and is_ordered
        if is_pose:
            order = [0, 1, 2, *(words.index(word) if is_ordered else 3 + k for k, word in enumerate(_POSE[3:]))]
            return np.asarray(features[feature].astype(np.float64)[:, -7:][:, order])
    return None


def motion_vector(joint_position: Array) -> Array:
    """A motion as one row of fixed length: joint positions at 32 moments, evenly spread."""
    joint_position = without_gaps(joint_position)
    if not len(joint_position):
        return np.zeros(32)
    moments = np.linspace(0, len(joint_position) - 1, 32).round().astype(int)
    return np.asarray(joint_position[moments], dtype=np.float64).reshape(-1)
