"""Mappings of the layouts in `support.bags`, as a user writes them."""

from __future__ import annotations

from pathlib import Path

HEAD = """
[robot]
name = "{robot}"
[task]
text = "stack the cups"
[clock]
fps = 30
"""

FRANKA = (
    HEAD.format(robot="franka")
    + """
[[features."observation.state"]]
topic = "/joint_states"
field = "position"
joints = ["fr3_joint1", "fr3_joint2", "fr3_joint3", "fr3_joint4", "fr3_joint5", "fr3_joint6", "fr3_joint7"]
unit = "rad"
[[features."observation.state"]]
topic = "/joint_states"
field = "position"
joints = ["fr3_finger_joint1"]
[[features.action]]
topic = "/gello/joint_states"
field = "position"
joints = ["fr3_joint1", "fr3_joint2", "fr3_joint3", "fr3_joint4", "fr3_joint5", "fr3_joint6", "fr3_joint7"]
unit = "rad"
[cameras.wrist]
topic = "/camera/wrist_camera/color/image_raw"
info_topic = "/camera/wrist_camera/color/camera_info"
[cameras.scene]
topic = "/camera/scene_camera/color/image_raw"
info_topic = "/camera/scene_camera/color/camera_info"
"""
)

SO101 = (
    HEAD.format(robot="so101")
    + """
[[features."observation.state"]]
topic = "/follower/joint_states"
field = "position"
[[features.action]]
topic = "/leader/joint_states"
field = "position"
[cameras.front]
topic = "/follower/cam_front/image_raw/compressed"
[cameras.side]
topic = "/static_camera/cam_side/image_raw/compressed"
"""
)

TROSSEN = (
    HEAD.format(robot="wxai")
    + """
[[features."observation.state"]]
topic = "follower/joints/state"
field = "positions"
[[features.action]]
topic = "leader/joints/state"
field = "positions"
[cameras.high]
topic = "/cameras/cam_high/image"
[cameras.wrist]
topic = "/cameras/cam_wrist/image"
"""
)


def write_mapping(text: str, path: Path) -> Path:
    path.write_text(text)
    return path
