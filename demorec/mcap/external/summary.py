"""What the recording of a collected episode holds, in a few lines of plain data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from demorec.episode.external import NO_PICTURE, Origin
from demorec.mcap.external.reader import Recording
from demorec.mcap.summary import StreamSummary, common_facts
from demorec.mcap.video import VideoSettings


@dataclass(frozen=True, kw_only=True)
class FeatureSummary:
    """One feature: its elements, and the oldest sample that a frame holds, in seconds."""

    name: str
    dtype: str
    elements: tuple[str, ...]
    units: tuple[str, ...]
    source: str
    oldest: float


@dataclass(frozen=True, kw_only=True)
class ExternalCameraSummary:
    """One camera: how its pictures are coded, how many there are, how many frames have none, the oldest in seconds."""

    name: str
    video: VideoSettings
    is_kept: bool
    pictures: int
    frames_without: int
    oldest: float
    source: str


@dataclass(frozen=True, kw_only=True)
class ExternalSummary:
    """What `demorec info` tells of a collected episode; times in seconds.

    Attributes:
        success: None when nobody said, or a crash cut the episode off.
        rate: Mean frames per second; 0 of a single frame.
        digest: Of the content.
    """

    path: str
    bytes: int
    format_version: int
    episode_index: int
    instruction: str
    robot: str
    has_urdf: bool
    success: bool | None
    is_recovered: bool
    reason: str
    drops: Mapping[str, int]
    frames: int
    fps: int
    seconds: float
    rate: float
    features: tuple[FeatureSummary, ...]
    cameras: tuple[ExternalCameraSummary, ...]
    streams: tuple[StreamSummary, ...]
    origin: Origin
    digest: str
    versions: Mapping[str, str]


def summarize_external(path: Path) -> ExternalSummary:
    """Read a recording, all of its content included, and tell what it holds; RecordingError: it is none, or damaged."""
    with Recording(path) as recording:
        info, outcome, columns = recording.info, recording.outcome, recording.columns()
        seconds = float(columns.time_ns[-1] - columns.time_ns[0]) / 1e9 if columns.num_frames else 0.0
        return ExternalSummary(
            **common_facts(recording),
            robot=info.robot,
            has_urdf=bool(info.urdf),
            is_recovered=recording.is_recovered,
            reason="" if outcome is None else outcome.failure_reason,
            drops={} if outcome is None else outcome.drops,
            seconds=seconds,
            rate=(columns.num_frames - 1) / seconds if seconds else 0.0,
            features=tuple(
                FeatureSummary(
                    name=feature.name,
                    dtype=feature.dtype,
                    elements=feature.names,
                    units=feature.units,
                    source=feature.source,
                    oldest=float(np.abs(columns.age_ns(feature.name)).max(initial=0)) / 1e9,
                )
                for feature in info.features
            ),
            cameras=tuple(
                ExternalCameraSummary(
                    name=camera.name,
                    video=recording.video_settings(camera.name),
                    is_kept=bool(camera.kept),
                    pictures=len(columns.picture_stamps[camera.name]),
                    frames_without=int((columns.pictures[camera.name] == NO_PICTURE).sum()),
                    oldest=float(np.abs(columns.picture_age_ns(camera.name)).max(initial=0)) / 1e9,
                    source=camera.source,
                )
                for camera in info.cameras
            ),
        )
