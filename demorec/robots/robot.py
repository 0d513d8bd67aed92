"""A robot as data: what its URDF does not say."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import ClassVar

import numpy as np

from demorec.core.geometry import Array


@dataclass(frozen=True, kw_only=True)
class ParallelGripper:
    """Two fingers that slide along one line, each by half the opening; the TCP lies midway between them.

    What an opening means is known here alone: the rest of the program handles joint vectors and openings, and asks. A
    gripper of another kind has the same attributes and methods, as `JawGripper` has.

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
    min_width: ClassVar[float] = 0.0
    """Opening, metres, when closed on nothing."""
    rotor_inertia: ClassVar[float] = 0.0

    @property
    def open_width(self) -> float:
        """How far tasks open it, metres."""
        return self.max_width

    def joint_position(self, width: Array | float) -> Array:
        """Positions (..., n_joints), m, of the finger joints at openings (...), metres."""
        return np.asarray(np.multiply.outer(width, np.full(len(self.joints), 0.5)))

    def stroke_seconds(self) -> float:
        """How long the fingers take from closed to open, s."""
        return self.max_width / (len(self.joints) * self.joint_speed)

    def width(self, joint_position: Array) -> Array:
        """Openings (...), metres, at positions (..., n_joints), m, of the finger joints."""
        return np.asarray(joint_position.sum(axis=-1))

    def width_velocity(self, joint_position: Array, joint_velocity: Array) -> Array:
        """Speeds (...), m/s, with which the opening grows; positions and velocities (..., n_joints), m and m/s."""
        return np.asarray(joint_velocity.sum(axis=-1))

    def contact_force(self, width: Array) -> Array:
        """Sum (...), N, of the forces of all fingers on what keeps them at openings (...), metres, apart."""
        return np.full(np.shape(width), len(self.joints) * self.force)

    def object_offset(self, object_width: float) -> float:
        """From the TCP along its y to the middle of an object of this width, metres, before the fingers close on it."""
        del object_width
        return 0.0

    def scaled(self, scale: float) -> ParallelGripper:
        """The same gripper with its lengths multiplied."""
        return replace(
            self,
            max_width=self.max_width * scale,
            finger_depth=self.finger_depth * scale,
            palm_clearance=self.palm_clearance * scale,
        )


@dataclass(frozen=True, kw_only=True)
class JawGripper:
    """One finger that is fixed to the hand, and a jaw that one joint turns.

    The TCP lies on the inner face of the fixed finger, its y axis points to the jaw. Between the rows of `opening` the
    opening is interpolated linearly; of what lies beyond them, it is that of the nearest row.

    Attributes:
        joints: Name of the jaw's joint.
        finger_links: The link of the fixed finger (which may be the hand itself), and that of the jaw.
        opening: Position of the joint, rad, and the opening there, metres, measured at the tips; from closed (what the
            expert closes to) to open (as far as it opens).
        open_width: How far tasks open it, metres: a jaw that turns on may rise above what it shall grasp; 0: fully.
        force: Torque of the joint's motor, N m.
        finger_depth: How far a finger reaches beyond the TCP, the jaw wherever it turns, metres.
        palm_clearance: From the TCP back to the palm, metres: what fits between the fingers above the grasp.
        play: Air between the fixed finger and an object before the jaw pushes it there, metres.
        rotor_inertia: Of the motor, seen through its gears, kg m^2: a bare jaw is so light that the simulator's solver
            gets neither its force nor its contacts right.
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

    joint_kind: ClassVar[str] = "revolute"
    joint_speed: ClassVar[float] = 1.0
    """rad/s."""
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
        """Positions (..., 1), rad, at openings (...), metres."""
        position, opening = np.array(self.opening).T
        return np.asarray(np.interp(width, opening, position)[..., np.newaxis])

    def stroke_seconds(self) -> float:
        """How long the jaw takes from closed to where tasks open it, s."""
        return float(abs(self.joint_position(self.open_width)[0] - self.opening[0][0])) / self.joint_speed

    def width(self, joint_position: Array) -> Array:
        """Openings (...), metres, at positions (..., 1), rad."""
        position, opening = self._rising()
        return np.asarray(np.interp(joint_position[..., 0], position, opening))

    def width_velocity(self, joint_position: Array, joint_velocity: Array) -> Array:
        """Speeds (...), m/s, with which the opening grows; positions and velocities (..., 1), rad and rad/s."""
        return np.asarray(self._slope(joint_position[..., 0]) * joint_velocity[..., 0])

    def contact_force(self, width: Array) -> Array:
        """As of `ParallelGripper`: the jaw's force is its torque over d opening / d angle, the fixed finger's equal."""
        slope = np.abs(self._slope(self.joint_position(width)[..., 0]))
        return np.asarray(2 * self.force / np.maximum(slope, 1e-6))

    def object_offset(self, object_width: float) -> float:
        """As of `ParallelGripper`: the object begins a little beside the fixed finger, against which it is pushed."""
        return object_width / 2 + self.play

    def scaled(self, scale: float) -> JawGripper:
        """The same gripper with its lengths multiplied."""
        return replace(
            self,
            opening=tuple((position, width * scale) for position, width in self.opening),
            open_width=self.open_width * scale,
            finger_depth=self.finger_depth * scale,
            palm_clearance=self.palm_clearance * scale,
            play=self.play * scale,
        )

    def _rising(self) -> tuple[Array, Array]:
        """Positions, rising, and the openings there."""
        position, opening = np.array(sorted(self.opening)).T
        return position, opening

    def _slope(self, position: Array) -> Array:
        """d opening / d position, m/rad; beyond the rows that of the nearest two."""
        at, opening = self._rising()
        piece = np.clip(np.searchsorted(at, position, side="right") - 1, 0, len(at) - 2)
        return np.asarray((np.diff(opening) / np.diff(at))[piece])


Gripper = ParallelGripper | JawGripper
"""What opens and closes: each kind answers the same questions."""


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
        home_q: (n_arm,) rest configuration, rad. Layouts of a small arm leave free what its fingers hang over too low.
        position_lower, position_upper: (n_arm,) rad.
        velocity_limit: (n_arm,) rad/s.
        acceleration_limit: (n_arm,) rad/s^2.
        torque_limit: (n_arm,) N m.
        gripper: What opens and closes.
        task_scale: Factor on the lengths of the tasks' layouts and of the expert's heights: 1 for an arm that reaches
            0.3 to 0.7 m from its base with the hand down, less for a small one.
        wrist_camera: Eye, target and up of a camera on the hand where the arm has a usual mount, in the TCP's frame,
            metres; (): as the camera's preset has them.
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

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Arm joints, then gripper joints: the order of every recorded joint vector."""
        return self.arm_joints + self.gripper.joints

    def scaled(self, scale: float) -> RobotSpec:
        """The same robot with its lengths multiplied, as `RobotPlacement.scale` does to the URDF."""
        return replace(self, gripper=self.gripper.scaled(scale))
