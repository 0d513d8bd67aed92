"""A robot as data: what its URDF does not say."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from demorec.core.geometry import Array
from demorec.core.plain import write_flat


@dataclass(frozen=True, kw_only=True)
class ParallelGripper:
    """Two fingers that slide along one line, each by half the opening.

    What an opening means is known here alone: the rest of the program handles joint vectors and openings, and asks. A
    gripper of another kind, such as a turning jaw, is a class with the same attributes and methods.

    Attributes:
        joints: Names of the finger joints; the first one leads.
        finger_links: The link of each finger that touches the object.
        max_width: Full opening, metres.
        force: Of the motor of each joint, N.
        finger_depth: How far the finger tips reach beyond the TCP, metres.
        palm_clearance: From the TCP back to the palm, metres: what fits between the fingers above the grasp.
    """

    joints: tuple[str, ...]
    finger_links: tuple[str, ...]
    max_width: float
    force: float
    finger_depth: float
    palm_clearance: float

    joint_kind: ClassVar[str] = "prismatic"
    """Of the joints in the URDF."""
    joint_speed: ClassVar[float] = 0.1
    """With which the motor of each joint moves it, m/s."""
    gear_ratios: ClassVar[tuple[float, ...]] = (1.0,)
    """How far each joint after the first one moves for each unit of the first."""

    def joint_position(self, width: Array | float) -> Array:
        """Positions (..., n_joints), m, of the finger joints at openings (...), metres."""
        return np.asarray(np.multiply.outer(width, np.full(len(self.joints), 0.5)))

    def width(self, joint_position: Array) -> Array:
        """Openings (...), metres, at positions (..., n_joints), m, of the finger joints."""
        return np.asarray(joint_position.sum(axis=-1))

    def width_velocity(self, joint_position: Array, joint_velocity: Array) -> Array:
        """Speeds (...), m/s, with which the opening grows; positions and velocities (..., n_joints), m and m/s."""
        return np.asarray(joint_velocity.sum(axis=-1))

    def grip_force(self, finger_forces: Sequence[float]) -> float:
        """With what force, N, an object is gripped on which the fingers press so, in the order of `finger_links`."""
        return min(finger_forces)

    def scaled(self, scale: float) -> ParallelGripper:
        """The same gripper with its lengths multiplied."""
        return replace(
            self,
            max_width=self.max_width * scale,
            finger_depth=self.finger_depth * scale,
            palm_clearance=self.palm_clearance * scale,
        )


@dataclass(frozen=True, kw_only=True)
class RobotSpec:
    """An arm with a gripper, as data.

    Attributes:
        name: Row of the robots' table.
        urdf: Path below pybullet_data, "demorec:NAME" for a file of `demorec/sim/assets`, or "MODULE:NAME" for one
            beside a module of one's own.
        base_link: Root link of the URDF.
        arm_joints: Names of the arm's joints, base to flange.
        tcp_link: Link whose frame is the tool centre point: z out of the hand, y along the fingers' motion.
        hand_link: Link that carries the wrist camera and the fingers; the force-torque sensor is where it is mounted.
        home_q: (n_arm,) rest configuration, rad.
        position_lower, position_upper: (n_arm,) rad.
        velocity_limit: (n_arm,) rad/s.
        acceleration_limit: (n_arm,) rad/s^2.
        torque_limit: (n_arm,) N m.
        gripper: What opens and closes.
    """

    name: str
    urdf: str
    base_link: str
    arm_joints: tuple[str, ...]
    tcp_link: str
    hand_link: str
    home_q: tuple[float, ...]
    position_lower: tuple[float, ...]
    position_upper: tuple[float, ...]
    velocity_limit: tuple[float, ...]
    acceleration_limit: tuple[float, ...]
    torque_limit: tuple[float, ...]
    gripper: ParallelGripper

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Arm joints, then gripper joints: the order of every recorded joint vector."""
        return self.arm_joints + self.gripper.joints

    def scaled(self, scale: float) -> RobotSpec:
        """The same robot with its lengths multiplied, as `RobotPlacement.scale` does to the URDF."""
        return replace(self, gripper=self.gripper.scaled(scale))


# In files, since format version 1, a parallel gripper's fields stand beside the robot's.
write_flat(
    RobotSpec,
    "gripper",
    ParallelGripper,
    keys={
        "joints": "gripper_joints",
        "finger_links": "finger_links",
        "max_width": "gripper_max_width",
        "force": "gripper_force",
        "finger_depth": "finger_depth",
        "palm_clearance": "palm_clearance",
    },
)
