"""SO-101 follower arm of The Robot Studio and Hugging Face (`demorec/sim/assets/so101.urdf`): five joints and a jaw.

Position limits are the URDF's. Every joint is driven by an STS3215 servo with 1:345 gears; at 7.4 V its data sheet
specifies a stall torque of 19.5 kg cm and 52 rpm without load. Acceleration limits are not published. The jaw closes
with a tenth of that torque: 2.7 N at its tip hold any object that fits. Its motor's inertia (0.028 kg m^2 in MuJoCo
Menagerie's model) is reduced to the value that its contacts need.
"""

import math

from demorec.robots.motors import RealArm
from demorec.robots.robot import JawGripper, RobotSpec

STALL_TORQUE = 19.5e-2 * 9.80665
"""Stall torque of the servo, N m."""
NO_LOAD_SPEED = 52.0 * 2.0 * math.pi / 60.0
"""Speed of the servo without load, rad/s."""

SO101 = RobotSpec(
    name="so101",
    urdf="demorec:so101.urdf",
    base_link="ground",
    arm_joints=("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll"),
    tcp_link="tcp",
    hand_link="gripper_link",
    home_q=(0.0, 0.06422, -0.09751, 1.60408, -1.52212),
    position_lower=(-1.91986, -1.74533, -1.69, -1.65806, -2.74385),
    position_upper=(1.91986, 1.74533, 1.69, 1.65806, 2.84121),
    velocity_limit=(NO_LOAD_SPEED,) * 5,
    acceleration_limit=(20.0,) * 5,
    torque_limit=(STALL_TORQUE,) * 5,
    gripper=JawGripper(
        joints=("gripper",),
        finger_links=("gripper_link", "moving_jaw_so101_v1_link"),
        # Measured on the meshes: the jaw's nearest point to the plane of the fixed finger, less than 12 mm above the
        # TCP.
        opening=(
            (-0.17, 0.0022),
            (-0.1, 0.0078),
            (0.0, 0.0158),
            (0.1, 0.0230),
            (0.2, 0.0303),
            (0.25, 0.0340),
            # A point of its tip, tracked as it turns farther to its stop.
            (0.6, 0.0552),
            (1.0, 0.0753),
            (1.4, 0.0881),
            (1.74533, 0.0917),
        ),
        open_width=0.0340,
        force=0.2,
        finger_depth=0.0085,
        palm_clearance=0.056,
        rotor_inertia=1e-4,
    ),
    task_scale=0.38,
    # The usual mount in the LeRobot community: next to the gripper's motor, looking at the finger tips.
    wrist_camera=((0.0552, 0.0079, -0.0531), (0.0, 0.0079, 0.033), (1.0, 0.0, 0.0)),
)

SO101_FOLLOWER = RealArm(
    robot_type="so_follower",
    middles={
        "shoulder_pan": 0.0,
        "shoulder_lift": 0.0,
        "elbow_flex": 0.0,
        "wrist_flex": 0.0,
        "wrist_roll": 0.0,
        "gripper": math.pi / 4,
    },
    calibration="so101_urdf.json",
)
"""`lerobot-record --robot.type=so101_follower` (0.6.1) writes this robot type for SO-100 and SO-101. The URDF's zeros
are in the middle of the joints' ranges, between the stops that `lerobot-calibrate` finds; the roll has no stops, and
its zero is set by hand. LeRobot's own kinematics interpret such degrees as angles of this URDF. On an arm built this
way, the servos are set to 2047 there, and their ranges are the URDF's limits."""
