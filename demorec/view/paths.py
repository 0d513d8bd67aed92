"""Where everything is in the Rerun recording: entity paths, the two time lines, poses along them.

The time lines are seconds since the episode's start, and frame numbers.
"""

from __future__ import annotations

import re
from typing import Literal

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from demorec.core.geometry import Array


class Paths:
    """Paths below a root, "" for an episode alone or "/a" and "/b" for two that are compared.

    Attributes:
        root: As given.
        world: The scene, z up.
        robot: The robot's base; its links are nested below.
        ee_path: One piece of the gripper's path per frame.
        phase: Phases of the motion as states.
        events: What happened, as a log.
        words: What is being done, planned and remembered, in words.
        summary: The episode in words.
    """

    def __init__(self, root: str = "") -> None:
        self.root, self.world = root, f"{root}/world"
        self.robot, self.ee_path = f"{self.world}/robot", f"{self.world}/ee_path"
        self.phase, self.events = f"{root}/phase", f"{root}/events"
        self.words, self.summary = f"{root}/words", f"{root}/summary"

    def body(self, name: str) -> str:
        """A body of the scene."""
        return f"{self.world}/bodies/{name}"

    def goal(self, name: str) -> str:
        """Where an object shall end."""
        return f"{self.world}/goals/{name}"

    def end(self, name: str) -> str:
        """Where an object ended; not below the goal, whose transform would act on it too."""
        return f"{self.world}/ends/{name}"

    def camera(self, name: str, more: Literal["", "/depth", "/segmentation", "/boxes"] = "") -> str:
        """A camera: its pose, its pinhole and its images; or more images of it, or boxes around what it sees."""
        return f"{self.world}/cameras/{name}{more}"

    def curves(self, name: str) -> str:
        """Numbers over time."""
        return f"{self.root}/plots/{_NOT_IN_PATHS.sub('_', name)}"


_NOT_IN_PATHS = re.compile(r"[ /()]+")
SECONDS = "time"
FRAMES = "frame"


def indexes(time_ns: NDArray[np.int64], frame_times: NDArray[np.int64] | None) -> list[rr.TimeColumn]:
    """Time columns of rows at `time_ns`, each of which is the time of a frame; None for rows between frames."""
    seconds = rr.TimeColumn(SECONDS, duration=time_ns.astype("timedelta64[ns]"))
    if frame_times is None:
        return [seconds]
    return [seconds, rr.TimeColumn(FRAMES, sequence=np.searchsorted(frame_times, time_ns))]


def log_pose(recording: rr.RecordingStream, entity: str, pose: Array) -> None:
    """Of an entity that stays where it is."""
    recording.log(entity, rr.Transform3D(translation=pose[:3], quaternion=pose[3:]), static=True)


def send_poses(recording: rr.RecordingStream, entity: str, time_ns: NDArray[np.int64], poses: Array) -> None:
    """Of an entity that moves, at every frame."""
    columns = rr.Transform3D.columns(translation=poses[:, :3], quaternion=poses[:, 3:])
    recording.send_columns(entity, indexes(time_ns, time_ns), columns)
