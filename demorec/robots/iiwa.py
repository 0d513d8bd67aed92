"""KUKA LBR iiwa 14 on a stand, with demorec's parallel gripper (`demorec/sim/assets/iiwa.urdf`).

Position, velocity and torque limits are the manufacturer's (data sheet of the LBR iiwa 14 R820). KUKA publishes no
acceleration limits: these are moderate ones, similar to the Panda's.
"""

import math

from demorec.robots.robot import ParallelGripper, RobotSpec

_LIMITS = tuple(math.radians(degrees) for degrees in (170.0, 120.0, 170.0, 120.0, 170.0, 120.0, 175.0))

IIWA = RobotSpec(
    name="iiwa",
    urdf="demorec:iiwa.urdf",
    base_link="iiwa_stand",
    arm_joints=tuple(f"iiwa_joint_{i}" for i in range(1, 8)),
    tcp_link="gripper_tcp",
    hand_link="gripper_hand",
    home_q=(0.0, 0.39, 0.0, -1.73, 0.0, math.pi - 0.39 - 1.73, 0.0),
    position_lower=tuple(-limit for limit in _LIMITS),
    position_upper=_LIMITS,
    velocity_limit=tuple(math.radians(speed) for speed in (85.0, 85.0, 100.0, 75.0, 130.0, 135.0, 135.0)),
    acceleration_limit=(8.0, 8.0, 10.0, 10.0, 15.0, 20.0, 20.0),
    torque_limit=(320.0, 320.0, 176.0, 176.0, 110.0, 40.0, 40.0),
    gripper=ParallelGripper(
        joints=("gripper_left_joint", "gripper_right_joint"),
        finger_links=("gripper_left_finger", "gripper_right_finger"),
        max_width=0.10,
        force=20.0,
        finger_depth=0.010,
        palm_clearance=0.065,
    ),
)
