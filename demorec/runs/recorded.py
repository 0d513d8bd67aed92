"""Read a recording's line of run.json, its config and its versions."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from demorec.core.atomic import take_name
from demorec.core.errors import NotGeneratedError, RecordingError
from demorec.core.files import sha256_of, sync_path
from demorec.episode.info import NOT_SIMULATED, EpisodeInfo
from demorec.mcap import open_recording
from demorec.mcap.part_file import name_taken
from demorec.runs.run_file import Attempt


def recorded_line(path: Path) -> tuple[Attempt, EpisodeInfo]:
    """Read a whole recording: its line of run.json, with the bare name as its `file`, and its info.

    Raises:
        RecordingError: It is damaged.
    """
    with open_recording(path) as recording:
        info, outcome = recording.info, recording.outcome
        is_simulated = info.simulation is not None
        line = Attempt(
            episode_index=info.episode_index,
            attempt=info.attempt,
            seed=info.simulated.root_seed if is_simulated else 0,
            success=None if outcome is None else outcome.success,
            file=path.name,
            sha256=sha256_of(path),
            digest=recording.digest(),
            num_frames=recording.num_frames,
            num_bytes=path.stat().st_size,
            phase="" if outcome is None else outcome.failure_phase,
            reason="cut off by a crash" if outcome is None else outcome.failure_reason,
            instruction="" if is_simulated else info.instruction,
            drops={} if outcome is None else outcome.drops,
        )
        return line, info


def inspect_recording(path: Path) -> tuple[Attempt, Mapping[str, Any], Mapping[str, str]]:
    """Read a whole finished recording without relying on run.json.

    Returns:
        Its line of run.json, with the bare name as its `file`; its config as plain data; and package -> version of the
        packages that decided the bits.

    Raises:
        RecordingError: It is not a complete recording of a simulated episode.
        NotGeneratedError: It is a render, a replay or a policy rollout.
    """
    attempt, info = recorded_line(path)
    if info.simulation is None:
        raise RecordingError(f"{NOT_SIMULATED}: {path}")
    if info.origin:
        raise NotGeneratedError(f"The recording is a {info.origin}, which generate-dataset did not make: {path}")
    if attempt.success is None:
        raise RecordingError(f"The recording was cut off by a crash: {path}")
    return attempt, info.simulated.config, info.versions


def place_recording(made: Path, target: Path) -> None:
    """Move a finished recording into a run, where it may replace only a recording of the same episode.

    Raises:
        ConfigError: Another file has appeared there. Both files stay.
        OSError: The folder is not writable.
    """
    try:
        take_name(made, target)
    except FileExistsError as error:
        if not _is_same_episode(made, target):
            raise name_taken(target, made) from error
        made.replace(target)
    sync_path(target.parent)


def _is_same_episode(first: Path, second: Path) -> bool:
    try:
        with open_recording(first) as one, open_recording(second) as other:
            return one.info == other.info
    except RecordingError:
        return False
