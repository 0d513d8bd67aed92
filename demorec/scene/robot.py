"""A robot as data: what its URDF does not say."""

from __future__ import annotations

from dataclasses import dataclass, replace


@dataclass(frozen=True, kw_only=True)
class RobotSpec:
    """An arm with a parallel gripper, as data.

    Attributes:
        name: Row of the robots' table.
        urdf: Path below pybullet_data, or "demorec:NAME" for a file of `demorec/sim/assets`.
        base_link: Root link of the URDF.
        arm_joints: Names of the arm's joints, base to flange.
        gripper_joints: Names of the finger joints; each opens by half the width.
        tcp_link: Link whose frame is the tool centre point: z out of the hand, y along the fingers' motion.
        hand_link: Link that carries the wrist camera and the fingers; the force-torque sensor is where it is mounted.
        finger_links: Links that touch the object.
        home_q: (n_arm,) rest configuration, rad.
        position_lower, position_upper: (n_arm,) rad.
        velocity_limit: (n_arm,) rad/s.
        acceleration_limit: (n_arm,) rad/s^2.
        torque_limit: (n_arm,) N m.
        gripper_max_width: Opening, metres.
        gripper_force: Of each finger, N.
        finger_depth: How far the finger tips reach beyond the TCP, metres.
        palm_clearance: From the TCP back to the palm, metres: what fits between the fingers above the grasp.
    """

    name: str
    urdf: str
    base_link: str
    arm_joints: tuple[str, ...]
    gripper_joints: tuple[str, ...]
    tcp_link: str
    hand_link: str
    finger_links: tuple[str, ...]
    home_q: tuple[float, ...]
    position_lower: tuple[float, ...]
    position_upper: tuple[float, ...]
    velocity_limit: tuple[float, ...]
    acceleration_limit: tuple[float, ...]
    torque_limit: tuple[float, ...]
    gripper_max_width: float
    gripper_force: float
    finger_depth: float
    palm_clearance: float

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Arm joints, then gripper joints: the order of every recorded joint vector."""
        return self.arm_joints + self.gripper_joints

    def scaled(self, scale: float) -> RobotSpec:
        """The same robot with its lengths multiplied, as `RobotPlacement.scale` does to the URDF."""
        return replace(
            self,
            gripper_max_width=self.gripper_max_width * scale,
            finger_depth=self.finger_depth * scale,
            palm_clearance=self.palm_clearance * scale,
        )
