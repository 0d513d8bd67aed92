"""Comparison of a run with the original that it reproduces: a run or a recording.

The recordings of a run are read again, independent of run.json.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from demorec.core.config import GenerateConfig, parse_config
from demorec.core.errors import ConfigError, RecordingError
from demorec.generate.options import RunResult
from demorec.mcap import open_recording, open_simulated
from demorec.runs.find import expect
from demorec.runs.run_file import RUN_NAME, load_run_file

Key = tuple[int, int]
"""(episode of the run, attempt)."""


@dataclass(frozen=True, kw_only=True)
class Original:
    """The original to reproduce.

    Attributes:
        source: The run's folder, or the recording.
        config: Config that determined the data.
        num_episodes: Number of episodes of the run that are needed for the comparison.
        versions: package -> version that episodes were made with; each distinct set once.
        digests: (episode, attempt) -> digest of the current content; "" if it is in `faults`.
        faults: One line for each recording that is missing, unreadable, or inconsistent with run.json.
    """

    source: Path
    config: GenerateConfig
    num_episodes: int
    versions: tuple[Mapping[str, str], ...]
    digests: Mapping[Key, str]
    faults: tuple[str, ...] = ()


def compare(original: Original, result: RunResult) -> dict[Key, bool]:
    """Compare a finished run with the original; returns episode and attempt -> whether its content is bit-exact."""
    made = {(a.episode_index, a.attempt): a.digest for a in result.run.attempts}
    return {key: made.get(key) == value for key, value in original.digests.items()}


def read_original(path: Path) -> Original:
    """Read the description of a run (its folder or run.json) or a recording.

    Raises:
        ConfigError: The path is something else, or lacks information to reproduce it.
        RecordingError: The recording is damaged.
    """
    source = path.parent if path.name == RUN_NAME else path
    is_run = expect(source, "run", "recording").kind == "run"
    return _read_run(source) if is_run else _read_recording(source)


def _read_run(source: Path) -> Original:
    run = load_run_file(source)
    if not run.attempts:
        raise ConfigError(f"The run has no episodes yet: {source}")
    run.config.validate()
    digests: dict[Key, str] = {}
    versions, faults = [run.versions], []
    for attempt in run.attempts:
        key, path = (attempt.episode_index, attempt.attempt), source / attempt.file
        digests[key] = attempt.digest
        if not attempt.file:  # no scene was found, so nothing was recorded
            continue
        try:
            with open_simulated(path) as recording:
                info, found = recording.info, recording.digest()
        except RecordingError as error:
            digests[key] = ""
            faults.append(str(error))
            continue
        if (info.episode_index, info.attempt, found) != (*key, attempt.digest):
            digests[key] = ""
            faults.append(f"The recording differs from the one in {RUN_NAME}: {path}")
        if info.versions not in versions:
            versions.append(info.versions)
    return Original(
        source=source,
        config=run.config,
        num_episodes=1 + max(a.episode_index for a in run.attempts),
        versions=tuple(there for there in versions if there),
        digests=digests,
        faults=tuple(faults),
    )


def _read_recording(source: Path) -> Original:
    with open_recording(source) as recording:
        info, digest = recording.info, recording.digest()
    if info.simulation is None:
        raise ConfigError(f"The recording was recorded by another robot or program, not generated: {source}")
    if info.origin:
        raise ConfigError(f"The recording is a {info.origin}, which generate-dataset did not make: {source}")
    config = parse_config(dict(info.simulated.config), GenerateConfig, source=str(source))
    config.validate()
    return Original(
        source=source,
        config=config,
        num_episodes=1 + info.episode_index,
        versions=(info.versions,),
        digests={(info.episode_index, info.attempt): digest},
    )
