"""Names of the topics of a recording."""

from __future__ import annotations

JOINT_STATES = "/joint_states"
GRIPPER = "/gripper"
ACTION = "/action"
COMMAND = "/command"
EE_POSE = "/ee_pose"
PHASE = "/phase"
EVENTS = "/events"
DELIBERATE_MISS = "/deliberate_miss"
FRAMES = "/frames"
SUBTASK = "/language/subtask"
"""Task of the robot from a frame on, if its source provides it: std_msgs/String."""
LABELS = "/labels"
TF = "/tf"
TF_STATIC = "/tf_static"

Message = tuple[str, str, bytes]
"""Topic, type, bytes."""

PHASE_EVENT = "phase"
"""Name of the events that the writer adds at each phase change, so that a log shows them."""


def feature_topic(name: str) -> str:
    """Topic of a feature of an episode that demorec did not simulate."""
    return "/" + name.replace(".", "/")


def object_topic(name: str) -> str:
    """Topic of a movable body's pose."""
    return f"/object/{name}/pose"


def description_topic(body: str = "") -> str:
    """Topic of a URDF, of a body or of the robot."""
    return f"/object/{body}/robot_description" if body else "/robot_description"


def camera_topic(camera: str, stream: str) -> str:
    """Topic of a camera's stream: pose, camera_info, h264, video, image/compressed, depth, segmentation, histogram."""
    return f"/camera/{camera}/{stream}"


_VIDEO_STREAMS = {
    "h264": "h264",
    "h265": "h265",
    "av1": "video",
    "jpeg": "image/compressed",
    "16UC1": "depth",
    "32FC1": "depth",
}


def video_topic(camera: str, codec: str) -> str:
    """Topic to read the encoded images of a camera from, colour or distances."""
    return camera_topic(camera, _VIDEO_STREAMS[codec])
