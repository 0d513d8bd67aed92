"""How a robot moves in each episode of whatever is checked: the one form in which the laws of motion see it.

What is known of the elements of `observation.state` comes from the recording, from the sidecar, from the URDF that the
user names, or from the robot whose joints their names are. What is not known is absent.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from demorec.core.geometry import Array, signs_of_course
from demorec.core.tables import ROBOTS
from demorec.datasets.lerobot.layout import DatasetInfo
from demorec.datasets.lerobot.robots import DatasetRobot, recognised_robot
from demorec.episode.episode import Columns
from demorec.episode.features import ACTION, EE_POSE, ENVIRONMENT_STATE, STATE, VELOCITY
from demorec.episode.info import EpisodeInfo, Feature
from demorec.robots.urdf import Urdf

EFFORT = "observation.effort"
GRIPPER = "gripper.width"
"""The element that is the opening of a simulated gripper, metres."""
_GRIPPER_WORDS = ("gripper", "finger")
_SUFFIX = re.compile(r"[._/](pos|position|vel|velocity|width|effort|torque)$")
"""What of the name of an element is not that of its joint."""
_QUATERNION = ("qx", "qy", "qz", "qw")

FEWEST = 30
"""Frames below which an episode says nothing of lags and orders."""
_OWN = 0.5
"""Correlation with its own element above which an action is a target of the state: 0.97 and more in demonstrations of
Panda and iiwa, where increments and poses have 0.3 and less."""
MOVES = 1e-3
"""Range, rad or m, below which an element stands still."""

Flags = NDArray[np.bool_]
Named = tuple[str, Array]


def is_gripper(name: str) -> bool:
    """Whether an element is called after a gripper or its fingers."""
    return any(word in name.lower() for word in _GRIPPER_WORDS)


@dataclass(frozen=True, kw_only=True, eq=False)
class Motion:
    """How a robot moves in one episode; elements are those of observation.state.

    Attributes:
        where: "episode 3", or "" where there is only one.
        fps: Frames per second.
        steps_s: (T - 1,) time from each frame to the next, seconds.
        names: Of the D elements.
        state: (T, D) rad or m where the joint is known, else as it came; quaternions by `course_of`.
        velocity, action, effort: (T, D) of the same elements and units, NaN where an element has none; None for no
            element.
        lower, upper: (D,) limits; infinite where they are not known.
        speed: (D,) largest speed, rad/s or m/s; infinite where it is not known.
        joints: (D,) of the URDF, "" where it is not known.
        urdf: The joint tree, None where it is not known.
        model: Text of a URDF with masses, or its name as by `asset_path`.
        commands: Name -> (T, D) of what else is known to be sent to the same elements, in the same units.
        ee_pose: (T, 7) of the hand, if there.
        tcp_link: The link of which it is the pose, "" where that is not known.
        sensors: Name -> (T, n) of what is measured.
        contact: (T,) N, force on the fingers; None where nobody measures it.
        stroke_s: How long the gripper takes from closed to open, seconds; 0 where it is not known.
    """

    where: str
    fps: float
    steps_s: Array
    names: tuple[str, ...]
    state: Array
    velocity: Array | None = None
    action: Array | None = None
    effort: Array | None = None
    lower: Array
    upper: Array
    speed: Array
    joints: tuple[str, ...] = ()
    urdf: Urdf | None = None
    model: str = ""
    commands: Mapping[str, Array] = field(default_factory=dict)
    ee_pose: Array | None = None
    tcp_link: str = ""
    sensors: Mapping[str, Array] = field(default_factory=dict)
    contact: Array | None = None
    stroke_s: float = 0.0

    @property
    def grippers(self) -> Flags:
        """(D,) elements that are called after a gripper or its fingers."""
        return np.array([is_gripper(name) for name in self.names], dtype=np.bool_)

    @property
    def gripper(self) -> int | None:
        """The element that is the opening of a gripper, if one is."""
        found = np.flatnonzero(self.grippers)
        return int(found[0]) if len(found) == 1 else None

    @property
    def joint_position(self) -> dict[str, Array]:
        """Joint of the URDF -> (T,)."""
        return {joint: column for joint, column in zip(self.joints, self.state.T, strict=False) if joint}

    def labels(self, known: Flags) -> list[str]:
        """Names of some elements."""
        return [name for name, is_known in zip(self.names, known, strict=True) if is_known]


class Motions:
    """All motions of a dataset, or the one of a recording.

    Attributes:
        all: Of every episode that has a state.
    """

    def __init__(self, motions: Sequence[Motion]) -> None:
        self.all = motions

    @cached_property
    def targets(self) -> list[tuple[Array, Array]]:
        """(T, K) states and actions of each episode, of the K elements that have an action and move; less their means
        and in units of the state's deviation. Empty where the action is no target of the state."""
        pairs = [motion for motion in self.all if motion.action is not None and len(motion.state) >= FEWEST]
        kept = self.moving
        if not pairs or not kept.any():
            return []
        found = [
            (_scaled(motion.state, motion.state)[:, kept], _scaled(_action(motion), motion.state)[:, kept])
            for motion in pairs
        ]
        own = np.diag(correlations(found))
        return found if float(np.median(own)) > _OWN else []

    @cached_property
    def moving(self) -> Flags:
        """(D,) elements that have an action, and of which state and action change in some episode."""
        moves = [
            (np.ptp(motion.state, axis=0) > MOVES) & (np.ptp(_action(motion), axis=0) > MOVES)
            for motion in self.all
            if motion.action is not None
        ]
        return np.asarray(np.any(moves, axis=0)) if moves else np.zeros(0, dtype=np.bool_)


