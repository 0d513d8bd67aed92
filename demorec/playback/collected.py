"""Collected episodes out of recordings: every feature, every camera, the joints that the URDF has."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from demorec.playback.episode import Curves, PlayedCollected, Video, timed
from demorec.recording import CollectedRecording
from demorec.recording.collected.transforms import JointPositions
from demorec.scene.collected import NO_PICTURE, CollectedColumns


@contextmanager
def open_collected(path: Path, *, group: str) -> Iterator[PlayedCollected]:
    """The episode of a recording; its pictures can be read until the context is left.

    Raises:
        RecordingError: It cannot be read.
    """
    with CollectedRecording(path) as recording:
        info, columns = recording.info, recording.columns()
        time_ns = columns.time_ns - (columns.time_ns[0] if columns.num_frames else 0)
        positions = JointPositions(info.features)
        values = positions.of(columns.features) if positions.joints else np.zeros((len(time_ns), 0))
        yield PlayedCollected(
            name=path.name.removesuffix(".mcap"),
            group=group,
            identity=hashlib.sha256(str(path.resolve()).encode()).hexdigest()[:16],
            source=path.name,
            info=info,
            outcome=recording.outcome,
            time_ns=time_ns,
            joint_position=dict(zip(positions.joints, values.T, strict=True)),
            curves={
                feature.name: Curves(
                    time_ns=time_ns, values=columns.features[feature.name].astype(np.float64), names=feature.names
                )
                for feature in info.features
            },
            videos={
                camera: Video(
                    codec=recording.video_settings(camera).codec,
                    packets=partial(_packets, recording, camera, _shown_at(columns, camera, time_ns)),
                )
                for camera in recording.cameras
                if len(columns.picture_stamps[camera])
            },
            depth={
                camera: partial(timed, _shown_at(columns, camera, time_ns), partial(recording.distances, camera))
                for camera in recording.depth_cameras
                if len(columns.picture_stamps[camera])
            },
            statements=tuple((int(time_ns[frame]), "subtask", text) for frame, text in recording.subtasks),
        )


def _shown_at(columns: CollectedColumns, camera: str, time_ns: NDArray[np.int64]) -> NDArray[np.int64]:
    """(P,) when each picture of a camera is shown: with the first frame that holds it, or the next one after it.

    Not at its own stamp, which may be of another clock.
    """
    frames = np.flatnonzero(columns.pictures[camera] != NO_PICTURE)
    numbers = np.maximum.accumulate(columns.pictures[camera][frames])
    count = len(columns.picture_stamps[camera])
    places = np.minimum(np.searchsorted(numbers, np.arange(count)), max(len(frames) - 1, 0))
    return time_ns[frames[places]] if len(frames) else np.zeros(count, dtype=np.int64)


def _packets(
    recording: CollectedRecording, camera: str, shown_at: NDArray[np.int64]
) -> Iterator[tuple[int, bytes, bool]]:
    for packet in recording.packets(camera):
        yield int(shown_at[packet.frame_index]), packet.data, packet.is_keyframe
