"""A small arm of five joints with a turning jaw, with the proportions of an SO-101, made of boxes for tests."""

from __future__ import annotations

import math

from demorec.robots.robot import JawGripper, RobotSpec

PIVOT_Y, INNER_Y, TIP_Z = 0.030, -0.005, 0.068
"""Position of the jaw's axis in the TCP's frame, and of its inner face at the tip in the jaw's frame, metres
(jaw_arm.urdf).
"""


def opening(q: float) -> float:
    """Distance from the inner face of the fixed finger to the tip of the jaw, metres, along the TCP's y."""
    return PIVOT_Y + INNER_Y * math.cos(q) + TIP_Z * math.sin(q)


JAW_ARM = RobotSpec(
    name="jaw_arm",
    urdf="jaw_arm.urdf",
    base_link="base",
    arm_joints=("pan", "lift", "elbow", "flex", "roll"),
    tcp_link="tcp",
    hand_link="hand",
    home_q=(0.0, 0.05, 0.35, 1.1708, 0.0),
    position_lower=(-1.92, -1.745, -1.69, -1.658, -2.744),
    position_upper=(1.92, 1.745, 1.69, 1.658, 2.841),
    velocity_limit=(4.0,) * 5,
    acceleration_limit=(20.0,) * 5,
    torque_limit=(3.0,) * 5,
    gripper=JawGripper(
        joints=("jaw",),
        finger_links=("hand", "jaw"),
        opening=tuple((q / 100, opening(q / 100)) for q in range(-34, 47, 4)),
        force=0.3,
        finger_depth=0.006,
        palm_clearance=0.058,
    ),
    task_scale=0.38,
)