def _action(motion: Motion) -> Array:
    assert motion.action is not None
    return motion.action


def _scaled(values: Array, state: Array) -> Array:
    return np.asarray((values - values.mean(axis=0)) / np.maximum(state.std(axis=0), MOVES))


def correlations(targets: Sequence[tuple[Array, Array]]) -> Array:
    """(K, K) of each element of the state with each of the action, over all episodes; 0 where one does not change."""
    state, action = (np.concatenate(part) for part in zip(*targets, strict=True))
    size = np.sqrt(np.outer((state**2).sum(axis=0), (action**2).sum(axis=0)))
    return np.asarray(state.T @ action / np.maximum(size, 1e-12))


def quaternion_places(names: Sequence[str]) -> list[int]:
    """Where four elements in a row are x, y, z and w of one thing: orientation.x to orientation.w, qw to qz."""
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


def _turn_nearest(action: Array, state: Array, names: Sequence[str]) -> None:
    """Give the quaternions of actions (T, D), in place, the sign that brings them nearest to the state's."""
    for place in quaternion_places(names):
        turn = slice(place, place + 4)
        action[:, turn] *= np.where((action[:, turn] * state[:, turn]).sum(axis=1) < 0, -1.0, 1.0)[:, None]


def quaternions(features: Mapping[str, NDArray[Any]], described: Mapping[str, Sequence[str] | None]) -> Iterator[Named]:
    """(what, (T, 4)) of all quaternions, by the names of their elements."""
    for feature, names in described.items():
        for place in quaternion_places(names or ()):
            assert names is not None
            table = features[feature].reshape(-1, len(names)).astype(np.float64)
            yield f"{feature}, {names[place][:-1]}", table[:, place : place + 4]


