"""Decoding of actions into motor commands: the inverse of `demorec.episode.features.action_vectors`."""

from __future__ import annotations

import math
from typing import get_args

import numpy as np
from numpy.typing import NDArray

from demorec.core.geometry import Array, Pose
from demorec.episode import features
from demorec.episode.episode import Action
from demorec.episode.features import ActionKind
from demorec.robots.robot import RobotSpec
from demorec.sim.world import World

ACTION_KINDS: tuple[ActionKind, ...] = get_args(ActionKind)

NULL_GAIN = 0.05
"""Gain that pulls the elbow towards the expert's posture while a policy commands poses."""


def action_bounds(robot: RobotSpec, kind: ActionKind, *, fps: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Lower and upper bound (D,) of each component of an action; units as in `features.action_vectors`."""
    if kind == "joint":
        high = np.array(robot.position_upper)
    elif kind == "joint_increment":
        high = np.array(robot.velocity_limit) / fps
    elif kind == "ee":
        high = np.array([2.0] * 3 + [1.0] * 4)
    else:
        # The arm cannot follow 2 m/s or pi rad/s.
        high = np.array([2.0] * 3 + [math.pi] * 3) / fps
    low = np.array(robot.position_lower) if kind == "joint" else -high
    return np.append(low, 0.0).astype(np.float32), np.append(high, robot.gripper.max_width).astype(np.float32)


class ActionDecoder:
    """Decoder of one episode's actions into commands, starting from the world's current targets.

    Each command is clamped to the joint limits in position and velocity (from the last command) and to the gripper's
    opening; the elbow is pulled towards the expert's posture. An unreachable pose keeps the last joint targets, and
    deltas continue from the last pose that was reached.

    Args:
        world: World at the episode's start.
        kind: Meaning of the actions (`demorec.episode.features.action_vectors`).
    """

    def __init__(self, world: World, kind: ActionKind) -> None:
        self._robot, self._arm, self._kinematics, self._kind = world.robot, world.arm, world.arm.kinematics, kind
        self._max_step = np.array(world.robot.velocity_limit) / world.fps
        self._joint_target: Array = world.arm.target.copy()
        self._tcp_target: Pose = world.observe().base_from_tcp
        self._given: Action | None = None

    def command(self, values: Array) -> Action:
        """Decode an action (D,), float64, into a command."""
        wanted = np.clip(self._wanted(values), self._kinematics.lower, self._kinematics.upper)
        wanted = np.clip(wanted, self._joint_target - self._max_step, self._joint_target + self._max_step)
        gripper = float(np.clip(values[-1], 0.0, self._robot.gripper.max_width))
        self._joint_target = wanted
        self._given = self._arm.action(wanted, gripper)
        return self._given

    def follow(self, command: Action) -> None:
        """Continue from a command that another source sent; after a command decoded here, nothing changes."""
        if command is not self._given:
            self._joint_target, self._tcp_target = command.joint_target, command.base_from_tcp_target

    def _wanted(self, values: Array) -> Array:
        if self._kind == "joint":
            return values[: len(self._joint_target)]
        if self._kind == "joint_increment":
            return features.joint_target_from_increment(self._joint_target, values)
        if self._kind == "ee_delta":
            self._tcp_target = features.pose_from_delta(self._tcp_target, values)
        else:
            self._tcp_target = _pose(values[:7], otherwise=self._tcp_target)
        rest = self._kinematics.turned_towards(np.array(self._robot.home_q), self._tcp_target.position)
        found = self._kinematics.inverse(self._tcp_target, start=self._joint_target, rest=rest, null_gain=NULL_GAIN)
        if found is None:
            found = self._joint_target
            self._tcp_target = self._kinematics.forward(found)
        return found


def _pose(values: Array, *, otherwise: Pose) -> Pose:
    """Build a pose from a position and a quaternion of any length; `otherwise` if the quaternion is (nearly) zero."""
    length = math.sqrt(float((values[3:7] * values[3:7]).sum()))
    if length < 1e-3:
        return otherwise
    return Pose(position=values[:3], quat_xyzw=values[3:7] / length)
