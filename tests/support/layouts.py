"""Topics of third-party robots, a row each, with the expected result of a suggested mapping.

Types, topics, names and rates are those of public drivers: ur_robot_driver, ROBOTIS's open_manipulator, Isaac Sim's
ROS 2 bridge, realsense2_camera, ros2_controllers, Foxglove's SDK. All are written by `rosbags`, `mcap` or `foxglove`.
"""

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
    """Expected elements of a feature from one topic: names, and the numbers of a message (None if unrelated)."""

    topic: str
    names: Sequence[str]
    numbers: Callable[[Body], Any]


@dataclass(frozen=True, kw_only=True)
class Layout:
    """A robot's topics, and the expected features; an empty action is that of the next row.

    Attributes:
        clock_ns: Time of recording minus that of the headers.
        write: Function that writes the bag.
    """

    topics: Sequence[Topic]
    state: Sequence[Part] = ()
    action: Sequence[Part] = ()
    cameras: int = 1
    clock_ns: int = 0
    write: Callable[[Notes, Path], Path] = field(default=lambda notes, path: bags.write_rosbag2(notes, path / "bag"))

    def notes(self) -> Notes:
        """Messages in the order of recording. Images begin last, so that each of them can have a row."""
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
    """Expect elements of a JointState topic by name, in any order, from those messages that contain them."""

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


def flat(body: Body) -> list[float]:
    return [number for part in body.values() for number in part.values()]


def trajectory(topic: str, names: Sequence[str]) -> Topic:
    return Topic(
        name=topic, type="trajectory_msgs/msg/JointTrajectory",
        body=lambda time, number: {
            "joint_names": list(names), "points": [{"positions": motion(time, len(names), shift=0.1)}],
        },
    )  # fmt: skip


def trajectory_part(topic: str, names: Sequence[str]) -> Part:
    return Part(topic=topic, names=names, numbers=lambda body: body["points"][0]["positions"])


UR = tuple(f"{name}_joint" for name in ("shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3", "shoulder_pan"))
OMX = ("joint1", "joint2", "joint3", "joint4", "joint5", "gripper_joint_1")
SIX = tuple(f"joint_{k}" for k in range(1, 7))


def _two_publishers() -> Sequence[Topic]:
    """An arm whose driver changes the order of its joints, and a gripper on the same topic at another rate."""
    arm = joints("/joint_states", UR, rate=100)

    def turned(time: int, number: int) -> Body:
        body = arm.body(time, number)
        return body if number < 70 else {"name": body["name"][::-1], "position": body["position"][::-1].copy()}

    gripper = joints("/joint_states", ("robotiq_85_left_knuckle_joint",), shift=2.0, rate=40)
    return Topic(name=arm.name, type=arm.type, rate=100, body=turned), gripper


def _mcap(notes: Notes, path: Path) -> Path:
    return bags.write_mcap(notes, path / "bag.mcap")


def _foxglove(notes: Notes, path: Path) -> Path:
    """An MCAP file of Foxglove's own protobuf messages, written by its SDK."""
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
    "ROBOTIS": Layout(
        topics=(joints("/joint_states", OMX, rate=100), trajectory("/leader/joint_trajectory", OMX),
                camera("/camera/cam_top/image_raw/compressed")),
        state=(joint_part("/joint_states", OMX),),
        action=(trajectory_part("/leader/joint_trajectory", OMX),),
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
    "RealSense": Layout(
        topics=(joints("/joint_states", SIX), raw_camera("/camera/camera/color/image_raw"),
                depth_camera("/camera/camera/aligned_depth_to_color/image_raw"),
                Topic(name="/camera/camera/imu", type="sensor_msgs/msg/Imu", rate=200, body=lambda time, number: {})),
        state=(joint_part("/joint_states", SIX),),
        cameras=2,
    ),
    "Foxglove's own messages": Layout(
        topics=(*_two_publishers(), joints("/teleop/joint_states", UR, shift=0.1), camera("/camera/front")),
        state=(joint_part("/joint_states", UR), joint_part("/joint_states", ("robotiq_85_left_knuckle_joint",))),
        action=(joint_part("/teleop/joint_states", UR),),
        write=_foxglove,
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
}  # fmt: skip
"""Name -> layout."""
