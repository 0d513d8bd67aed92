"""Topics of other people's robots, a row each, with what a suggested mapping must make of them.

Types, topics, names and rates are those of public drivers: ur_robot_driver, franka_ros2 and franka_ros, ROBOTIS's
open_manipulator, spot_ros2, Isaac Sim's ROS 2 bridge, realsense2_camera, unitree_ros2, interbotix_xs_sdk,
dynamixel_workbench, ros2_controllers, and messages as people define their own. All are written by `rosbags` or `mcap`.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag2 import StoragePlugin

from support import bags
from support.bags import NS, Notes, motion
from support.layout_topics import (
    POSE_NAMES,
    TWIST_NAMES,
    Body,
    Layout,
    Part,
    Topic,
    camera,
    cmd_vel,
    depth_camera,
    field_of,
    flat,
    joint_part,
    joints,
    multi_array,
    odometry,
    pose_at,
    pose_stamped,
    raw_camera,
    scalar,
    state_at,
    tf,
    trajectory,
    trajectory_part,
)

UR = tuple(f"{name}_joint" for name in ("shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3", "shoulder_pan"))
FR3 = tuple(f"fr3_joint{k}" for k in range(1, 8))
FINGERS = ("fr3_finger_joint1", "fr3_finger_joint2")
OMX = ("joint1", "joint2", "joint3", "joint4", "joint5", "gripper_joint_1")
LEGS = tuple(f"{leg}_{joint}" for leg in ("front_left", "front_right") for joint in ("hip_x", "hip_y", "knee"))
VX300S = ("waist", "shoulder", "elbow", "forearm_roll", "wrist_angle", "wrist_rotate", "gripper", "left_finger",
          "right_finger")  # fmt: skip
SIX = tuple(f"joint_{k}" for k in range(1, 7))


def _two_publishers() -> Sequence[Topic]:
    """An arm whose driver changes the order of its joints, and a gripper on the same topic at another rate."""
    arm = joints("/joint_states", UR, rate=100)

    def turned(time: int, number: int) -> Body:
        body = arm.body(time, number)
        return body if number < 70 else {"name": body["name"][::-1], "position": body["position"][::-1].copy()}

    gripper = joints("/joint_states", ("robotiq_85_left_knuckle_joint",), shift=2.0, rate=40)
    return Topic(name=arm.name, type=arm.type, rate=100, body=turned), gripper


def _motors(time: int, shift: float = 0.0) -> list[Body]:
    return [{"q": float(np.float32(number)), "dq": 1.0} for number in motion(time, 20, shift=shift)]


def _dynamixels(time: int) -> Body:
    ticks = np.round(motion(time, 5) * 651.9).astype(int)
    return {"dynamixel_state": [
        {"name": f"joint{k}", "id": k, "present_position": int(tick), "goal_position": int(tick) + 3}
        for k, tick in enumerate(ticks)
    ]}  # fmt: skip


def _in_one_message(arm: str) -> Part:
    sides = ("left", "right")
    return Part(
        topic="/teleoperation",
        names=(
            *(f"{side}_{arm}_positions_{k}" for side in sides for k in range(6)),
            *(f"{side}_{arm}_gripper" for side in sides),
        ),
        numbers=lambda body: [
            *(number for side in sides for number in body[side][f"{arm}_positions"]),
            *(body[side][f"{arm}_gripper"] for side in sides),
        ],
    )


def _mcap(notes: Notes, path: Path) -> Path:
    return bags.write_mcap(notes, path / "bag.mcap")


def _ros1(notes: Notes, path: Path) -> Path:
    return bags.write_mcap(notes, path / "bag.mcap", is_ros1=True)


def _foxglove(notes: Notes, path: Path) -> Path:
    """An MCAP file of Foxglove's own protobuf messages, by its SDK."""
    import foxglove
    from foxglove.channels import CompressedImageChannel, JointStatesChannel
    from foxglove.messages import CompressedImage, JointState, JointStates, Timestamp

    context = foxglove.Context()
    with foxglove.open_mcap(path / "bag.mcap", context=context):
        channels: dict[str, Any] = {}
        for note in notes:
            stamp = Timestamp(*divmod(note.header_ns, NS))
            if "position" in note.body:
                pairs = zip(note.body["name"], note.body["position"].tolist(), strict=True)
                states = [JointState(name=name, position=position) for name, position in pairs]
                channel = channels.get(note.topic) or JointStatesChannel(note.topic, context=context)
                channel.log(JointStates(timestamp=stamp, joints=states), log_time=note.log_ns)
            else:
                channel = channels.get(note.topic) or CompressedImageChannel(note.topic, context=context)
                image = CompressedImage(
                    timestamp=stamp, frame_id=note.frame_id, format="jpeg", data=note.body["data"].tobytes()
                )
                channel.log(image, log_time=note.log_ns)
            channels[note.topic] = channel
    return path / "bag.mcap"


