"""What a finished recording says about the run that it belongs to: read back in full, never taken on trust."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from demorec.core.errors import RecordingError
from demorec.mcap import SimulatedRecording
from demorec.runs.run_file import Attempt, sha256_of


@dataclass(frozen=True, kw_only=True)
class Inspected:
    """A recording's own account.

    Attributes:
        attempt: The line of run.json that it speaks for; `file` is the bare name.
        config: The resolved config that it was made with, as plain data.
        versions: package -> version, of what decided the bits.
    """

    attempt: Attempt
    config: Mapping[str, Any]
    versions: Mapping[str, str]


def inspect_recording(path: Path) -> Inspected:
    """Read all of a recording.

    Raises:
        RecordingError: It is no complete recording.
    """
    with SimulatedRecording(path) as recording:
        info, outcome = recording.info, recording.outcome
        if outcome is None:
            raise RecordingError(f"The recording was cut off by a crash: {path}")
        attempt = Attempt(
            episode_index=info.episode_index,
            attempt=info.attempt,
            seed=info.root_seed,
            success=bool(outcome.success),
            file=path.name,
            sha256=sha256_of(path),
            digest=recording.digest(),
            num_frames=recording.num_frames,
            num_bytes=path.stat().st_size,
            phase=outcome.failure_phase,
            reason=outcome.failure_reason,
        )
        return Inspected(attempt=attempt, config=info.config, versions=info.versions)
