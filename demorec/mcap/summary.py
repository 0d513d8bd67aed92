"""Content of a recording as plain data."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from demorec.core.plain import to_plain
from demorec.episode.episode import NO_IMAGE, Outcome
from demorec.episode.info import FORMAT_VERSION
from demorec.episode.roles import NO_NAMES, NamedRoles, Roles, roles_of_recording
from demorec.episode.simulated import simulation_facts
from demorec.mcap.recording import Recording, open_recording


def summarize(path: Path, named: NamedRoles = NO_NAMES) -> dict[str, Any]:
    """Read a whole recording and summarise its content, as printed by `demorec info --json`.

    Every recording has the same keys; what is unknown is None. `seconds` is the length, `rate` the mean frames per
    second (0 for a single frame), `oldest` the age of the oldest sample or image in a frame, in seconds.

    Raises:
        ConfigError: The recording lacks a feature that the user named, or is simulated.
        RecordingError: It is not a recording, or damaged.
    """
    with open_recording(path) as recording:
        info, facts = recording.info, simulation_facts(recording.info)
        outcome = recording.outcome or Outcome(num_frames=recording.num_frames)
        seconds, rate = _length(recording)
        roles = roles_of_recording(info, named)
        return {
            "kind": "recording" if facts else "external recording",
            "path": str(path),
            "bytes": path.stat().st_size,
            "format_version": FORMAT_VERSION,
            "episode_index": info.episode_index,
            "attempt": info.attempt,
            "root_seed": facts.get("root_seed"),
            "task": facts.get("task"),
            "instruction": info.instruction,
            "robot": info.robot_name,
            "has_urdf": bool(facts or info.urdf),
            "objects": facts.get("objects", []),
            "success": outcome.success,
            "is_recovered": recording.is_recovered,
            "failure_phase": outcome.failure_phase,
            "failure_reason": outcome.failure_reason,
            "checks": to_plain(outcome.checks),
            "retries": outcome.num_retries,
            "drops": dict(outcome.drops),
            "frames": recording.num_frames,
            "fps": info.fps,
            "physics_hz": facts.get("physics_hz"),
            "seconds": seconds,
            "rate": rate,
            "features": _features(recording, roles),
            "cameras": _cameras(recording),
            "streams": [
                {"topic": topic, "type": kind, "messages": count} for topic, (kind, count) in recording.topics.items()
            ],
            "origin": to_plain(info.origin),
            "config_digest": facts.get("config_digest", ""),
            "digest": recording.digest(),
            "final_state_digest": outcome.final_state_digest,
            "versions": dict(info.versions),
        }


def _length(recording: Recording) -> tuple[float, float]:
    """Compute seconds to the end of the last frame, which takes one nominal period, and mean frames per second."""
    times = recording.time_ns
    if not len(times):
        return 0.0, 0.0
    span = float(times[-1] - times[0]) / 1e9
    return span + 1 / recording.info.fps, (len(times) - 1) / span if span else 0.0


def _features(recording: Recording, roles: Roles) -> list[dict[str, Any]]:
    return [
        {
            "name": feature.name,
            "role": roles.of[feature.name],
            "dtype": feature.dtype,
            "elements": feature.names,
            "units": feature.units,
            "source": feature.source,
            "oldest": float(np.abs(recording.table().age_ns(feature.name)).max(initial=0)) / 1e9,
        }
        for feature in recording.info.features
    ]


def _cameras(recording: Recording) -> list[dict[str, Any]]:
    table = recording.table()
    recorded = {*recording.cameras, *recording.depth_cameras}
    return [
        {
            "name": camera.name,
            "mount": camera.mount,
            "video": to_plain(recording.video_settings(camera.name)),
            "depth": recording.has_depth(camera.name),
            "segmentation": recording.has_segmentation(camera.name),
            "is_kept": bool(camera.kept),
            "images": recording.num_images(camera.name),
            "frames_without": int((table.images[camera.name] == NO_IMAGE).sum()),
            "oldest": float(np.abs(table.image_age_ns(camera.name)).max(initial=0)) / 1e9,
            "source": camera.source,
        }
        for camera in recording.info.cameras
        if camera.name in recorded
    ]