def motion_of_simulated(info: EpisodeInfo, c: Columns, urdf: Urdf) -> Motion:
    """Of a recording that demorec simulated: all is known."""
    robot = info.robot
    n = len(robot.arm_joints)
    nothing, inf = np.full((c.num_frames, 1), np.nan), (math.inf,)
    sensors = {
        "velocities": c.joint_velocity[:, :n],
        "efforts": c.joint_effort[:, :n],
        "EE pose": c.base_from_tcp,
        **c.sensed,
    }
    return Motion(
        where="",
        fps=info.fps,
        steps_s=np.full(max(c.num_frames - 1, 0), 1 / info.fps),
        names=(*robot.arm_joints, GRIPPER),
        state=np.column_stack([c.joint_position[:, :n], c.gripper_width]),
        velocity=np.column_stack([c.joint_velocity[:, :n], nothing]),
        action=np.column_stack([c.action_joint_target, c.action_gripper]),
        effort=np.column_stack([c.joint_effort[:, :n], nothing]),
        lower=np.array([*robot.position_lower, -1e-3]),  # fingers have mass, and overshoot by a millimetre
        upper=np.array([*robot.position_upper, robot.gripper.max_width + 1e-3]),
        speed=np.array([*robot.velocity_limit, *inf]),
        joints=(*robot.arm_joints, ""),
        urdf=urdf,
        commands={
            "action": np.column_stack([c.action_joint_target, c.action_gripper]),
            "command": np.column_stack([c.command_joint_target, c.command_gripper]),
        },
        ee_pose=c.base_from_tcp,
        sensors=sensors,
        contact=c.contact_force,
        stroke_s=robot.gripper.stroke_seconds(),
    )


def motion_of_features(
    features: Mapping[str, NDArray[Any]],
    described: Iterable[Feature],
    fps: float,
    urdf: str = "",
    time_ns: NDArray[np.int64] | None = None,
) -> Motion | None:
    """Of arrays (T, D) by their names, each of which is described; None without a state.

    Args:
        features: Name -> what was recorded of it, (T, D).
        described: What is known of each of them.
        fps: Frames per second.
        urdf: Text of the robot's description; "" for the robot whose joints the state's names are.
        time_ns: (T,) of the frames, where they have times of their own.
    """
    known = {feature.name: feature for feature in described}
    if STATE not in known or not len(features[STATE]):
        return None
    arm = _arm(known[STATE].names, urdf, known[STATE].joints)
    return _motion("", fps, features, known, arm=arm, time_ns=time_ns)


def motions_of_dataset(
    info: DatasetInfo, rows_of: Sequence[Mapping[str, NDArray[Any]]], robots: Mapping[int, DatasetRobot], urdf: str
) -> Iterator[Motion]:
    """Of every episode of a dataset that has a state; by its own robot, or else by the URDF that the user names."""
    features = info.features
    if STATE not in features or features[STATE].dtype not in ("float32", "float64"):
        return
    described = {
        name: Feature(name=name, names=feature.names or tuple(map(str, range(feature.shape[0]))))
        for name, feature in features.items()
        if feature.is_numeric and len(feature.shape) == 1
    }
    stranger: _Arm | None = None  # what its robot is takes time to find out
    for number, rows in enumerate(rows_of):
        robot = robots.get(number)
        where = f"episode {number}"
        if robot is None:
            stranger = stranger or _arm(described[STATE].names, urdf)
            yield _motion(where, info.fps, rows, described, arm=stranger)
            continue
        spec, arm = robot.record.spec, _Arm.of(robot)
        opening = math.inf if spec is None else spec.gripper.max_width
        known = {name: robot.record.described(feature) for name, feature in described.items()}
        motion = _motion(where, info.fps, rows, known, arm=arm, opening=opening)
        yield motion if spec is None else replace(motion, tcp_link=spec.tcp_link)


@dataclass(frozen=True, kw_only=True)
class _Arm:
    """What is known of the robot: its joint tree, the joints of the state's elements, a model with its masses."""

    urdf: Urdf | None = None
    joints: Sequence[str] = ()
    model: str = ""

    @classmethod
    def of(cls, robot: DatasetRobot) -> _Arm:
        """Of a dataset's robot, whose own URDF has no masses."""
        record = robot.record
        model = record.spec.urdf if record.spec else ROBOTS.load(record.name).urdf if record.name in ROBOTS.rows else ""
        return cls(urdf=robot.model, joints=record.joints.get(STATE, ()), model=model)


