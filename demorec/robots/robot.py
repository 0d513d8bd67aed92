"""Robots as data, beyond their URDFs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import ClassVar

import numpy as np

from demorec.core.geometry import Array


@dataclass(frozen=True, kw_only=True)
class ParallelGripper:
    """Two fingers that slide along one line, each by half the opening; the TCP is midway between them.

    Only this class interprets an opening: the rest of the program handles joint vectors and openings, and calls it. A
    gripper of another kind has the same attributes and methods, like `JawGripper`.

    Attributes:
        joints: Names of the finger joints; the first one leads.
        finger_links: The link of each finger that touches the object.
        max_width: Full opening, metres.
        force: Motor force of each joint, N.
        finger_depth: Distance of the finger tips beyond the TCP, metres.
        palm_clearance: Distance from the TCP back to the palm, metres, available for an object above the grasp.
    """

    joints: tuple[str, ...]
    finger_links: tuple[str, ...]
    max_width: float
    force: float
    finger_depth: float
    palm_clearance: float

    joint_speed: ClassVar[float] = 0.1
    """Motor speed of each joint, m/s."""
    gear_ratios: ClassVar[tuple[float, ...]] = (1.0,)
    """Motion of each joint after the first, relative to the first."""
    min_width: ClassVar[float] = 0.0
    """Opening, metres, when closed on nothing."""
    rotor_inertia: ClassVar[float] = 0.0

    @property
    def open_width(self) -> float:
        """Opening used by tasks, metres."""
        return self.max_width

    def joint_position(self, width: Array | float) -> Array:
        """Compute positions (..., n_joints), m, of the finger joints at openings (...), metres."""
        return np.asarray(np.multiply.outer(width, np.full(len(self.joints), 0.5)))

    def stroke_seconds(self) -> float:
        """Compute the time of the fingers from closed to open, s."""
        return self.max_width / (len(self.joints) * self.joint_speed)

    def width(self, joint_position: Array) -> Array:
        """Compute openings (...), metres, at positions (..., n_joints), m, of the finger joints."""
        return np.asarray(joint_position.sum(axis=-1))

    def width_velocity(self, joint_position: Array, joint_velocity: Array) -> Array:
        """Compute speeds (...), m/s, of the opening from positions and velocities (..., n_joints), m and m/s."""
        return np.asarray(joint_velocity.sum(axis=-1))

    def contact_force(self, width: Array) -> Array:
        """Compute the sum (...), N, of all finger forces on an object that holds them at openings (...), metres."""
        return np.full(np.shape(width), len(self.joints) * self.force)

    def object_offset(self, object_width: float) -> float:
        """Offset along the TCP's y to the middle of an object of this width, metres, before the fingers close on it."""
        del object_width
        return 0.0

    def scaled(self, scale: float) -> ParallelGripper:
        """Multiply the gripper's lengths by a factor."""
        return replace(
            self,
            max_width=self.max_width * scale,
            finger_depth=self.finger_depth * scale,
            palm_clearance=self.palm_clearance * scale,
        )


