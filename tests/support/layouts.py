"""Topics of other people's robots, a row each, with what a suggested mapping must make of them.

Types, topics, names and rates are those of public drivers: ur_robot_driver, franka_ros2 and franka_ros, ROBOTIS's
open_manipulator, spot_ros2, Isaac Sim's ROS 2 bridge, realsense2_camera, unitree_ros2, interbotix_xs_sdk,
dynamixel_workbench, ros2_controllers, and messages as people define their own. All are written by `rosbags` or `mcap`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag2 import StoragePlugin
from support import bags
from support.bags import EPOCH_NS, NS, Note, Notes, motion

SECONDS = 1.5
Body = dict[str, Any]

DEFINITIONS = {
    "franka_msgs/msg/Elbow": "float64[2] position\nfloat64[2] desired_position\nfloat64[2] commanded_position\n",
    "franka_msgs/msg/FrankaRobotState": (
        "std_msgs/Header header\nsensor_msgs/JointState measured_joint_state\nsensor_msgs/JointState "
        "desired_joint_state\nsensor_msgs/JointState measured_joint_motor_state\nfloat64[7] ddq_d\nfloat64[7] dtau_j\n"
        "sensor_msgs/JointState tau_ext_hat_filtered\nfranka_msgs/Elbow elbow\ngeometry_msgs/PoseStamped o_t_ee\n"
        "geometry_msgs/PoseStamped o_t_ee_d\nfloat64 time\nuint8 robot_mode\n"
    ),
    "franka_msgs/msg/FrankaState": (
        "std_msgs/Header header\nfloat64[6] cartesian_collision\nfloat64[7] q\nfloat64[7] q_d\nfloat64[7] dq\n"
        "float64[7] dq_d\nfloat64[7] theta\nfloat64[7] tau_J\nfloat64[2] elbow\nfloat64[7] joint_collision\n"
        "float64[16] O_T_EE\nfloat64 time\nuint8 robot_mode\n"
    ),
    "unitree_go/msg/IMUState": (
        "float32[4] quaternion\nfloat32[3] gyroscope\nfloat32[3] accelerometer\nfloat32[3] rpy\nint8 temperature\n"
    ),
    "unitree_go/msg/MotorState": (
        "uint8 mode\nfloat32 q\nfloat32 dq\nfloat32 ddq\nfloat32 tau_est\nfloat32 q_raw\nfloat32 dq_raw\nfloat32 "
        "ddq_raw\nint8 temperature\nuint32 lost\nuint32[2] reserve\n"
    ),
    "unitree_go/msg/MotorCmd": "uint8 mode\nfloat32 q\nfloat32 dq\nfloat32 tau\nfloat32 kp\nfloat32 kd\nuint32[3] reserve\n",
    "unitree_go/msg/LowState": (
        "uint8[2] head\nuint8 level_flag\nunitree_go/IMUState imu_state\nunitree_go/MotorState[20] motor_state\n"
        "int16[4] foot_force\nuint32 tick\nuint8[40] wireless_remote\nfloat32 power_v\nuint32 crc\n"
    ),
    "unitree_go/msg/LowCmd": "uint8[2] head\nuint8 level_flag\nunitree_go/MotorCmd[20] motor_cmd\nuint32 crc\n",
    "unitree_go/msg/SportModeState": "uint8 mode\nfloat32[3] position\nfloat32 body_height\nfloat32[3] velocity\n",
    "interbotix_xs_msgs/msg/JointGroupCommand": "string name\nfloat32[] cmd\n",
    "interbotix_xs_msgs/msg/JointSingleCommand": "string name\nfloat32 cmd\n",
    "dynamixel_workbench_msgs/msg/DynamixelState": (
        "string name\nuint8 id\nint32 goal_position\nint16 present_current\nint32 present_velocity\n"
        "int32 present_position\n"
    ),
    "dynamixel_workbench_msgs/msg/DynamixelStateList": "dynamixel_workbench_msgs/DynamixelState[] dynamixel_state\n",
    "control_msgs/msg/JointTrajectoryControllerState": (
        "std_msgs/Header header\nstring[] joint_names\ntrajectory_msgs/JointTrajectoryPoint desired\n"
        "trajectory_msgs/JointTrajectoryPoint actual\ntrajectory_msgs/JointTrajectoryPoint error\n"
    ),
    "my_arm_msgs/msg/ArmState": "std_msgs/Header header\nfloat64[6] q\nfloat64[6] dq\nfloat64[6] tau\n",
    "my_arm_msgs/msg/ArmCommand": "std_msgs/Header header\nfloat32[6] position\nfloat32[6] stiffness\n",
    "droid_msgs/msg/RobotState": (
        "std_msgs/Header header\nfloat64[6] cartesian_position\nfloat64 gripper_position\nfloat64[7] joint_positions\n"
        "float64[7] joint_velocities\nfloat64[7] joint_torques_computed\n"
    ),
    "droid_msgs/msg/Action": (
        "std_msgs/Header header\nfloat64[6] cartesian_velocity\nfloat64[7] joint_position\nfloat64 gripper_position\n"
    ),
}


@dataclass(frozen=True, kw_only=True)
class Topic:
    """A topic at a steady rate; `body` makes the fields of a message from its time and number."""

    name: str
    type: str
    body: Callable[[int, int], Body]
    rate: int = 50
    has_header: bool = True


@dataclass(frozen=True, kw_only=True)
class Part:
    """What a feature must have of a topic: the names, and the numbers of a message, None for one of others."""

    topic: str
    names: Sequence[str]
    numbers: Callable[[Body], Any]


@dataclass(frozen=True, kw_only=True)
class Layout:
    """A robot's topics, and what must come of them; an empty action is that of the next row.

    Attributes:
        unsure: Field of a commented source in place of the state, where the topics do not say enough.
        clock_ns: Time of recording minus that of the headers.
        write: Of the bag.
    """

    topics: Sequence[Topic]
    state: Sequence[Part] = ()
    action: Sequence[Part] = ()
    cameras: int = 1
    unsure: str = ""
    clock_ns: int = 0
    write: Callable[[Notes, Path], Path] = field(default=lambda notes, path: bags.write_rosbag2(notes, path / "bag"))

    def notes(self) -> Notes:
        """Its messages, in the order of recording. Pictures begin last, so that a row can be at each of them."""
        bags.register(DEFINITIONS)
        made = []
        for topic in self.topics:
            begin = EPOCH_NS + (NS // 20 if "image" in topic.type.lower() else 0)
            for number in range(int(SECONDS * topic.rate)):
                time = begin + number * NS // topic.rate
                made.append(
                    Note(topic=topic.name, type=topic.type, log_ns=time + self.clock_ns, frame_id=topic.name[1:],
                         header_ns=time if topic.has_header else 0, body=topic.body(time, number))
                )  # fmt: skip
        return bags.in_order(made)


def _named(field_name: str = "position") -> Callable[[Body], Any]:
    return lambda body: body[field_name]


def _joints(topic: str, names: Sequence[str], *, shift: float = 0.0, rate: int = 50) -> Topic:
    return Topic(
        name=topic, type="sensor_msgs/msg/JointState", rate=rate,
        body=lambda time, number: {"name": list(names), "position": motion(time, len(names), shift=shift)},
    )  # fmt: skip


def _joint_part(topic: str, names: Sequence[str]) -> Part:
    """Of a topic of JointState, by name, whatever the order, of those messages that name them."""

    def numbers(body: Body) -> Any:
        have = dict(zip(body["name"], body["position"], strict=True))
        return [have[name] for name in names] if names[0] in have else None

    return Part(topic=topic, names=names, numbers=numbers)


def _camera(topic: str, shade: int = 0) -> Topic:
    return Topic(
        name=topic, type="sensor_msgs/msg/CompressedImage", rate=30,
        body=lambda time, number: {
            "format": "jpeg", "data": np.frombuffer(bags.jpeg(bags.picture(time, shade)), np.uint8),
        },
    )  # fmt: skip


def _raw_camera(topic: str, shade: int = 0) -> Topic:
    return Topic(
        name=topic, type="sensor_msgs/msg/Image", rate=30,
        body=lambda time, number: {
            "encoding": "rgb8", "width": bags.WIDTH, "height": bags.HEIGHT, "step": 3 * bags.WIDTH,
            "data": bags.picture(time, shade),
        },
    )  # fmt: skip


def _depth_camera(topic: str) -> Topic:
    def body(time: int, number: int) -> Body:
        distances = np.full((bags.HEIGHT, bags.WIDTH), 500 + number, np.uint16)
        return {"encoding": "16UC1", "width": bags.WIDTH, "height": bags.HEIGHT, "step": 2 * bags.WIDTH,
                "data": np.frombuffer(distances.tobytes(), np.uint8)}  # fmt: skip

    return Topic(name=topic, type="sensor_msgs/msg/Image", rate=30, body=body)


def _numbers(topic: str, count: int, *, shift: float = 0.0) -> Topic:
    return Topic(
        name=topic, type="std_msgs/msg/Float64MultiArray", has_header=False,
        body=lambda time, number: {"data": motion(time, count, shift=shift)},
    )  # fmt: skip


def _number(topic: str, *, shift: float = 0.0, kind: str = "Float64") -> Topic:
    return Topic(
        name=topic, type=f"std_msgs/msg/{kind}", has_header=False,
        body=lambda time, number: {"data": float(motion(time, 1, shift=shift)[0])},
    )  # fmt: skip


def _pose(time: int) -> Body:
    half = 0.2 * np.sin((time - EPOCH_NS) / NS)
    orientation = {"x": 0.0, "y": 0.0, "z": float(np.sin(half)), "w": float(np.cos(half))}
    return {"position": dict(zip("xyz", motion(time, 3).tolist(), strict=True)), "orientation": orientation}


def _pose_stamped(topic: str, *, ahead_ns: int = 0) -> Topic:
    return Topic(
        name=topic, type="geometry_msgs/msg/PoseStamped", body=lambda time, number: {"pose": _pose(time + ahead_ns)}
    )


POSE_NAMES = tuple(f"position.{axis}" for axis in "xyz") + tuple(f"orientation.{axis}" for axis in "xyzw")
TWIST_NAMES = tuple(f"{part}.{axis}" for part in ("linear", "angular") for axis in "xyz")


def _flat(body: Body) -> list[float]:
    return [number for part in body.values() for number in part.values()]


def _twist(time: int) -> Body:
    return {part: dict(zip("xyz", motion(time, 3, shift=k).tolist(), strict=True))
            for k, part in enumerate(("linear", "angular"))}  # fmt: skip


def _cmd_vel(topic: str) -> Topic:
    return Topic(name=topic, type="geometry_msgs/msg/Twist", has_header=False, body=lambda time, number: _twist(time))


def _odometry(topic: str) -> Topic:
    return Topic(
        name=topic, type="nav_msgs/msg/Odometry",
        body=lambda time, number: {"pose": {"pose": _pose(time)}, "twist": {"twist": _twist(time)}},
    )  # fmt: skip


def _transforms(topic: str, frames: Sequence[str]) -> Topic:
    def body(time: int, number: int) -> Body:
        header = Note(topic="", type="", log_ns=0, header_ns=time, frame_id="base_link")
        return {"transforms": [
            {"header": header, "child_frame_id": frame, "transform": {
                "translation": dict(zip("xyz", motion(time, 3, shift=k).tolist(), strict=True)),
                "rotation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}}}
            for k, frame in enumerate(frames)
        ]}  # fmt: skip

    return Topic(name=topic, type="tf2_msgs/msg/TFMessage", body=body, has_header=False)


def _trajectory(topic: str, names: Sequence[str]) -> Topic:
    return Topic(
        name=topic, type="trajectory_msgs/msg/JointTrajectory",
        body=lambda time, number: {
            "joint_names": list(names), "points": [{"positions": motion(time, len(names), shift=0.1)}],
        },
    )  # fmt: skip


def _trajectory_part(topic: str, names: Sequence[str]) -> Part:
    return Part(topic=topic, names=names, numbers=lambda body: body["points"][0]["positions"])


def _state_of(names: Sequence[str], time: int, shift: float = 0.0) -> Body:
    return {"name": list(names), "position": motion(time, len(names), shift=shift)}


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
    arm = _joints("/joint_states", UR, rate=100)

    def turned(time: int, number: int) -> Body:
        body = arm.body(time, number)
        return body if number < 70 else {"name": body["name"][::-1], "position": body["position"][::-1].copy()}

    gripper = _joints("/joint_states", ("robotiq_85_left_knuckle_joint",), shift=2.0, rate=40)
    return Topic(name=arm.name, type=arm.type, rate=100, body=turned), gripper


def _motors(time: int, shift: float = 0.0) -> list[Body]:
    return [{"q": float(np.float32(number)), "dq": 1.0} for number in motion(time, 20, shift=shift)]


def _dynamixels(time: int) -> Body:
    ticks = np.round(motion(time, 5) * 651.9).astype(int)
    return {"dynamixel_state": [
        {"name": f"joint{k}", "id": k, "present_position": int(tick), "goal_position": int(tick) + 3, "present_current": 9}
        for k, tick in enumerate(ticks)
    ]}  # fmt: skip


def _mcap(notes: Notes, path: Path) -> Path:
    return bags.write_mcap(notes, path / "bag.mcap")


def _ros1(notes: Notes, path: Path) -> Path:
    return bags.write_mcap(notes, path / "bag.mcap", is_ros1=True)


def _sqlite(notes: Notes, path: Path) -> Path:
    return bags.write_rosbag2(notes, path / "bag", storage=StoragePlugin.SQLITE3)


LAYOUTS: dict[str, Layout] = {
    "UR": Layout(
        topics=(
            _joints("/joint_states", UR, rate=500), _pose_stamped("/tcp_pose_broadcaster/pose"),
            _numbers("/forward_position_controller/commands", 6), _raw_camera("/camera/camera/color/image_raw"),
            Topic(name="/force_torque_sensor_broadcaster/wrench", type="geometry_msgs/msg/WrenchStamped",
                  body=lambda time, number: {}),
        ),
        state=(_joint_part("/joint_states", UR),),
        action=(Part(topic="/forward_position_controller/commands", names=[f"data_{k}" for k in range(6)],
                     numbers=_named("data")),),
    ),
    "Franka": Layout(
        topics=(
            Topic(name="/franka_robot_state_broadcaster/robot_state", type="franka_msgs/msg/FrankaRobotState", rate=200,
                  body=lambda time, number: {
                      "measured_joint_state": _state_of(FR3, time), "desired_joint_state": _state_of(FR3, time, 0.1),
                      "measured_joint_motor_state": _state_of(FR3, time, 0.2), "o_t_ee": {"pose": _pose(time)}}),
            _joints("/franka_gripper/joint_states", FINGERS, rate=40, shift=3.0),
            _raw_camera("/camera/camera/color/image_raw"),
        ),
        state=(
            Part(topic="/franka_robot_state_broadcaster/robot_state", names=FR3,
                 numbers=lambda body: body["measured_joint_state"]["position"]),
            _joint_part("/franka_gripper/joint_states", FINGERS),
        ),
    ),
    "Franka, ROS 1": Layout(
        topics=(
            Topic(name="/franka_state_controller/franka_states", type="franka_msgs/msg/FrankaState", rate=200,
                  body=lambda time, number: {"q": motion(time, 7), "q_d": motion(time, 7, shift=0.1), "dq": np.ones(7)}),
            _joints("/franka_gripper/joint_states", FINGERS, rate=40), _camera("/camera/color/image_raw/compressed"),
        ),
        state=(
            Part(topic="/franka_state_controller/franka_states", names=[f"q_{k}" for k in range(7)],
                 numbers=_named("q")),
            _joint_part("/franka_gripper/joint_states", FINGERS),
        ),
        write=_ros1,
    ),
    "ROBOTIS": Layout(
        topics=(_joints("/joint_states", OMX, rate=100), _trajectory("/leader/joint_trajectory", OMX),
                _camera("/camera/cam_top/image_raw/compressed")),
        state=(_joint_part("/joint_states", OMX),),
        action=(_trajectory_part("/leader/joint_trajectory", OMX),),
    ),
    "tf alone": Layout(
        topics=(_transforms("/tf", ("link1", "link2", "tool0")), _raw_camera("/camera/image_raw")),
        unsure="transforms[child_frame_id=tool0].transform",
    ),
    "poses and a gripper": Layout(
        topics=(_pose_stamped("/ee_pose"), _number("/gripper/width"), _pose_stamped("/target_pose", ahead_ns=NS // 10),
                _number("/gripper/command", shift=0.1, kind="Float32"), _camera("/cam_0/image/compressed")),
        state=(
            Part(topic="/ee_pose", names=POSE_NAMES, numbers=lambda body: _flat(body["pose"])),
            Part(topic="/gripper/width", names=("gripper_width",), numbers=lambda body: [body["data"]]),
        ),
        action=(
            Part(topic="/target_pose", names=POSE_NAMES, numbers=lambda body: _flat(body["pose"])),
            Part(topic="/gripper/command", names=("gripper_command",), numbers=lambda body: [np.float32(body["data"])]),
        ),
        write=_mcap,
    ),
    "Spot": Layout(
        topics=(_joints("/spot/joint_states", LEGS), _odometry("/spot/odometry"), _cmd_vel("/spot/cmd_vel"),
                _transforms("/tf", ("body", "odom")), _camera("/spot/camera/frontleft/compressed"),
                _camera("/spot/camera/hand/compressed", 1)),
        state=(_joint_part("/spot/joint_states", LEGS),),
        action=(Part(topic="/spot/cmd_vel", names=TWIST_NAMES, numbers=_flat),),
        cameras=2,
    ),
    "Isaac": Layout(
        topics=(_joints("/joint_states", FR3, rate=60), _joints("/joint_command", FR3, shift=0.1, rate=60),
                _raw_camera("/rgb")),
        state=(_joint_part("/joint_states", FR3),),
        action=(_joint_part("/joint_command", FR3),),
        clock_ns=70_000_000,
        write=_sqlite,
    ),
    "RealSense": Layout(
        topics=(_joints("/joint_states", SIX), _raw_camera("/camera/camera/color/image_raw"),
                _depth_camera("/camera/camera/aligned_depth_to_color/image_raw"),
                Topic(name="/camera/camera/imu", type="sensor_msgs/msg/Imu", rate=200, body=lambda time, number: {})),
        state=(_joint_part("/joint_states", SIX),),
        cameras=2,
    ),
    "ROS 1": Layout(
        topics=(_joints("/joint_states", SIX), _joints("/joint_states_desired", SIX, shift=0.1),
                _camera("/usb_cam/image_raw/compressed")),
        state=(_joint_part("/joint_states", SIX),),
        action=(_joint_part("/joint_states_desired", SIX),),
        write=_ros1,
    ),
    "two publishers": Layout(
        topics=(*_two_publishers(), _joints("/lead_arm/joint_states", UR, shift=0.1),
                _camera("/camera/image_raw/compressed")),
        state=(_joint_part("/joint_states", UR), _joint_part("/joint_states", ("robotiq_85_left_knuckle_joint",))),
        action=(_joint_part("/lead_arm/joint_states", UR),),
    ),
    "leader and follower": Layout(
        topics=(_joints("/follower/joint_states", OMX), _joints("/leader/joint_states", OMX, shift=0.1),
                _joints("/follower/joint_command", OMX, shift=0.1), _camera("/cam_wrist/image_raw/compressed")),
        state=(_joint_part("/follower/joint_states", OMX),),
        action=(_joint_part("/leader/joint_states", OMX),),
        write=_sqlite,
    ),
    "Unitree": Layout(
        topics=(
            Topic(name="/lowstate", type="unitree_go/msg/LowState", rate=200, has_header=False,
                  body=lambda time, number: {"motor_state": _motors(time)}),
            Topic(name="/lowcmd", type="unitree_go/msg/LowCmd", rate=200, has_header=False,
                  body=lambda time, number: {"motor_cmd": _motors(time, 0.1)}),
            Topic(name="/sportmodestate", type="unitree_go/msg/SportModeState", has_header=False,
                  body=lambda time, number: {"position": motion(time, 3)}),
            _camera("/frontvideo/image/compressed"),
        ),
        state=(Part(topic="/lowstate", names=[f"q_{k}" for k in range(20)],
                    numbers=lambda body: [motor["q"] for motor in body["motor_state"]]),),
        action=(Part(topic="/lowcmd", names=[f"q_{k}" for k in range(20)],
                     numbers=lambda body: [motor["q"] for motor in body["motor_cmd"]]),),
    ),
    "Interbotix": Layout(
        topics=(
            _joints("/vx300s/joint_states", VX300S),
            Topic(name="/vx300s/commands/joint_group", type="interbotix_xs_msgs/msg/JointGroupCommand", has_header=False,
                  body=lambda time, number: {"name": "arm", "cmd": motion(time, 6, shift=0.1).astype(np.float32)}),
            Topic(name="/vx300s/commands/joint_single", type="interbotix_xs_msgs/msg/JointSingleCommand",
                  has_header=False, body=lambda time, number: {"name": "gripper", "cmd": 0.25 + number / 128}),
            _camera("/cam_high/image_raw/compressed"), _camera("/cam_left_wrist/image_raw/compressed", 1),
        ),
        state=(_joint_part("/vx300s/joint_states", VX300S),),
        action=(
            Part(topic="/vx300s/commands/joint_group", names=[f"cmd_{k}" for k in range(6)], numbers=_named("cmd")),
            Part(topic="/vx300s/commands/joint_single", names=("cmd",), numbers=lambda body: [body["cmd"]]),
        ),
        cameras=2,
    ),
    "Dynamixel": Layout(
        topics=(
            Topic(name="/dynamixel_workbench/dynamixel_state", has_header=False, rate=100,
                  type="dynamixel_workbench_msgs/msg/DynamixelStateList", body=lambda time, number: _dynamixels(time)),
            _camera("/usb_cam/image_raw/compressed"),
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
            _raw_camera("/overhead/image_raw"),
        ),
        state=(Part(topic="/arm/telemetry", names=[f"q_{k}" for k in range(6)], numbers=_named("q")),),
        action=(Part(topic="/arm/sent", names=[f"position_{k}" for k in range(6)],
                     numbers=lambda body: np.float32(body["position"])),),
        write=_mcap,
    ),
    "two arms in namespaces": Layout(
        topics=(
            *(_joints(f"/{side}/joint_states", SIX, shift=k) for k, side in enumerate(("left", "right"))),
            *(_joints(f"/{side}_gello/joint_states", SIX, shift=k + 0.1) for k, side in enumerate(("left", "right"))),
            _camera("/left/wrist_cam/image_raw/compressed"), _camera("/right/wrist_cam/image_raw/compressed", 1),
        ),
        state=tuple(
            Part(topic=f"/{side}/joint_states", names=[f"{side}_{name}" for name in SIX], numbers=_named())
            for side in ("left", "right")
        ),
        action=tuple(
            Part(topic=f"/{side}_gello/joint_states", names=[f"{side}_{name}" for name in SIX], numbers=_named())
            for side in ("left", "right")
        ),
        cameras=2,
    ),
    "mobile base": Layout(
        topics=(_odometry("/odom"), _cmd_vel("/cmd_vel"), _camera("/camera/image_raw/compressed")),
        state=(Part(topic="/odom", names=(*POSE_NAMES, *TWIST_NAMES),
                    numbers=lambda body: [*_flat(body["pose"]["pose"]), *_flat(body["twist"]["twist"])]),),
        action=(Part(topic="/cmd_vel", names=TWIST_NAMES, numbers=_flat),),
    ),
    "trajectories": Layout(
        topics=(
            _joints("/joint_states", SIX, rate=100), _trajectory("/joint_trajectory_controller/joint_trajectory", SIX),
            Topic(name="/joint_trajectory_controller/controller_state",
                  type="control_msgs/msg/JointTrajectoryControllerState",
                  body=lambda time, number: {"joint_names": list(SIX), **{
                      name: {"positions": motion(time, 6)} for name in ("desired", "actual", "error")}}),
            _camera("/camera/image_raw/compressed"),
        ),
        state=(_joint_part("/joint_states", SIX),),
        action=(_trajectory_part("/joint_trajectory_controller/joint_trajectory", SIX),),
    ),
    "DROID": Layout(
        topics=(
            Topic(name="/droid/robot_state", type="droid_msgs/msg/RobotState", rate=60, body=lambda time, number: {
                "cartesian_position": motion(time, 6, shift=4.0), "gripper_position": 0.5 + number / 256,
                "joint_positions": motion(time, 7), "joint_velocities": np.ones(7)}),
            Topic(name="/droid/action", type="droid_msgs/msg/Action", rate=60, body=lambda time, number: {
                "cartesian_velocity": np.ones(6), "joint_position": motion(time, 7, shift=0.1),
                "gripper_position": 0.75}),
            _camera("/droid/varied_camera_1/image/compressed"), _camera("/droid/wrist_camera/image/compressed", 1),
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
}  # fmt: skip
"""Name -> layout."""