def _arm(names: Sequence[str], urdf: str, joints: Sequence[str] = ()) -> _Arm:
    """By a URDF (its text, "" for none), whose joints the elements are named after or follow, or by their names."""
    if urdf:
        tree = Urdf.parse(urdf)
        movable = [joint.name for joint in tree.depth_first() if joint.kind != "fixed"]
        stems = [_SUFFIX.sub("", name) for name in names]
        if not any(joints):
            joints = [stem if stem in movable else "" for stem in stems]
        if not any(joints) and len(movable) >= len(names) - 1 and len(movable) - len(names) in (-1, 0):
            joints = [*movable, ""][: len(names)]  # in the order of the tree; what is left is a gripper
        return _Arm(urdf=tree, joints=joints, model=urdf)
    if (robot := recognised_robot(tuple(names))) is None:
        return _Arm()
    return _Arm.of(robot)


def _motion(
    where: str,
    fps: float,
    features: Mapping[str, NDArray[Any]],
    described: Mapping[str, Feature],
    *,
    arm: _Arm,
    opening: float = math.inf,
    time_ns: NDArray[np.int64] | None = None,
) -> Motion:
    names = {name: feature.names for name, feature in described.items()}
    elements = names[STATE]
    tree = {} if arm.urdf is None else {joint.name: joint for joint in arm.urdf.joints}
    found = [tree.get(joint) for joint in arm.joints] or [None] * len(elements)
    lower = np.array([-math.inf if joint is None else joint.lower for joint in found])
    upper = np.array([math.inf if joint is None else joint.upper for joint in found])
    if opening < math.inf and GRIPPER in elements:
        place = list(elements).index(GRIPPER)
        lower[place], upper[place] = 0.0, opening

    def in_si(feature: str) -> Array:
        """By the feature's own units: a leader may tell degrees of an arm that tells rad."""
        return described[feature].in_si(features[feature])

    state = course_of(in_si(STATE), elements)

    def alike(feature: str) -> Array | None:
        """The elements of another feature that have the names of the state's, or all of as many without names."""
        if feature not in features or feature not in names:
            return None
        values, theirs = in_si(feature), names[feature]
        places = {_SUFFIX.sub("", name): index for index, name in enumerate(theirs)}
        columns = [places.get(_SUFFIX.sub("", name)) for name in elements]
        if all(column is None for column in columns):
            return None
        missing = np.full(len(state), np.nan)
        return np.stack([missing if column is None else values[:, column] for column in columns], axis=1)

    if (action := alike(ACTION)) is not None:
        _turn_nearest(action, state, elements)
    return Motion(
        where=where,
        fps=fps,
        steps_s=np.full(len(state) - 1, 1 / fps) if time_ns is None else np.maximum(np.diff(time_ns) / 1e9, 0.5 / fps),
        names=tuple(elements),
        state=state,
        velocity=alike(VELOCITY),
        action=action,
        effort=alike(EFFORT),
        lower=lower,
        upper=upper,
        speed=np.array([math.inf if joint is None else joint.max_speed for joint in found]),
        joints=tuple(arm.joints),
        urdf=arm.urdf if any(arm.joints) else None,
        model=arm.model,
        ee_pose=_poses(features, names),
        sensors=_sensors(features, names),
    )


def _sensors(features: Mapping[str, NDArray[Any]], names: Mapping[str, Sequence[str]]) -> dict[str, NDArray[Any]]:
    """What is observed beside the state, and is no truth of the simulator's."""
    others = (STATE, ENVIRONMENT_STATE)
    return {
        name: values
        for name, values in features.items()
        if name.startswith("observation.") and name in names and name not in others
    }


def _poses(features: Mapping[str, NDArray[Any]], names: Mapping[str, Sequence[str]]) -> Array | None:
    """(T, 7) position and quaternion xyzw of the EE pose, whose names may say that it has another order."""
    if EE_POSE not in features or features[EE_POSE].shape[1:] != (7,):
        return None
    last = [name.rpartition(".")[2].rpartition("_")[2] for name in names[EE_POSE]]
    order = [last.index(word) for word in _QUATERNION] if set(_QUATERNION) <= set(last) else [3, 4, 5, 6]
    return np.asarray(features[EE_POSE].astype(np.float64)[:, [0, 1, 2, *order]])
