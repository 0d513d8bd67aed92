"""Actions of a real arm, for a simulated arm of its kind.

The data have numbers only: the simulated arm starts in the same state, on an empty table, and receives the same
actions. Its distance from the recorded states shows how well the simulator (or the calibration) matches that arm.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from demorec.check.dataset import CheckedDataset
from demorec.core.config import deciding_versions
from demorec.core.errors import ConfigError
from demorec.core.geometry import Array, Pose
from demorec.datasets.lerobot.robots import IN_MOTOR_UNITS, recognised_robot, robot_of_motors
from demorec.episode.element_names import joint_of
from demorec.episode.features import STATE
from demorec.episode.info import EpisodeInfo, Feature, Simulation
from demorec.episode.roles import Roles, roles_of_features
from demorec.episode.scene import Physics, RobotPlacement, Scene
from demorec.episode.simulated import simulated_info
from demorec.extensions.remake.demonstration import JOINTS, OPENING, Demonstration, ReplayOptions, episode_name
from demorec.mcap import open_recording
from demorec.robots.robot import RobotSpec
from demorec.robots.urdf import Urdf
from demorec.tasks.furniture import table_and_floor

GRIPPER = "gripper.width"
"""Element with the opening of a simulated gripper, metres."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Motion:
    """Recorded numbers of one episode.

    Attributes:
        roles: Which features are state and action.
        described: Feature -> its names, units and joints.
        features: Feature -> (T, D).
        joints: Joint of each element of the state, "" if unknown; empty if all are unknown.
    """

    roles: Roles
    described: Mapping[str, Feature]
    features: Mapping[str, NDArray[Any]]
    joints: tuple[str, ...]

    def joined(self, parts: Sequence[str]) -> Array:
        """(T, D) of concatenated features, each in SI by its own units: a leader may record degrees."""
        return np.concatenate([self.described[part].in_si(self.features[part]) for part in parts], axis=1)


def open_real_arm(path: Path, robot: RobotSpec, options: ReplayOptions) -> Demonstration:
    """Open an imported or recorded episode of a real arm.

    Raises:
        ConfigError: The recording is simulated, the joints of its state are not known to be the robot's, or some have
            no action.
        RecordingError: It is damaged.
    """
    if options.motors is not None:
        raise ConfigError(f"--motor-units is for datasets, recordings have units: {path}")
    with open_recording(path) as recording:
        info = recording.info
        if info.simulation is not None:
            raise ConfigError(f"The recording has its own arm and scene: leave out --robot: {path}")
        described = {feature.name: feature for feature in info.features}
        roles = roles_of_features(described.values(), options.named)
        joints = _joints(roles, described) or _named_joints(roles.elements(roles.state), info.urdf)
        motion = _Motion(roles=roles, described=described, features=recording.table().features, joints=joints)
    return _demonstration(motion, robot, fps=info.fps, number=info.episode_index, name=path.name, where=path)


def real_arms(dataset: CheckedDataset, robot: RobotSpec, wanted: Callable[[int], bool]) -> Iterator[Demonstration]:
    """Yield the readable episodes of a dataset.

    The joints are those of the dataset's own robot, of the servos that the user names, or of the state's names.

    Raises:
        ConfigError: The joints of its state are not known to be the robot's, or some have no action.
    """
    roles = dataset.roles
    items = {name: item.elements for name, item in roles.columns.items() if item.elements}
    owners = {row["episode_index"]: row["robot_digest"] for row in dataset.records}
    for number, rows in dataset.numbers.items():
        if not wanted(number):
            continue
        own = robot_of_motors(dataset.motors) if dataset.motors is not None else None
        if own is None and owners.get(number):
            own = dataset.robot(owners[number])
        described = {name: Feature(name=name, names=names) for name, names in items.items()}
        if own is None:
            joints = _named_joints(roles.elements(roles.state), "")
        else:
            described = {
                name: own.record.described(feature, roles.usual_name(name)) for name, feature in described.items()
            }
            joints = _joints(roles, described)
        motion = _Motion(roles=roles, described=described, features=rows, joints=joints)
        name = episode_name(dataset.root, number)
        yield _demonstration(motion, robot, fps=dataset.info.fps, number=number, name=name, where=dataset.root)


