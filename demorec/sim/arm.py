"""An arm with a parallel gripper in the simulator: loading, driving and reading it."""

from __future__ import annotations

from typing import Any

import numpy as np

from demorec.core.geometry import Array, Pose
from demorec.episode.episode import Action
from demorec.episode.scene import POSITION_GAIN, RobotPlacement
from demorec.robots.assets import asset_path
from demorec.robots.kinematics import ArmKinematics
from demorec.robots.model_check import checked_urdf
from demorec.robots.robot import RobotSpec
from demorec.robots.urdf import JointDynamics, read_dynamics
from demorec.sim import lossy_motors
from demorec.sim.bodies import load_urdf
from demorec.sim.lossy_motors import JointMotors

FINGER_DAMPING = 1_000.0
"""Contact damping of the finger pads, N s/m (the value of panda.urdf)."""
FINGER_GAIN = 0.1
"""Ratio of the position error that a finger's motor corrects in a physics step (PyBullet's default)."""


class Arm:
    """The robot of a world, freshly loaded into its client.

    Attributes:
        spec: The robot.
        body: Index of the body in PyBullet.
        links: Link name -> PyBullet link index, -1 for the base.
        kinematics: Kinematics of the arm, in the base frame.
        target: (n_arm,) joint targets of the last command, rad.
        gripper_target: Opening of the last command, metres.
        world_from_base: Pose of the base.
    """

    def __init__(self, client: Any, spec: RobotSpec, placement: RobotPlacement, *, finger_stiffness: float) -> None:
        self.spec = spec
        self.world_from_base = placement.world_from_base
        self._client = client
        self.kinematics = arm_kinematics(spec, scale=placement.scale)  # checks the spec
        base, what = placement.world_from_base, f"robot {spec.name!r}"
        self.body = load_urdf(client, spec.urdf, base, scale=placement.scale, is_fixed=True, what=what, is_robot=True)
        info = [client.getJointInfo(self.body, i) for i in range(client.getNumJoints(self.body))]
        self.links = {spec.base_link: -1} | {row[12].decode(): row[0] for row in info}
        by_name = {row[1].decode(): row[0] for row in info}
        self._arm = [by_name[name] for name in spec.arm_joints]
        self._fingers = [by_name[name] for name in spec.gripper.joints]
        self._tcp = self.links[spec.tcp_link]
        self.finger_links = tuple(self.links[name] for name in spec.gripper.finger_links)
        self._hand = self._mounted_hand()
        self._forces = list(spec.torque_limit)
        self._gains = [POSITION_GAIN] * len(self._arm)
        self._lossy_motors = self._make_lossy_motors()
        self._make_gripper(finger_stiffness)
        self.place(np.array(placement.joint_position), placement.gripper_width)
        self.target = np.array(placement.joint_position, dtype=np.float64)
        self.gripper_target = placement.gripper_width

    def _make_gripper(self, stiffness: float) -> None:
        for link in self.finger_links:
            self._client.changeDynamics(
                self.body,
                link,
                lateralFriction=1.0,
                spinningFriction=0.1,
                rollingFriction=0.0,
                # Without the anchor a held object creeps by a millimetre in ten seconds.
                frictionAnchor=1,
                contactStiffness=stiffness,
                contactDamping=FINGER_DAMPING,
            )
        if rotor := self.spec.gripper.rotor_inertia:
            jaw = self.finger_links[-1]
            inertia = [axis + rotor for axis in self._client.getDynamicsInfo(self.body, jaw)[2]]
            self._client.changeDynamics(self.body, jaw, localInertiaDiagonal=inertia)
        # PyBullet ignores the URDF's mimic joint; without a gear the fingers do not centre the object.
        leader, *followers = self._fingers
        for joint, ratio in zip(followers, self.spec.gripper.gear_ratios, strict=True):
            gear = self._client.createConstraint(
                self.body, leader, self.body, joint, self._client.JOINT_GEAR, [1, 0, 0], [0, 0, 0], [0, 0, 0]
            )
            self._client.changeConstraint(gear, gearRatio=-ratio, erp=0.1, maxForce=50)

    def _make_lossy_motors(self) -> JointMotors | None:
        """Create the motors of all joints; None if the URDF gives none of them damping or friction."""
        found = read_dynamics(asset_path(self.spec.urdf).read_text())
        damping, friction = np.array([found.get(name, JointDynamics()) for name in self.spec.joint_names]).T
        if not damping.any() and not friction.any():
            return None
        gripper, num_arm, num_fingers = self.spec.gripper, len(self._arm), len(self._fingers)
        return JointMotors(
            joints=(*self._arm, *self._fingers),
            limit=np.array([*self.spec.torque_limit, *[gripper.force] * num_fingers]),
            speed=np.array([np.inf] * num_arm + [gripper.joint_speed] * num_fingers),
            gain=np.array([POSITION_GAIN] * num_arm + [FINGER_GAIN] * num_fingers),
            damping=damping,
            friction=friction,
        )

    def _mounted_hand(self) -> int:
        """Return the hand's link, with a force-torque sensor enabled on its joint."""
        hand: int = self.links[self.spec.hand_link]
        self._client.enableJointForceTorqueSensor(self.body, hand, True)
        # PyBullet reports the wrench along the axes of the link's inertia, not of the link.
        self._hand_from_inertia = Pose(quat_xyzw=np.array(self._client.getDynamicsInfo(self.body, hand)[4]))
        return hand

    def place(self, joint_position: Array, gripper_width: float) -> None:
        """Set the arm joints (n_arm,) rad and the opening (m) instantly, at rest, without physics."""
        self.place_joints(np.append(joint_position, self.spec.gripper.joint_position(gripper_width)))

    def place_joints(self, joint_position: Array) -> None:
        """Set all joints (n_joints,), fingers included, instantly, at rest, without physics."""
        for joint, position in zip(self._arm + self._fingers, joint_position.tolist(), strict=True):
            self._client.resetJointState(self.body, joint, position)

    def action(self, joint_target: Array, gripper_target: float) -> Action:
        """Build the action with these targets, rad and metres; its pose is the TCP's at these targets."""
        pose = self.kinematics.forward(joint_target)
        return Action(joint_target=joint_target, gripper_target=gripper_target, base_from_tcp_target=pose)

    def command_gripper(self, width: float) -> None:
        """Set the gripper's motors to an opening, in metres, for a whole control step."""
        self.gripper_target = width
        if self._lossy_motors is not None:
            return
        gripper = self.spec.gripper
        for joint, target in zip(self._fingers, gripper.joint_position(width).tolist(), strict=True):
            self._client.setJointMotorControl2(
                self.body,
                joint,
                self._client.POSITION_CONTROL,
                targetPosition=target,
                force=gripper.force,
                maxVelocity=gripper.joint_speed,
            )

    def drive(self, joint_target: Array) -> None:
        """Set the arm's motors to (n_arm,) targets for the next physics step."""
        if self._lossy_motors is not None:
            fingers = self.spec.gripper.joint_position(self.gripper_target)
            targets = np.concatenate([joint_target, fingers])
            lossy_motors.drive(self._client, self.body, self._lossy_motors, targets)
            return
        self._client.setJointMotorControlArray(
            self.body,
            self._arm,
            self._client.POSITION_CONTROL,
            targetPositions=joint_target.tolist(),
            forces=self._forces,
            positionGains=self._gains,
        )

    def joint_states(self) -> tuple[Array, Array, Array]:
        """Read positions, velocities and applied motor torques of all joints, each (n_joints,)."""
        states = self._client.getJointStates(self.body, self._arm + self._fingers)
        position, velocity, effort = (np.array([state[i] for state in states]) for i in (0, 1, 3))
        if self._lossy_motors is not None:
            effort = self._lossy_motors.effort(effort, velocity)
        return position, velocity, effort

    def hand_wrench(self) -> Array:
        """Read force (N) and torque (N m) with which the arm holds the hand, (6,), along the axes of its link."""
        wrench = np.array(self._client.getJointState(self.body, self._hand)[2])
        return self._hand_from_inertia.apply(wrench.reshape(2, 3)).reshape(6)

    def gripper_width(self) -> float:
        """Read the opening, metres."""
        states = self._client.getJointStates(self.body, self._fingers)
        return float(self.spec.gripper.width(np.array([state[0] for state in states])))

    def arm_position(self) -> Array:
        """Read the (n_arm,) joint positions, rad."""
        return np.array([state[0] for state in self._client.getJointStates(self.body, self._arm)])

    def world_from_tcp(self) -> Pose:
        """Read the TCP pose in the simulator (the link frame, not the centre of mass)."""
        state = self._client.getLinkState(self.body, self._tcp, computeForwardKinematics=True)
        return Pose(position=np.array(state[4]), quat_xyzw=np.array(state[5]))


def arm_kinematics(spec: RobotSpec, *, scale: float = 1.0) -> ArmKinematics:
    """Build a robot's kinematics from its URDF; raises as `demorec.robots.model_check.checked_urdf`."""
    return ArmKinematics(checked_urdf(spec, scale=scale), spec)