def _sqlite(notes: Notes, path: Path) -> Path:
    return bags.write_rosbag2(notes, path / "bag", storage=StoragePlugin.SQLITE3)


LAYOUTS: dict[str, Layout] = {
    "UR": Layout(
        topics=(
            joints("/joint_states", UR, rate=500), pose_stamped("/tcp_pose_broadcaster/pose"),
            multi_array("/forward_position_controller/commands", 6), raw_camera("/camera/camera/color/image_raw"),
            Topic(name="/force_torque_sensor_broadcaster/wrench", type="geometry_msgs/msg/WrenchStamped",
                  body=lambda time, number: {}),
        ),
        state=(joint_part("/joint_states", UR),),
        action=(Part(topic="/forward_position_controller/commands", names=[f"data_{k}" for k in range(6)],
                     numbers=field_of("data")),),
    ),
    "Franka": Layout(
        topics=(
            Topic(name="/franka_robot_state_broadcaster/robot_state", type="franka_msgs/msg/FrankaRobotState", rate=200,
                  body=lambda time, number: {
                      "measured_joint_state": state_at(FR3, time), "desired_joint_state": state_at(FR3, time, 0.1),
                      "measured_joint_motor_state": state_at(FR3, time, 0.2), "o_t_ee": {"pose": pose_at(time)}}),
            joints("/franka_gripper/joint_states", FINGERS, rate=40, shift=3.0),
            raw_camera("/camera/camera/color/image_raw"),
        ),
        state=(
            Part(topic="/franka_robot_state_broadcaster/robot_state", names=FR3,
                 numbers=lambda body: body["measured_joint_state"]["position"]),
            joint_part("/franka_gripper/joint_states", FINGERS),
        ),
    ),
    "Franka, ROS 1": Layout(
        topics=(
            Topic(name="/franka_state_controller/franka_states", type="franka_msgs/msg/FrankaState", rate=200,
                  body=lambda time, number: {"q": motion(time, 7), "q_d": motion(time, 7, shift=0.1)}),
            joints("/franka_gripper/joint_states", FINGERS, rate=40), camera("/camera/color/image_raw/compressed"),
        ),
        state=(
            Part(topic="/franka_state_controller/franka_states", names=[f"q_{k}" for k in range(7)],
                 numbers=field_of("q")),
            joint_part("/franka_gripper/joint_states", FINGERS),
        ),
        write=_ros1,
    ),
    "ROBOTIS": Layout(
        topics=(joints("/joint_states", OMX, rate=100), trajectory("/leader/joint_trajectory", OMX),
                camera("/camera/cam_top/image_raw/compressed")),
        state=(joint_part("/joint_states", OMX),),
        action=(trajectory_part("/leader/joint_trajectory", OMX),),
    ),
    "tf alone": Layout(
        topics=(tf("/tf", ("link1", "link2", "tool0")), raw_camera("/camera/image_raw")),
        unsure="transforms[child_frame_id=tool0].transform",
    ),
    "poses and a gripper": Layout(
        topics=(pose_stamped("/ee_pose"), scalar("/gripper/width"), pose_stamped("/target_pose", ahead_ns=NS // 10),
                scalar("/gripper/command", shift=0.1, kind="Float32"), camera("/cam_0/image/compressed")),
        state=(
            Part(topic="/ee_pose", names=POSE_NAMES, numbers=lambda body: flat(body["pose"])),
            Part(topic="/gripper/width", names=("gripper_width",), numbers=lambda body: [body["data"]]),
        ),
        action=(
            Part(topic="/target_pose", names=POSE_NAMES, numbers=lambda body: flat(body["pose"])),
            Part(topic="/gripper/command", names=("gripper_command",), numbers=lambda body: [np.float32(body["data"])]),
        ),
        write=_mcap,
    ),
    "Spot": Layout(
        topics=(joints("/spot/joint_states", LEGS), odometry("/spot/odometry"), cmd_vel("/spot/cmd_vel"),
                tf("/tf", ("body", "odom")), camera("/spot/camera/frontleft/compressed"),
                camera("/spot/camera/hand/compressed", 1)),
        state=(joint_part("/spot/joint_states", LEGS),),
        action=(Part(topic="/spot/cmd_vel", names=TWIST_NAMES, numbers=flat),),
        cameras=2,
    ),
    "Isaac": Layout(
        topics=(joints("/joint_states", FR3, rate=60), joints("/joint_command", FR3, shift=0.1, rate=60),
                raw_camera("/rgb")),
        state=(joint_part("/joint_states", FR3),),
        action=(joint_part("/joint_command", FR3),),
        clock_ns=70_000_000,
        write=_sqlite,
    ),
    "RealSense": Layout(
        topics=(joints("/joint_states", SIX), raw_camera("/camera/camera/color/image_raw"),
                depth_camera("/camera/camera/aligned_depth_to_color/image_raw"),
                Topic(name="/camera/camera/imu", type="sensor_msgs/msg/Imu", rate=200, body=lambda time, number: {})),
        state=(joint_part("/joint_states", SIX),),
        cameras=2,
    ),
    "ROS 1": Layout(
        topics=(joints("/joint_states", SIX), joints("/joint_states_desired", SIX, shift=0.1),
                camera("/usb_cam/image_raw/compressed")),
        state=(joint_part("/joint_states", SIX),),
        action=(joint_part("/joint_states_desired", SIX),),
        write=_ros1,
    ),
    "two publishers": Layout(
        topics=(*_two_publishers(), joints("/lead_arm/joint_states", UR, shift=0.1),
                camera("/camera/image_raw/compressed")),
        state=(joint_part("/joint_states", UR), joint_part("/joint_states", ("robotiq_85_left_knuckle_joint",))),
        action=(joint_part("/lead_arm/joint_states", UR),),
    ),
    "leader and follower": Layout(
        topics=(joints("/follower/joint_states", OMX), joints("/leader/joint_states", OMX, shift=0.1),
                joints("/follower/joint_command", OMX, shift=0.1), camera("/cam_wrist/image_raw/compressed")),
        state=(joint_part("/follower/joint_states", OMX),),
        action=(joint_part("/leader/joint_states", OMX),),
        write=_sqlite,
    ),
    "Foxglove's own messages": Layout(
        topics=(*_two_publishers(), joints("/teleop/joint_states", UR, shift=0.1), camera("/camera/front")),
        state=(joint_part("/joint_states", UR), joint_part("/joint_states", ("robotiq_85_left_knuckle_joint",))),
        action=(joint_part("/teleop/joint_states", UR),),
        write=_foxglove,
    ),
    "Unitree": Layout(
        topics=(
            Topic(name="/lowstate", type="unitree_go/msg/LowState", rate=200, has_header=False,
                  body=lambda time, number: {"motor_state": _motors(time)}),
            Topic(name="/lowcmd", type="unitree_go/msg/LowCmd", rate=200, has_header=False,
                  body=lambda time, number: {"motor_cmd": _motors(time, 0.1)}),
            Topic(name="/sportmodestate", type="unitree_go/msg/SportModeState", has_header=False,
                  body=lambda time, number: {"position": motion(time, 3)}),
            camera("/frontvideo/image/compressed"),
        ),
        state=(Part(topic="/lowstate", names=[f"q_{k}" for k in range(20)],
                    numbers=lambda body: [motor["q"] for motor in body["motor_state"]]),),
        action=(Part(topic="/lowcmd", names=[f"q_{k}" for k in range(20)],
                     numbers=lambda body: [motor["q"] for motor in body["motor_cmd"]]),),
    ),
    "Interbotix": Layout(
        topics=(
            joints("/vx300s/joint_states", VX300S),
            Topic(name="/vx300s/commands/joint_group", type="interbotix_xs_msgs/msg/JointGroupCommand",
                  has_header=False,
                  body=lambda time, number: {"name": "arm", "cmd": motion(time, 6, shift=0.1).astype(np.float32)}),
            Topic(name="/vx300s/commands/joint_single", type="interbotix_xs_msgs/msg/JointSingleCommand",
                  has_header=False, body=lambda time, number: {"name": "gripper", "cmd": 0.25 + number / 128}),
            camera("/cam_high/image_raw/compressed"), camera("/cam_left_wrist/image_raw/compressed", 1),
        ),
        state=(joint_part("/vx300s/joint_states", VX300S),),
        action=(
            Part(topic="/vx300s/commands/joint_group", names=[f"cmd_{k}" for k in range(6)], numbers=field_of("cmd")),
            Part(topic="/vx300s/commands/joint_single", names=("cmd",), numbers=lambda body: [body["cmd"]]),
        ),
        cameras=2,
    ),
    "Dynamixel": Layout(
        topics=(
            Topic(name="/dynamixel_workbench/dynamixel_state", has_header=False, rate=100,
                  type="dynamixel_workbench_msgs/msg/DynamixelStateList", body=lambda time, number: _dynamixels(time)),
            camera("/usb_cam/image_raw/compressed"),
        ),
        state=(Part(topic="/dynamixel_workbench/dynamixel_state", names=[f"joint{k}" for k in range(5)],
                    numbers=lambda body: [item["present_position"] for item in body["dynamixel_state"]]),),
    ),
    "messages of one's own": Layout(
        topics=(
            Topic(name="/arm/telemetry", type="my_arm_msgs/msg/ArmState", rate=100,
                  body=lambda time, number: {"q": motion(time, 6), "dq": np.ones(6), "tau": np.ones(6)}),
            Topic(name="/arm/sent", type="my_arm_msgs/msg/ArmCommand",
                  body=lambda time, number: {"position": motion(time, 6, shift=0.1), "stiffness": np.ones(6)}),
            raw_camera("/overhead/image_raw"),
        ),
        state=(Part(topic="/arm/telemetry", names=[f"q_{k}" for k in range(6)], numbers=field_of("q")),),
        action=(Part(topic="/arm/sent", names=[f"position_{k}" for k in range(6)],
                     numbers=lambda body: np.float32(body["position"])),),
        write=_mcap,
    ),
    "all in one message": Layout(
        topics=(
            Topic(name="/teleoperation", type="my_arm_msgs/msg/Teleoperation", rate=60, body=lambda time, number: {
                side: {"leader_positions": motion(time, 6, shift=k + 0.1), "follower_positions": motion(time, 6),
                       "leader_gripper": 0.5 + number / 256, "follower_gripper": 0.25 + number / 256}
                for k, side in enumerate(("left", "right"))}),
            camera("/head/image/compressed"),
        ),
        state=(_in_one_message("follower"),),
        action=(_in_one_message("leader"),),
    ),
    "two arms in namespaces": Layout(
        topics=(
            *(joints(f"/{side}/joint_states", SIX, shift=k) for k, side in enumerate(("left", "right"))),
            *(joints(f"/{side}_gello/joint_states", SIX, shift=k + 0.1) for k, side in enumerate(("left", "right"))),
            camera("/left/wrist_cam/image_raw/compressed"), camera("/right/wrist_cam/image_raw/compressed", 1),
        ),
        state=tuple(
            Part(topic=f"/{side}/joint_states", names=[f"{side}_{name}" for name in SIX], numbers=field_of())
            for side in ("left", "right")
        ),
        action=tuple(
            Part(topic=f"/{side}_gello/joint_states", names=[f"{side}_{name}" for name in SIX], numbers=field_of())
            for side in ("left", "right")
        ),
        cameras=2,
    ),
    "mobile base": Layout(
        topics=(odometry("/odom"), cmd_vel("/cmd_vel"), camera("/camera/image_raw/compressed")),
        state=(Part(topic="/odom", names=(*POSE_NAMES, *TWIST_NAMES),
                    numbers=lambda body: [*flat(body["pose"]["pose"]), *flat(body["twist"]["twist"])]),),
        action=(Part(topic="/cmd_vel", names=TWIST_NAMES, numbers=flat),),
    ),
    "trajectories": Layout(
        topics=(
            joints("/joint_states", SIX, rate=100), trajectory("/joint_trajectory_controller/joint_trajectory", SIX),
            Topic(name="/joint_trajectory_controller/controller_state",
                  type="control_msgs/msg/JointTrajectoryControllerState",
                  body=lambda time, number: {"joint_names": list(SIX), **{
                      name: {"positions": motion(time, 6)} for name in ("desired", "actual", "error")}}),
            camera("/camera/image_raw/compressed"),
        ),
        state=(joint_part("/joint_states", SIX),),
        action=(trajectory_part("/joint_trajectory_controller/joint_trajectory", SIX),),
    ),
    "DROID": Layout(
        topics=(
            Topic(name="/droid/robot_state", type="droid_msgs/msg/RobotState", rate=60, body=lambda time, number: {
                "cartesian_position": motion(time, 6, shift=4.0), "gripper_position": 0.5 + number / 256,
                "joint_positions": motion(time, 7), "joint_velocities": np.ones(7)}),
            Topic(name="/droid/action", type="droid_msgs/msg/Action", rate=60, body=lambda time, number: {
                "cartesian_velocity": np.ones(6), "joint_position": motion(time, 7, shift=0.1),
                "gripper_position": 0.75}),
            camera("/droid/varied_camera_1/image/compressed"), camera("/droid/wrist_camera/image/compressed", 1),
        ),
        state=(
            Part(topic="/droid/robot_state", names=(*(f"joint_positions_{k}" for k in range(7)), "gripper_position"),
                 numbers=lambda body: [*body["joint_positions"], body["gripper_position"]]),
        ),
        action=(
            Part(topic="/droid/action", names=(*(f"joint_position_{k}" for k in range(7)), "gripper_position"),
                 numbers=lambda body: [*body["joint_position"], body["gripper_position"]]),
        ),
        cameras=2,
    ),
    "topics of numbers": Layout(
        topics=(
            multi_array("/robot_state/joint_positions", 7), multi_array("/robot_state/cartesian_position", 6),
            scalar("/robot_state/gripper_position"), multi_array("/action/joint_velocity", 7, shift=2.0),
            multi_array("/action/joint_position", 7, shift=0.1), scalar("/action/gripper_position", shift=0.1),
            raw_camera("/cameras/wrist/image_raw"),
        ),
        state=(
            Part(topic="/robot_state/joint_positions", names=[f"data_{k}" for k in range(7)], numbers=field_of("data")),
            Part(topic="/robot_state/gripper_position", names=("robot_state_gripper_position",),
                 numbers=lambda body: [body["data"]]),
        ),
        action=(
            Part(topic="/action/joint_position", names=[f"data_{k}" for k in range(7)], numbers=field_of("data")),
            Part(topic="/action/gripper_position", names=("action_gripper_position",),
                 numbers=lambda body: [body["data"]]),
        ),
        write=_sqlite,
    ),
}  # fmt: skip
"""Name -> layout."""
