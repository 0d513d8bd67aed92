"""Poses of entities: (7,) or (T, 7) position and quaternion, in the frame of the entity above."""

from __future__ import annotations

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from demorec.geometry import Array
from demorec.playback.times import indexes


def log_pose(recording: rr.RecordingStream, entity: str, pose: Array) -> None:
    """Of an entity that stays where it is."""
    recording.log(entity, rr.Transform3D(translation=pose[:3], quaternion=pose[3:]), static=True)


def send_poses(recording: rr.RecordingStream, entity: str, time_ns: NDArray[np.int64], poses: Array) -> None:
    """Of an entity that moves, at every frame."""
    columns = rr.Transform3D.columns(translation=poses[:, :3], quaternion=poses[:, 3:])
    recording.send_columns(entity, indexes(time_ns, time_ns), columns)
