"""Demonstrations of real arms, of which nothing but their own numbers is known: what stood around them is absent.

The simulated arm starts where the recorded one was, on an empty table, and is sent the recorded actions. How far it is
from the recorded states says how well the simulator (or the calibration) fits that arm.
"""

from __future__ import annotations

import hashlib
import math

import numpy as np

from demorec.check.evidence import GRIPPER, Motion
from demorec.core.errors import ConfigError
from demorec.core.geometry import Array, Pose
from demorec.episode.info import EpisodeInfo, Simulation
from demorec.episode.scene import CONTACT_BREAKING_THRESHOLD, FINGER_STIFFNESS, Physics, RobotPlacement, Scene
from demorec.replay.demonstration import Demonstration
from demorec.robots.robot import RobotSpec
from demorec.tasks.furniture import table_and_floor

_LEAST_HZ = Physics.hz
"""Of the physics, which takes whole steps between frames."""


def demonstration_of(
    motion: Motion | None, robot: RobotSpec, *, name: str, where: str, episode_index: int = 0
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


def _of_robot(values: Array, motion: Motion, robot: RobotSpec, where: str) -> Array:
    """(T, n_arm + 1) positions of the arm's joints, rad, and opening of the gripper, m, of (T, D) of a motion."""
    fingers = robot.gripper.joints
    known = [*robot.arm_joints, *(() if GRIPPER in motion.names else fingers)]
    if missing := [joint for joint in known if joint not in motion.joints]:
        raise ConfigError(
            f"The joints {', '.join(missing)} of {robot.name} are not known to be in observation.state "
            f"({', '.join(motion.names)}); of what LeRobot recorded of an SO-101, --motor-units says in which units: "
            f"{where}"
        )
    arm = values[:, [motion.joints.index(joint) for joint in robot.arm_joints]]
    if GRIPPER in motion.names:
        return np.column_stack([arm, values[:, motion.names.index(GRIPPER)]])
    return np.column_stack([arm, robot.gripper.width(values[:, [motion.joints.index(joint) for joint in fingers]])])
