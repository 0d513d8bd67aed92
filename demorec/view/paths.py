"""Where everything is in the Rerun recording: entity paths, the two time lines, poses along them.

The time lines are seconds since the episode's start, and frame numbers.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from demorec.core.geometry import Array


@dataclass(frozen=True)
class Paths:
    """Paths below a root, "" for an episode alone or "/a" and "/b" for two that are compared."""

    root: str = ""

    @property
    def world(self) -> str:
        """The scene, z up."""
        return f"{self.root}/world"

    @property
    def robot(self) -> str:
        """The robot's base; its links are nested below."""
        return f"{self.world}/robot"

    @property
    def ee_path(self) -> str:
        """One piece of the gripper's path per frame."""
        return f"{self.world}/ee_path"

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
        return f"{self.root}/plots/{name.replace(' ', '_')}"

    @property
    def phase(self) -> str:
        """Phases of the motion as states."""
        return f"{self.root}/phase"

    @property
    def events(self) -> str:
        """What happened, as a log."""
        return f"{self.root}/events"

    @property
    def words(self) -> str:
        """What is being done, planned and remembered, in words."""
        return f"{self.root}/words"

    @property
    def summary(self) -> str:
        """The episode in words."""
        return f"{self.root}/summary"


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
