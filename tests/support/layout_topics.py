"""Topics of public drivers, and what a feature must have of each: the bricks of `support.layouts`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

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
    "unitree_go/msg/MotorCmd": "uint8 mode\nfloat32 q\nfloat32 dq\nfloat32 tau\nfloat32 kp\nfloat32 kd\n",
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
    "my_arm_msgs/msg/Arms": (
        "float64[6] leader_positions\nfloat64[6] follower_positions\nfloat64 leader_gripper\nfloat64 follower_gripper\n"
    ),
    "my_arm_msgs/msg/Teleoperation": "std_msgs/Header header\nmy_arm_msgs/Arms left\nmy_arm_msgs/Arms right\n",
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
        """Its messages, in the order of recording. Images begin last, so that a row can be at each of them."""
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


def field_of(field_name: str = "position") -> Callable[[Body], Any]:
    return lambda body: body[field_name]


def joints(topic: str, names: Sequence[str], *, shift: float = 0.0, rate: int = 50) -> Topic:
    return Topic(
        name=topic, type="sensor_msgs/msg/JointState", rate=rate,
        body=lambda time, number: {"name": list(names), "position": motion(time, len(names), shift=shift)},
    )  # fmt: skip


def joint_part(topic: str, names: Sequence[str]) -> Part:
    """Of a topic of JointState, by name, whatever the order, of those messages that name them."""

    def numbers(body: Body) -> Any:
        have = dict(zip(body["name"], body["position"], strict=True))
        return [have[name] for name in names] if names[0] in have else None

    return Part(topic=topic, names=names, numbers=numbers)


def camera(topic: str, shade: int = 0) -> Topic:
    return Topic(
        name=topic, type="sensor_msgs/msg/CompressedImage", rate=30,
        body=lambda time, number: {
            "format": "jpeg", "data": np.frombuffer(bags.jpeg(bags.image(time, shade)), np.uint8),
        },
    )  # fmt: skip


def raw_camera(topic: str, shade: int = 0) -> Topic:
    return Topic(
        name=topic, type="sensor_msgs/msg/Image", rate=30,
        body=lambda time, number: {
            "encoding": "rgb8", "width": bags.WIDTH, "height": bags.HEIGHT, "step": 3 * bags.WIDTH,
            "data": bags.image(time, shade),
        },
    )  # fmt: skip


def depth_camera(topic: str) -> Topic:
    def body(time: int, number: int) -> Body:
        distances = np.full((bags.HEIGHT, bags.WIDTH), 500 + number, np.uint16)
        return {"encoding": "16UC1", "width": bags.WIDTH, "height": bags.HEIGHT, "step": 2 * bags.WIDTH,
                "data": np.frombuffer(distances.tobytes(), np.uint8)}  # fmt: skip

    return Topic(name=topic, type="sensor_msgs/msg/Image", rate=30, body=body)


def multi_array(topic: str, count: int, *, shift: float = 0.0) -> Topic:
    return Topic(
        name=topic, type="std_msgs/msg/Float64MultiArray", has_header=False,
        body=lambda time, number: {"data": motion(time, count, shift=shift)},
    )  # fmt: skip


def scalar(topic: str, *, shift: float = 0.0, kind: str = "Float64") -> Topic:
    return Topic(
        name=topic, type=f"std_msgs/msg/{kind}", has_header=False,
        body=lambda time, number: {"data": float(motion(time, 1, shift=shift)[0])},
    )  # fmt: skip


def pose_at(time: int) -> Body:
    half = 0.2 * np.sin((time - EPOCH_NS) / NS)
    orientation = {"x": 0.0, "y": 0.0, "z": float(np.sin(half)), "w": float(np.cos(half))}
    return {"position": dict(zip("xyz", motion(time, 3).tolist(), strict=True)), "orientation": orientation}


def pose_stamped(topic: str, *, ahead_ns: int = 0) -> Topic:
    return Topic(
        name=topic, type="geometry_msgs/msg/PoseStamped", body=lambda time, number: {"pose": pose_at(time + ahead_ns)}
    )


POSE_NAMES = tuple(f"position.{axis}" for axis in "xyz") + tuple(f"orientation.{axis}" for axis in "xyzw")
TWIST_NAMES = tuple(f"{part}.{axis}" for part in ("linear", "angular") for axis in "xyz")


def flat(body: Body) -> list[float]:
    return [number for part in body.values() for number in part.values()]


def twist_at(time: int) -> Body:
    return {part: dict(zip("xyz", motion(time, 3, shift=k).tolist(), strict=True))
            for k, part in enumerate(("linear", "angular"))}  # fmt: skip


def cmd_vel(topic: str) -> Topic:
    return Topic(name=topic, type="geometry_msgs/msg/Twist", has_header=False, body=lambda time, number: twist_at(time))


def odometry(topic: str) -> Topic:
    return Topic(
        name=topic, type="nav_msgs/msg/Odometry",
        body=lambda time, number: {"pose": {"pose": pose_at(time)}, "twist": {"twist": twist_at(time)}},
    )  # fmt: skip


def tf(topic: str, frames: Sequence[str]) -> Topic:
    def body(time: int, number: int) -> Body:
        header = Note(topic="", type="", log_ns=0, header_ns=time, frame_id="base_link")
        return {"transforms": [
            {"header": header, "child_frame_id": frame, "transform": {
                "translation": dict(zip("xyz", motion(time, 3, shift=k).tolist(), strict=True)),
                "rotation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}}}
            for k, frame in enumerate(frames)
        ]}  # fmt: skip

    return Topic(name=topic, type="tf2_msgs/msg/TFMessage", body=body, has_header=False)


def trajectory(topic: str, names: Sequence[str]) -> Topic:
    return Topic(
        name=topic, type="trajectory_msgs/msg/JointTrajectory",
        body=lambda time, number: {
            "joint_names": list(names), "points": [{"positions": motion(time, len(names), shift=0.1)}],
        },
    )  # fmt: skip


def trajectory_part(topic: str, names: Sequence[str]) -> Part:
    return Part(topic=topic, names=names, numbers=lambda body: body["points"][0]["positions"])


def state_at(names: Sequence[str], time: int, shift: float = 0.0) -> Body:
    return {"name": list(names), "position": motion(time, len(names), shift=shift)}
