"""Your own robot and camera: an xArm 6 with a parallel gripper, and a camera that looks across the table.

cd examples/own_robot
generate-dataset --robot my_robots:XARM6 --cameras front my_robots:CORNER --num-episodes 10 --out recordings/xarm6
"""

from __future__ import annotations

import math

from demorec.api import CameraPreset, ParallelGripper, RobotSpec

TURN = 2 * math.pi

XARM6 = RobotSpec(
    name="xarm6",
    urdf="xarm6.urdf",  # next to this file
    base_link="stand",
    arm_joints=("joint1", "joint2", "joint3", "joint4", "joint5", "joint6"),
    tcp_link="tcp",
    hand_link="gripper_hand",
    home_q=(0.0, -0.55, -0.75, 0.0, 1.30, 0.0),
    position_lower=(-TURN, -2.059, -3.927, -TURN, -1.692, -TURN),
    position_upper=(TURN, 2.094, 0.191, TURN, math.pi, TURN),
    velocity_limit=(3.14,) * 6,
    acceleration_limit=(15.0,) * 6,
    torque_limit=(50.0, 50.0, 32.0, 32.0, 32.0, 20.0),
    gripper=ParallelGripper(
        joints=("gripper_left_joint", "gripper_right_joint"),
        finger_links=("gripper_left_finger", "gripper_right_finger"),
        max_width=0.10,
        force=20.0,
        finger_depth=0.010,
        palm_clearance=0.065,
    ),
)

CORNER = CameraPreset(
    summary="at the table's corner, looking across the workspace at the arm",
    mount="world",
    eye=(1.15, 0.95, 0.75),
    target=(0.35, -0.05, 0.12),
    fov_y=math.radians(42.0),
)
