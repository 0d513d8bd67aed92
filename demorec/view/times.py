"""The two time lines of every recording (seconds since the episode's start, frame numbers), and poses along them."""

from __future__ import annotations

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from demorec.core.geometry import Array

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
