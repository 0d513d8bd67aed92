"""Demonstrations of real arms, of which nothing but their own numbers is known: what stood around them is absent.

The simulated arm starts where the recorded one was, on an empty table, and is sent the recorded actions. How far it is
from the recorded states says how well the simulator (or the calibration) fits that arm.
"""

from __future__ import annotations

import hashlib
import math
from pathlib import Path

import numpy as np

from demorec.check.evidence import GRIPPER, Motion
from demorec.core.config import deciding_versions
from demorec.core.errors import ConfigError
from demorec.core.geometry import Array, Pose
from demorec.datasets.lerobot.robots import IN_MOTOR_UNITS
from demorec.episode.info import EpisodeInfo, Simulation
from demorec.episode.scene import CONTACT_BREAKING_THRESHOLD, FINGER_STIFFNESS, Physics, RobotPlacement, Scene
from demorec.replay.demonstration import Demonstration
from demorec.robots.robot import RobotSpec
from demorec.tasks.furniture import table_and_floor

_LEAST_HZ = Physics.hz
"""Of the physics, which takes whole steps between frames."""


def demonstration_of(
    motion: Motion | None, robot: RobotSpec, *, name: str, where: Path, episode_index: int
) -> Demonstration:
    """What an arm was told to do in an episode, for a simulated one of its kind.

    Args:
        motion: Of the episode; None for one without a state.
        robot: The simulated arm.
        name: Of the demonstration.
        where: Its file or dataset, for messages.
        episode_index: Number of the episode.

    Raises:
        ConfigError: The joints of its state are not known to be those of the robot, or some have no action.
    """
    if motion is None or motion.action is None:
        raise ConfigError(f"There is no observation.state with an action of the same elements to replay: {where}")
    state, action = (_of_robot(values, motion, robot, where) for values in (motion.state, motion.action))
    if np.isnan(action).any():
        raise ConfigError(f"Not every joint of {robot.name} has an action, so it cannot be replayed: {where}")
    count, fps = len(robot.arm_joints), round(motion.fps)
    hz = fps * math.ceil(_LEAST_HZ / fps)
    start = RobotPlacement(
        name=robot.name,
        world_from_base=Pose(),
        joint_position=tuple(state[0, :count].tolist()),
        gripper_width=float(state[0, count]),
    )
    physics = Physics(hz=hz, contact_breaking_threshold=CONTACT_BREAKING_THRESHOLD, finger_stiffness=FINGER_STIFFNESS)
    info = EpisodeInfo(
        episode_index=episode_index,
        instruction="",
        fps=fps,
        versions=deciding_versions(),
        simulation=Simulation(
            root_seed=0,
            task="",
            robot=robot,
            scene=Scene(robot=start, bodies=table_and_floor(), physics=physics),
            physics_hz=hz,
        ),
    )
    return Demonstration(
        name=name,
        info=info,
        fps=fps,
        actions=action,
        action_kind="joint",
        joint_position=state[:, :count],
        gripper_width=state[:, count],
        object_poses={},
        recorded_success=None,
        is_measured=True,
        digest=hashlib.sha256(state.tobytes() + action.tobytes()).hexdigest(),
    )


def _of_robot(values: Array, motion: Motion, robot: RobotSpec, where: Path) -> Array:
    """(T, n_arm + 1) positions of the arm's joints, rad, and opening of the gripper, m, of (T, D) of a motion."""
    fingers = robot.gripper.joints
    wanted = [*robot.arm_joints, *(() if GRIPPER in motion.names else fingers)]
    if missing := [joint for joint in wanted if joint not in motion.joints]:
        motors = ", or --motor-units is missing" if robot.name in IN_MOTOR_UNITS else ""
        raise ConfigError(
            f"The elements of observation.state ({', '.join(motion.names)}) are not known to be the joints "
            f"{', '.join(missing)} of {robot.name}: it is of another robot{motors}: {where}"
        )
    arm = values[:, [motion.joints.index(joint) for joint in robot.arm_joints]]
    if GRIPPER in motion.names:
        return np.column_stack([arm, values[:, motion.names.index(GRIPPER)]])
    return np.column_stack([arm, robot.gripper.width(values[:, [motion.joints.index(joint) for joint in fingers]])])