def _joints(roles: Roles, described: Mapping[str, Feature]) -> tuple[str, ...]:
    """The joints of the state's elements, empty if none is known."""
    parts = [described[part] for part in roles.state]
    joints = tuple(joint for part in parts for joint in part.joints or ("",) * len(part.names))
    return joints if any(joints) else ()


def _named_joints(names: Sequence[str], urdf: str) -> tuple[str, ...]:
    """Joints named like the elements, or in the URDF's order (its text, "" for none)."""
    if not urdf:
        robot = recognised_robot(tuple(names))
        return () if robot is None else tuple(robot.record.joints[STATE])
    movable = [joint.name for joint in Urdf.parse(urdf).depth_first() if joint.kind != "fixed"]
    joints = tuple(stem if (stem := joint_of(name)) in movable else "" for name in names)
    if any(joints) or len(movable) - len(names) not in (-1, 0):
        return joints
    return (*movable, "")[: len(names)]  # the last one is a gripper


def _demonstration(
    motion: _Motion, robot: RobotSpec, *, fps: int, number: int, name: str, where: Path
) -> Demonstration:
    roles = motion.roles
    columns = roles.in_state(roles.action) if roles.state and roles.action else []
    if all(column is None for column in columns) or not len(motion.features[roles.state[0]]):
        raise ConfigError(
            f"No state and action with the same elements to replay (--state, --action name them): {where}"
        )
    state, commands = motion.joined(roles.state), motion.joined(roles.action)
    missing = np.full(len(state), np.nan)
    actions = np.stack([missing if column is None else commands[:, column] for column in columns], axis=1)
    state, actions = (_of_robot(values, motion, robot, where) for values in (state, actions))
    if np.isnan(actions).any():
        raise ConfigError(f"Not every joint of {robot.name} has an action, so it cannot be replayed: {where}")
    arm = len(robot.arm_joints)
    return Demonstration(
        name=name,
        info=_on_empty_table(robot, state[0], fps, number),
        actions=actions,
        action_kind="joint",
        compared={JOINTS: state[:, :arm], OPENING: state[:, arm:]},
        outcome=None,
        is_measured=True,
        digest=hashlib.sha256(state.tobytes() + actions.tobytes()).hexdigest(),
    )


def _on_empty_table(robot: RobotSpec, start: Array, fps: int, number: int) -> EpisodeInfo:
    """Describe an episode that begins at the joint positions and the opening `start` (n_arm + 1,)."""
    hz = fps * math.ceil(Physics.hz / fps)  # a whole number of steps per frame
    placed = RobotPlacement(
        name=robot.name,
        world_from_base=Pose(),
        joint_position=tuple(start[:-1].tolist()),
        gripper_width=float(start[-1]),
    )
    scene = Scene(robot=placed, bodies=table_and_floor(), physics=Physics(hz=hz))
    simulation = Simulation(root_seed=0, task="", robot=robot, scene=scene, physics_hz=hz)
    return simulated_info(simulation, episode_index=number, instruction="", fps=fps, versions=deciding_versions())


def _of_robot(values: Array, motion: _Motion, robot: RobotSpec, where: Path) -> Array:
    """Select from (T, D) of the state's elements the positions of the arm's joints, rad, and the gripper's opening, m:
    (T, n_arm + 1).
    """
    names = motion.roles.elements(motion.roles.state)
    fingers = robot.gripper.joints
    wanted = [*robot.arm_joints, *(() if GRIPPER in names else fingers)]
    if missing := [joint for joint in wanted if joint not in motion.joints]:
        motors = ", or --motor-units is missing" if robot.name in IN_MOTOR_UNITS else ""
        raise ConfigError(
            f"The elements of the state ({', '.join(names)}) are not known to be the joints "
            f"{', '.join(missing)} of {robot.name}: they belong to another robot{motors}: {where}"
        )
    arm = values[:, [motion.joints.index(joint) for joint in robot.arm_joints]]
    if GRIPPER in names:
        return np.column_stack([arm, values[:, names.index(GRIPPER)]])
    return np.column_stack([arm, robot.gripper.width(values[:, [motion.joints.index(joint) for joint in fingers]])])
