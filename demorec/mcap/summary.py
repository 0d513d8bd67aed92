"""What a recording holds, in a few lines of plain data."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from demorec.episode.episode import NO_IMAGE, Outcome, SuccessCheck
from demorec.episode.info import Origin
from demorec.mcap.recording import Recording, open_recording
from demorec.mcap.video import VideoSettings


@dataclass(frozen=True, kw_only=True)
class StreamSummary:
    """One topic: its name, type and number of messages."""

    topic: str
    type: str
    messages: int


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
class CameraSummary:
    """One camera.

    Attributes:
        name, mount: What it is called, and the link that carries it ("" when unknown).
        video: How its images are encoded.
        depth, segmentation: Whether these were recorded: of a simulated camera beside colour, of a depth camera alone.
        is_kept: Whether its images are encoded as they came.
        images: How many images there are.
        frames_without: How many frames hold none.
        oldest: Of those that frames hold, in seconds.
        source: Where they came from, in words.
    """

    name: str
    mount: str
    video: VideoSettings
    depth: bool
    segmentation: bool = False
    is_kept: bool = False
    images: int
    frames_without: int = 0
    oldest: float = 0.0
    source: str = ""


@dataclass(frozen=True, kw_only=True)
class RecordingSummary:
    """What `demorec info` says of a recording; times in seconds.

    Attributes:
        task, root_seed, physics_hz: None of an episode that demorec did not simulate.
        success: None when nobody said, or a crash cut the episode off (`is_recovered`).
        rate: Mean frames per second; 0 of a single frame.
        features: Of an episode that demorec did not simulate.
        digest: Of the content.
    """

    path: str
    bytes: int
    format_version: int
    episode_index: int
    attempt: int
    root_seed: int | None
    task: str | None
    instruction: str
    robot: str
    has_urdf: bool
    objects: tuple[str, ...]
    success: bool | None
    is_recovered: bool
    failure_phase: str
    failure_reason: str
    checks: tuple[SuccessCheck, ...]
    retries: int
    drops: Mapping[str, int]
    frames: int
    fps: int
    physics_hz: int | None
    seconds: float
    rate: float
    features: tuple[FeatureSummary, ...]
    cameras: tuple[CameraSummary, ...]
    streams: tuple[StreamSummary, ...]
    origin: str | Origin
    config_digest: str
    digest: str
    final_state_digest: str
    versions: Mapping[str, str]

    @property
    def is_simulated(self) -> bool:
        """Whether demorec simulated the episode."""
        return self.task is not None


def summarize(path: Path) -> RecordingSummary:
    """Read a recording, all of its content included, and say what it holds.

    Raises:
        RecordingError: It is none, or damaged.
    """
    with open_recording(path) as recording:
        info, simulated = recording.info, recording.info.simulation
        outcome = recording.outcome or Outcome(num_frames=recording.num_frames)
        seconds, rate = _length(recording)
        return RecordingSummary(
            path=str(path),
            bytes=path.stat().st_size,
            format_version=info.format_version,
            episode_index=info.episode_index,
            attempt=info.attempt,
            root_seed=None if simulated is None else simulated.root_seed,
            task=None if simulated is None else simulated.task,
            instruction=info.instruction,
            robot=info.robot_name,
            has_urdf=simulated is not None or bool(info.urdf),
            objects=() if simulated is None else tuple(body.name for body in simulated.scene.movable),
            success=outcome.success,
            is_recovered=recording.is_recovered,
            failure_phase=outcome.failure_phase,
            failure_reason=outcome.failure_reason,
            checks=outcome.checks,
            retries=outcome.num_retries,
            drops=outcome.drops,
            frames=recording.num_frames,
            fps=info.fps,
            physics_hz=None if simulated is None else simulated.physics_hz,
            seconds=seconds,
            rate=rate,
            features=tuple(_features(recording)),
            cameras=tuple(_cameras(recording)),
            streams=tuple(
                StreamSummary(topic=topic, type=kind, messages=count)
                for topic, (kind, count) in recording.topics.items()
            ),
            origin=info.origin,
            config_digest="" if simulated is None else simulated.config_digest,
            digest=recording.digest(),
            final_state_digest=outcome.final_state_digest,
            versions=info.versions,
        )


def _length(recording: Recording) -> tuple[float, float]:
    """Seconds, and mean frames per second."""
    if recording.info.simulation is not None:
        return recording.num_frames / recording.info.fps, float(recording.info.fps)
    times = recording.columns().time_ns
    seconds = float(times[-1] - times[0]) / 1e9 if len(times) else 0.0
    return seconds, (len(times) - 1) / seconds if seconds else 0.0


def _features(recording: Recording) -> Iterator[FeatureSummary]:
    for feature in recording.info.features:
        yield FeatureSummary(
            name=feature.name,
            dtype=feature.dtype,
            elements=feature.names,
            units=feature.units,
            source=feature.source,
            oldest=float(np.abs(recording.columns().age_ns(feature.name)).max(initial=0)) / 1e9,
        )


def _cameras(recording: Recording) -> Iterator[CameraSummary]:
    columns = recording.columns()
    recorded = {*recording.cameras, *recording.depth_cameras}
    for camera in (camera for camera in recording.info.cameras if camera.name in recorded):
        yield CameraSummary(
            name=camera.name,
            mount=camera.mount,
            video=recording.video_settings(camera.name),
            depth=recording.has_depth(camera.name),
            segmentation=recording.has_segmentation(camera.name),
            is_kept=bool(camera.kept),
            images=recording.num_images(camera.name),
            frames_without=int((columns.images[camera.name] == NO_IMAGE).sum()),
            oldest=float(np.abs(columns.image_age_ns(camera.name)).max(initial=0)) / 1e9,
            source=camera.source,
        )
