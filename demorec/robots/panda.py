"""Franka Emika Panda with its hand, from pybullet_data.

Limits are the manufacturer's (the URDF's position limits are wider than the real ones).
"""

import math

from demorec.robots.robot import ParallelGripper, RobotSpec

PANDA = RobotSpec(
    name="panda",
    urdf="franka_panda/panda.urdf",
    base_link="panda_link0",
    arm_joints=tuple(f"panda_joint{i}" for i in range(1, 8)),
    tcp_link="panda_grasptarget",
    hand_link="panda_hand",
    home_q=(0.0, -math.pi / 4, 0.0, -3 * math.pi / 4, 0.0, math.pi / 2, math.pi / 4),
    position_lower=(-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973),
    position_upper=(2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973),
    velocity_limit=(2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61),
    acceleration_limit=(15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0),
    torque_limit=(87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0),
    gripper=ParallelGripper(
        joints=("panda_finger_joint1", "panda_finger_joint2"),
        finger_links=("panda_leftfinger", "panda_rightfinger"),
        max_width=0.08,
        force=20.0,
        finger_depth=0.007,
        palm_clearance=0.035,
    ),
)