@dataclass(frozen=True, kw_only=True)
class JawGripper:
    """One finger fixed to the hand, and a jaw turned by one joint.

    The TCP is on the inner face of the fixed finger, its y axis points to the jaw. The opening is interpolated linearly
    between the rows of `opening`; beyond them it is constant.

    Attributes:
        joints: Name of the jaw's joint.
        finger_links: The link of the fixed finger (which may be the hand itself), and that of the jaw.
        opening: Position of the joint, rad, and the opening there, metres, measured at the tips; from closed (as far as
            the expert closes) to open (as far as it opens).
        open_width: Opening used by tasks, metres: a jaw that turns farther may rise above the object to grasp; 0: full.
        force: Torque of the joint's motor, N m.
        finger_depth: Maximum distance of a finger beyond the TCP, at any jaw angle, metres.
        palm_clearance: Distance from the TCP back to the palm, metres, available for an object above the grasp.
        play: Gap between the fixed finger and an object before the jaw pushes it there, metres.
        rotor_inertia: Inertia of the motor after its gears, kg m^2: a bare jaw is so light that the simulator's solver
            computes wrong forces and contacts.
    """

    joints: tuple[str, ...]
    finger_links: tuple[str, ...]
    opening: tuple[tuple[float, float], ...]
    open_width: float = 0.0
    force: float
    finger_depth: float
    palm_clearance: float
    play: float = 0.003
    rotor_inertia: float = 0.0

    joint_speed: ClassVar[float] = 1.0
    """Motor speed of the joint, rad/s."""
    gear_ratios: ClassVar[tuple[float, ...]] = ()

    def __post_init__(self) -> None:
        turns = [b[0] - a[0] for a, b in pairwise(self.opening)]
        grows = all(b[1] >= a[1] for a, b in pairwise(self.opening))
        if not turns or not grows or not (all(t > 0 for t in turns) or all(t < 0 for t in turns)):
            raise ValueError(
                "the opening of a jaw needs two rows or more of joint position and opening, from closed to open, in "
                "which the opening never shrinks while the joint turns one way"
            )
        if not self.open_width:
            object.__setattr__(self, "open_width", self.max_width)

    @property
    def min_width(self) -> float:
        """Opening, metres, when closed on nothing."""
        return self.opening[0][1]

    @property
    def max_width(self) -> float:
        """Full opening, metres."""
        return self.opening[-1][1]

    def joint_position(self, width: Array | float) -> Array:
        """See `ParallelGripper`, in rad."""
        position, opening = np.array(self.opening).T
        return np.asarray(np.interp(width, opening, position)[..., np.newaxis])

    def stroke_seconds(self) -> float:
        """Compute the time of the jaw from closed to the opening used by tasks, s."""
        return float(abs(self.joint_position(self.open_width)[0] - self.opening[0][0])) / self.joint_speed

    def width(self, joint_position: Array) -> Array:
        """See `ParallelGripper`."""
        position, opening = np.array(sorted(self.opening)).T
        return np.asarray(np.interp(joint_position[..., 0], position, opening))

    def width_velocity(self, joint_position: Array, joint_velocity: Array) -> Array:
        """See `ParallelGripper`."""
        return np.asarray(self._slope(joint_position[..., 0]) * joint_velocity[..., 0])

    def contact_force(self, width: Array) -> Array:
        """See `ParallelGripper`; the jaw's force is its torque over d opening / d angle, the fixed finger's equal."""
        slope = np.abs(self._slope(self.joint_position(width)[..., 0]))
        return np.asarray(2 * self.force / np.maximum(slope, 1e-6))

    def object_offset(self, object_width: float) -> float:
        """See `ParallelGripper`; the object starts slightly away from the fixed finger, and is pushed against it."""
        return object_width / 2 + self.play

    def scaled(self, scale: float) -> JawGripper:
        """Multiply the gripper's lengths by a factor."""
        return replace(
            self,
            opening=tuple((position, width * scale) for position, width in self.opening),
            open_width=self.open_width * scale,
            finger_depth=self.finger_depth * scale,
            palm_clearance=self.palm_clearance * scale,
            play=self.play * scale,
        )

    def _slope(self, position: Array) -> Array:
        """Compute d opening / d position, m/rad; beyond the rows that of the nearest two."""
        at, opening = np.array(sorted(self.opening)).T
        piece = np.clip(np.searchsorted(at, position, side="right") - 1, 0, len(at) - 2)
        return np.asarray((np.diff(opening) / np.diff(at))[piece])


Gripper = ParallelGripper | JawGripper
"""A gripper of any kind; all have the same methods."""


_PER_ARM_JOINT = ("home_q", "position_lower", "position_upper", "velocity_limit", "acceleration_limit", "torque_limit")


@dataclass(frozen=True, kw_only=True)
class RobotSpec:
    """An arm with a gripper, as data.

    Attributes:
        name: Row of the robots' table.
        urdf: Path below pybullet_data, "demorec:NAME" for a file of `demorec/sim/assets`, or "MODULE:NAME" for one next
            to a user's module.
        base_link: Root link of the URDF.
        arm_joints: Names of the arm's joints, base to flange.
        tcp_link: Link with its frame at the tool centre point: z out of the hand, y along the fingers' motion.
        hand_link: Link that carries the wrist camera and the fingers; the force-torque sensor is where it is mounted.
        home_q: (n_arm,) rest configuration, rad. Layouts of a small arm keep the area below its low fingers free.
        position_lower, position_upper: (n_arm,) rad.
        velocity_limit: (n_arm,) rad/s.
        acceleration_limit: (n_arm,) rad/s^2.
        torque_limit: (n_arm,) N m.
        gripper: The gripper.
        task_scale: Factor on the lengths of the tasks' layouts and of the expert's heights: 1 for an arm that reaches
            0.3 to 0.7 m from its base with the hand down, less for a small one.
        wrist_camera: Eye, target and up of the usual camera on the hand, in the TCP's frame, metres; (): those of the
            camera's preset.
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
    gripper: Gripper
    task_scale: float = 1.0
    wrist_camera: tuple[tuple[float, float, float], ...] = ()

    def __post_init__(self) -> None:
        for name in _PER_ARM_JOINT:
            values = getattr(self, name)
            if len(values) != len(self.arm_joints):
                raise ValueError(f"{name} has {len(values)} numbers for {len(self.arm_joints)} arm joints")
            if name.endswith("_limit") and not all(value > 0 for value in values):  # NaN is not
                raise ValueError(f"{name} has numbers that are not above 0")

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Arm joints, then gripper joints: the order of every recorded joint vector."""
        return self.arm_joints + self.gripper.joints

    def scaled(self, scale: float) -> RobotSpec:
        """Multiply the robot's lengths by a factor, as `RobotPlacement.scale` does in the URDF."""
        return replace(self, gripper=self.gripper.scaled(scale))
