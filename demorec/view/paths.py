"""Structure of the Rerun recording: entity paths, the two timelines, poses along them.

The timelines are seconds since the episode's start, and frame numbers.
"""

from __future__ import annotations

import re
from typing import Literal

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from demorec.core.geometry import Array


class Paths:
    """Entity paths of an episode.

    Attributes:
        world: The scene, z up.
        robot: The robot's base; its links are nested below.
        ee_path: One piece of the gripper's path per frame.
        phase: Phases of the motion as states.
        events: Log of events.
        words: Current statements on action, plan and memory, in words.
        summary: The episode in words.
    """

    world, robot, ee_path = "/world", "/world/robot", "/world/ee_path"
    phase, events, words, summary = "/phase", "/events", "/words", "/summary"

    @staticmethod
    def body(name: str) -> str:
        """Path of a body of the scene."""
        return f"/world/bodies/{name}"

    @staticmethod
    def goal(name: str) -> str:
        """Path of an object's goal."""
        return f"/world/goals/{name}"

    @staticmethod
    def camera(name: str, more: Literal["", "/depth", "/segmentation"] = "") -> str:
        """Path of a camera's pose, pinhole and images; or of its other images."""
        return f"/world/cameras/{name}{more}"

    @staticmethod
    def curves(name: str) -> str:
        """Path of numbers over time."""
        return f"/plots/{_NOT_IN_PATHS.sub('_', name)}"


_NOT_IN_PATHS = re.compile(r"[ /()]+")
SECONDS = "time"
FRAMES = "frame"


def indexes(time_ns: NDArray[np.int64], frame_times: NDArray[np.int64]) -> list[rr.TimeColumn]:
    """Build time columns of rows at `time_ns`, each the time of a frame."""
    return [
        rr.TimeColumn(SECONDS, duration=time_ns.astype("timedelta64[ns]")),
        rr.TimeColumn(FRAMES, sequence=np.searchsorted(frame_times, time_ns)),
    ]


def log_pose(recording: rr.RecordingStream, entity: str, pose: Array) -> None:
    """Log the pose of a static entity."""
    recording.log(entity, rr.Transform3D(translation=pose[:3], quaternion=pose[3:]), static=True)


def send_poses(recording: rr.RecordingStream, entity: str, time_ns: NDArray[np.int64], poses: Array) -> None:
    """Send the poses of a moving entity at every frame."""
    columns = rr.Transform3D.columns(translation=poses[:, :3], quaternion=poses[:, 3:])
    recording.send_columns(entity, indexes(time_ns, time_ns), columns)
