"""From what a policy says to what the motors get: the inverse of `demorec.episode.features.action_vectors`."""

from __future__ import annotations

import math
from typing import get_args

import numpy as np

from demorec.core.geometry import Array, Pose
from demorec.episode import features
from demorec.episode.episode import Action
from demorec.episode.features import ActionKind
from demorec.robots.robot import RobotSpec
from demorec.sim.world import World

ACTION_KINDS: tuple[ActionKind, ...] = get_args(ActionKind)

NULL_GAIN = 0.05
"""Pull of the elbow towards where the expert has it, when a policy commands poses."""


def action_bounds(robot: RobotSpec, kind: ActionKind, *, fps: int) -> tuple[Array, Array]:
    """Lowest and highest value (D,) of every component of an action; units as of `features.action_vectors`."""
    if kind == "joint":
        low, high = np.array(robot.position_lower), np.array(robot.position_upper)
    elif kind == "joint_increment":
        high = np.array(robot.velocity_limit) / fps
        low = -high
    elif kind == "ee":
        high = np.array([2.0] * 3 + [1.0] * 4)
        low = -high
    else:
        # 2 m/s and pi rad/s are more than the arm can follow.
        high = np.array([2.0] * 3 + [math.pi] * 3) / fps
        low = -high
    return np.append(low, 0.0), np.append(high, robot.gripper.max_width)


class ActionDecoder:
    """Turns the actions of one episode into commands, from the world's present targets on.

    For a pose out of reach the last joint targets stay.

    Args:
        world: At the episode's start.
        kind: What the actions mean (`demorec.episode.features.action_vectors`).
        is_limited: True for what a policy says: every command is held within the joint limits in position and velocity
            (from the last command) and the gripper within its opening, the elbow is pulled towards where the expert
            has it, and deltas go on from the last pose that was reached. False for recorded actions, which are sent as
            they are, so that a replay shows what they do.

    Attributes:
        num_unreachable: Poses that inverse kinematics has not reached so far.
    """

    def __init__(self, world: World, kind: ActionKind, *, is_limited: bool = True) -> None:
        self.num_unreachable = 0
        self._is_limited = is_limited
        self._robot, self._arm, self._kinematics, self._kind = world.robot, world.arm, world.arm.kinematics, kind
        self._max_step = np.array(world.robot.velocity_limit) / world.fps
        self._joint_target: Array = world.arm.target.copy()
        self._tcp_target: Pose = world.observe().base_from_tcp
        self._given: Action | None = None

    def command(self, values: Array) -> Action:
        """The command for an action (D,), float64."""
        wanted, gripper = self._wanted(values), float(values[-1])
        if self._is_limited:
            wanted = np.clip(wanted, self._kinematics.lower, self._kinematics.upper)
            wanted = np.clip(wanted, self._joint_target - self._max_step, self._joint_target + self._max_step)
            gripper = float(np.clip(gripper, 0.0, self._robot.gripper.max_width))
        self._joint_target = wanted
        self._given = self._arm.action(wanted, gripper)
        return self._given

    def follow(self, command: Action) -> None:
        """Go on from a command that somebody else has sent; nothing changes after one that was decoded here."""
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
        rest = None
        if self._is_limited:
            rest = self._kinematics.turned_towards(np.array(self._robot.home_q), self._tcp_target.position)
        found = self._kinematics.inverse(self._tcp_target, start=self._joint_target, rest=rest, null_gain=NULL_GAIN)
        if found is None:
            self.num_unreachable += 1
            found = self._joint_target
            if self._is_limited:
                self._tcp_target = self._kinematics.forward(found)
        return found


def _pose(values: Array, *, otherwise: Pose) -> Pose:
    """Position and quaternion of any length; the given pose where the quaternion is (nearly) zero."""
    length = math.sqrt(float((values[3:7] * values[3:7]).sum()))
    if length < 1e-3:
        return otherwise
    return Pose(position=values[:3], quat_xyzw=values[3:7] / length)
