"""The topics of a recording, and the latched messages: those that hold for the whole episode.

The streams that have one message a frame are the rows of `demorec.mcap.streams`.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from demorec.episode.info import EpisodeInfo
from demorec.mcap import messages
from demorec.mcap.cdr import encode
from demorec.mcap.description import body_description, robot_description
from demorec.mcap.lossless import segment_names, to_labels
from demorec.mcap.transforms import FrameTree, camera_frame

JOINT_STATES = "/joint_states"
GRIPPER = "/gripper"
ACTION = "/action"
COMMAND = "/command"
EE_POSE = "/ee_pose"
PHASE = "/phase"
EVENTS = "/events"
DELIBERATE_MISS = "/deliberate_miss"
LABELS = "/labels"
TF = "/tf"
TF_STATIC = "/tf_static"

Message = tuple[str, str, bytes]
"""Topic, type, bytes."""

_BACKDROP_METRES = 3.0
"""Larger bodies (floors, walls) are not described: a viewer would stand so far off that the robot is a dot."""


def object_topic(name: str) -> str:
    """Pose of a movable body."""
    return f"/object/{name}/pose"


def description_topic(body: str = "") -> str:
    """URDF of a body, or of the robot."""
    return f"/object/{body}/robot_description" if body else "/robot_description"


def camera_topic(camera: str, stream: str) -> str:
    """A stream of a camera: pose, camera_info, h264, video, image/compressed, depth, segmentation, histogram."""
    return f"/camera/{camera}/{stream}"


def latched_messages(info: EpisodeInfo, tree: FrameTree | None, *, has_labels: bool) -> Iterator[Message]:
    """What is said once, before the first frame.

    Args:
        info: Of the episode.
        tree: Of the robot; None where it is not described.
        has_labels: Whether there are segmentation images.
    """
    if tree is not None:
        yield TF_STATIC, messages.TRANSFORMS, messages.transforms(tree.static)
        urdf = info.urdf or robot_description(info.simulated.robot.urdf, info.simulated.scene.robot.scale)
        yield description_topic(), messages.STRING, encode(messages.STRING, urdf)
    for body in () if info.simulation is None else info.simulated.scene.bodies:
        if max(body.shape.extents) <= _BACKDROP_METRES:
            yield description_topic(body.name), messages.STRING, encode(messages.STRING, body_description(body))
    for camera in info.cameras:
        if camera.intrinsics is not None:
            size, intrinsics = (camera.height, camera.width), np.array(camera.intrinsics).reshape(3, 3)
            distortion = camera.distortion or (0.0,) * 5
            data = messages.camera_info(camera_frame(camera.name), size, intrinsics, distortion)
            yield camera_topic(camera.name, "camera_info"), messages.CAMERA_INFO, data
    if has_labels:
        values, names = zip(*segment_names(info), strict=True)
        numbers = to_labels(np.array([values], dtype=np.int32))[0].tolist()
        yield LABELS, messages.LABEL_INFO, messages.label_info(list(zip(numbers, names, strict=True)))


PHASE_EVENT = "phase"
"""Name of the events that the writer adds at each change of phase, so that a log shows them too."""

_VIDEO_STREAMS = {
    "h264": "h264",
    "h265": "h265",
    "av1": "video",
    "jpeg": "image/compressed",
    "16UC1": "depth",
    "32FC1": "depth",
}


def video_topic(camera: str, codec: str) -> str:
    """Where the encoded images of a camera, in colour or of distances, are read from."""
    return camera_topic(camera, _VIDEO_STREAMS[codec])
