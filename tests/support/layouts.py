"""Messages of third-party robots, with the expected result of a suggested mapping.

Types, topics, names and rates are those of public drivers: ur_robot_driver, ROBOTIS's open_manipulator,
realsense2_camera, ros2_controllers, Foxglove's SDK. All are written by `rosbags`, `mcap` or `foxglove`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from support import bags
from support.bags import EPOCH_NS, NS, Notes, motion

SECONDS = 1.5
Body = dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class Part:
    """Expected elements of a feature from one topic: names, and the numbers of a message (None if unrelated)."""

    topic: str
    names: Sequence[str]
    numbers: Callable[[Body], Any]


@dataclass(frozen=True, kw_only=True)
class Layout:
    """A robot's messages, and the expected features; an empty action is that of the next row."""

    topics: Sequence[Notes]
    state: Sequence[Part] = ()
    action: Sequence[Part] = ()
    cameras: int = 1
    write: Callable[[Notes, Path], Path] = field(default=lambda notes, path: bags.write_rosbag2(notes, path / "bag"))

    def notes(self) -> Notes:
        return bags.in_order([note for notes in self.topics for note in notes])


def moments(rate: int, *, begin_ns: int = EPOCH_NS) -> list[int]:
    return [begin_ns + number * NS // rate for number in range(int(SECONDS * rate))]


IMAGES = moments(30, begin_ns=EPOCH_NS + NS // 20)
"""Times of images: they begin last, so that each of them can have a row."""


def messages(topic: str, kind: str, body: Callable[[int], Body], *, has_header: bool = True) -> Notes:
    return bags.messages(topic, kind, moments(50), body, has_header=has_header)


def joints(topic: str, names: Sequence[str], *, shift: float = 0.0, rate: int = 50) -> Notes:
    return bags.joints(topic, names, moments(rate), shift=shift)


def joint_part(topic: str, names: Sequence[str]) -> Part:
    """Expect elements of a JointState topic by name, in any order, from those messages that contain them."""

    def numbers(body: Body) -> Any:
        have = dict(zip(body["name"], body["position"], strict=True))
        return [have[name] for name in names] if names[0] in have else None

    return Part(topic=topic, names=names, numbers=numbers)


def camera(topic: str, shade: int = 0) -> Notes:
    return bags.jpeg_images(topic, IMAGES, shade, topic[1:])


def depth_camera(topic: str) -> Notes:
    distances = np.full((bags.HEIGHT, bags.WIDTH), 500, np.uint16)
    body = {"encoding": "16UC1", "width": bags.WIDTH, "height": bags.HEIGHT, "step": 2 * bags.WIDTH,
            "data": np.frombuffer(distances.tobytes(), np.uint8)}  # fmt: skip
    return bags.messages(topic, "sensor_msgs/msg/Image", IMAGES, lambda time: body)


def scalar(topic: str, *, shift: float = 0.0, kind: str = "Float64") -> Notes:
    return messages(
        topic, f"std_msgs/msg/{kind}", lambda time: {"data": float(motion(time, 1, shift=shift)[0])}, has_header=False
    )


def pose_stamped(topic: str, *, ahead_ns: int = 0) -> Notes:
    return messages(topic, "geometry_msgs/msg/PoseStamped", lambda time: {"pose": bags.pose(time + ahead_ns)})


POSE_NAMES = tuple(f"position.{axis}" for axis in "xyz") + tuple(f"orientation.{axis}" for axis in "xyzw")


def pose_part(topic: str) -> Part:
    return Part(
        topic=topic, names=POSE_NAMES,
        numbers=lambda body: [number for part in body["pose"].values() for number in part.values()],
    )  # fmt: skip


UR = tuple(f"{name}_joint" for name in ("shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3", "shoulder_pan"))
OMX = ("joint1", "joint2", "joint3", "joint4", "joint5", "gripper_joint_1")
SIX = tuple(f"joint_{k}" for k in range(1, 7))


def _two_publishers() -> Sequence[Notes]:
    """An arm whose driver changes the order of its joints, and a gripper on the same topic at another rate."""
    arm = joints("/joint_states", UR, rate=100)
    for note in arm[70:]:
        note.body.update(name=note.body["name"][::-1], position=note.body["position"][::-1].copy())
    return arm, joints("/joint_states", ("robotiq_85_left_knuckle_joint",), shift=2.0, rate=40)


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
            messages("/forward_position_controller/commands", "std_msgs/msg/Float64MultiArray",
                     lambda time: {"data": motion(time, 6)}, has_header=False),
            bags.raw_images("/camera/camera/color/image_raw", IMAGES, 0, "camera"),
            messages("/force_torque_sensor_broadcaster/wrench", "geometry_msgs/msg/WrenchStamped", lambda time: {}),
        ),
        state=(joint_part("/joint_states", UR),),
        action=(Part(topic="/forward_position_controller/commands", names=[f"data_{k}" for k in range(6)],
                     numbers=lambda body: body["data"]),),
    ),
    "ROBOTIS": Layout(
        topics=(
            joints("/joint_states", OMX, rate=100), camera("/camera/cam_top/image_raw/compressed"),
            messages("/leader/joint_trajectory", "trajectory_msgs/msg/JointTrajectory",
                     lambda time: {"joint_names": [*OMX], "points": [{"positions": motion(time, 6, shift=0.1)}]}),
        ),
        state=(joint_part("/joint_states", OMX),),
        action=(Part(topic="/leader/joint_trajectory", names=OMX,
                     numbers=lambda body: body["points"][0]["positions"]),),
    ),
    "poses and a gripper": Layout(
        topics=(pose_stamped("/ee_pose"), scalar("/gripper/width"), pose_stamped("/target_pose", ahead_ns=NS // 10),
                scalar("/gripper/command", shift=0.1, kind="Float32"), camera("/cam_0/image/compressed")),
        state=(
            pose_part("/ee_pose"),
            Part(topic="/gripper/width", names=("gripper_width",), numbers=lambda body: [body["data"]]),
        ),
        action=(
            pose_part("/target_pose"),
            Part(topic="/gripper/command", names=("gripper_command",), numbers=lambda body: [np.float32(body["data"])]),
        ),
        write=_mcap,
    ),
    "RealSense": Layout(
        topics=(joints("/joint_states", SIX), bags.raw_images("/camera/camera/color/image_raw", IMAGES, 0, "camera"),
                depth_camera("/camera/camera/aligned_depth_to_color/image_raw")),
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
            Part(topic=f"/{side}/joint_states", names=[f"{side}_{name}" for name in SIX],
                 numbers=lambda body: body["position"])
            for side in ("left", "right")
        ),
        action=tuple(
            Part(topic=f"/{side}_gello/joint_states", names=[f"{side}_{name}" for name in SIX],
                 numbers=lambda body: body["position"])
            for side in ("left", "right")
        ),
        cameras=2,
    ),
}  # fmt: skip
"""Name -> layout."""
