"""What a recording holds, in a few lines of plain data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from demorec.episode.episode import SuccessCheck
from demorec.mcap.external.reader import Recording
from demorec.mcap.recording import SimulatedRecording
from demorec.mcap.video import VideoSettings


@dataclass(frozen=True, kw_only=True)
class StreamSummary:
    """One topic: its name, type and number of messages."""

    topic: str
    type: str
    messages: int


@dataclass(frozen=True, kw_only=True)
class CameraSummary:
    """One camera: how its pictures were coded, and what beside colour was recorded."""

    name: str
    mount: str
    video: VideoSettings
    depth: bool
    segmentation: bool


@dataclass(frozen=True, kw_only=True)
class RecordingSummary:
    """What `demorec info` tells of a recording; times in seconds.

    Attributes:
        success: None when a crash cut the episode off.
        digest: Of the content.
    """

    path: str
    bytes: int
    format_version: int
    episode_index: int
    attempt: int
    root_seed: int
    task: str
    instruction: str
    robot: str
    objects: tuple[str, ...]
    success: bool | None
    failure_phase: str
    failure_reason: str
    checks: tuple[SuccessCheck, ...]
    retries: int
    frames: int
    fps: int
    physics_hz: int
    seconds: float
    cameras: tuple[CameraSummary, ...]
    streams: tuple[StreamSummary, ...]
    origin: str
    config_digest: str
    digest: str
    final_state_digest: str
    versions: Mapping[str, str]


def common_facts(recording: SimulatedRecording | Recording) -> dict[str, Any]:
    """What summaries of both kinds of recordings tell, by the names of their attributes."""
    info, outcome = recording.info, recording.outcome
    return {
        "path": str(recording.path),
        "bytes": recording.path.stat().st_size,
        "format_version": info.format_version,
        "episode_index": info.episode_index,
        "instruction": info.instruction,
        "success": None if outcome is None else outcome.success,
        "frames": recording.num_frames,
        "fps": info.fps,
        "streams": tuple(
            StreamSummary(topic=topic, type=kind, messages=count) for topic, (kind, count) in recording.topics.items()
        ),
        "origin": info.origin,
        "digest": recording.digest(),
        "versions": info.versions,
    }


def summarize(path: Path) -> RecordingSummary:
    """Read a recording, all of its content included, and tell what it holds.

    Raises:
        RecordingError: It is none, or damaged.
    """
    with SimulatedRecording(path) as recording:
        info, outcome = recording.info, recording.outcome
        return RecordingSummary(
            **common_facts(recording),
            attempt=info.attempt,
            root_seed=info.root_seed,
            task=info.task,
            robot=info.robot.name,
            objects=tuple(body.name for body in info.scene.movable),
            failure_phase="" if outcome is None else outcome.failure_phase,
            failure_reason="" if outcome is None else outcome.failure_reason,
            checks=() if outcome is None else outcome.checks,
            retries=0 if outcome is None else outcome.num_retries,
            physics_hz=info.physics_hz,
            seconds=recording.num_frames / info.fps,
            cameras=tuple(
                CameraSummary(
                    name=camera.name,
                    mount=camera.mount,
                    video=recording.video_settings(camera.name),
                    depth=recording.has_depth(camera.name),
                    segmentation=recording.has_segmentation(camera.name),
                )
                for camera in info.scene.cameras
                if camera.name in recording.cameras
            ),
            config_digest=info.config_digest,
            final_state_digest="" if outcome is None else outcome.final_state_digest,
        )
