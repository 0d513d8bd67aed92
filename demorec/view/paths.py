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
    """Paths below a root, "" for a single episode or "/a" and "/b" for two that are compared.

    Attributes:
        root: The root argument.
        world: The scene, z up.
        robot: The robot's base; its links are nested below.
        ee_path: One piece of the gripper's path per frame.
        phase: Phases of the motion as states.
        events: Log of events.
        words: Current statements on action, plan and memory, in words.
        summary: The episode in words.
    """

    def __init__(self, root: str = "") -> None:
        self.root, self.world = root, f"{root}/world"
        self.robot, self.ee_path = f"{self.world}/robot", f"{self.world}/ee_path"
        self.phase, self.events = f"{root}/phase", f"{root}/events"
        self.words, self.summary = f"{root}/words", f"{root}/summary"

    def body(self, name: str) -> str:
        """Path of a body of the scene."""
        return f"{self.world}/bodies/{name}"

    def goal(self, name: str) -> str:
        """Path of an object's goal."""
        return f"{self.world}/goals/{name}"

    def end(self, name: str) -> str:
        """Path of an object's final pose; not below the goal, because the goal's transform would apply to it."""
        return f"{self.world}/ends/{name}"

    def camera(self, name: str, more: Literal["", "/depth", "/segmentation", "/boxes"] = "") -> str:
        """Path of a camera's pose, pinhole and images; or of its other images, or boxes around visible bodies."""
        return f"{self.world}/cameras/{name}{more}"

    def curves(self, name: str) -> str:
        """Path of numbers over time."""
        return f"{self.root}/plots/{_NOT_IN_PATHS.sub('_', name)}"


_NOT_IN_PATHS = re.compile(r"[ /()]+")
SECONDS = "time"
FRAMES = "frame"


def indexes(time_ns: NDArray[np.int64], frame_times: NDArray[np.int64] | None) -> list[rr.TimeColumn]:
    """Build time columns of rows at `time_ns`, each the time of a frame; None for rows between frames."""
    seconds = rr.TimeColumn(SECONDS, duration=time_ns.astype("timedelta64[ns]"))
    if frame_times is None:
        return [seconds]
    return [seconds, rr.TimeColumn(FRAMES, sequence=np.searchsorted(frame_times, time_ns))]


def log_pose(recording: rr.RecordingStream, entity: str, pose: Array) -> None:
    """Log the pose of a static entity."""
    recording.log(entity, rr.Transform3D(translation=pose[:3], quaternion=pose[3:]), static=True)


def send_poses(recording: rr.RecordingStream, entity: str, time_ns: NDArray[np.int64], poses: Array) -> None:
    """Send the poses of a moving entity at every frame."""
    columns = rr.Transform3D.columns(translation=poses[:, :3], quaternion=poses[:, 3:])
    recording.send_columns(entity, indexes(time_ns, time_ns), columns)
