"""Comparison of a run with the original that it reproduces: a run, a recording or a dataset.

The recordings of a run are read again, independent of run.json. A dataset is exported again with its own options and
compared episode by episode, by the content of its tables and videos.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from demorec.check.dataset import export_options
from demorec.core.config import GenerateConfig, parse_config
from demorec.core.errors import ConfigError, RecordingError, describe_error
from demorec.datasets.lerobot.export import export_lerobot
from demorec.datasets.lerobot.files import read_json
from demorec.datasets.lerobot.folder import LeRobotFolder
from demorec.datasets.lerobot.inspect import episode_digests
from demorec.datasets.lerobot.options import ExportOptions
from demorec.datasets.lerobot.sidecar import CONFIGS_PATH, EXPORT_PATH
from demorec.episode.validity import read_episode_info
from demorec.generate.contents import is_dataset_of_run
from demorec.generate.options import RunResult
from demorec.mcap import open_recording, open_simulated
from demorec.runs.find import expect
from demorec.runs.run_file import DATASET, RUN_NAME, load_run_file

Key = tuple[int, int]
"""(episode of the run, attempt)."""
_COLUMNS = ("run_episode_index", "attempt", "origin", "episode_info")
"""Columns of the sidecar that describe how a dataset was made."""


@dataclass(frozen=True, kw_only=True)
class Original:
    """The original to reproduce.

    Attributes:
        source: The run's folder, the recording or the dataset.
        config: Config that determined the data.
        num_episodes: Number of episodes of the run that are needed for the comparison.
        versions: package -> version that episodes were made with; each distinct set once.
        digests: (episode, attempt) -> digest of the current content; "" if it is in `faults`.
        faults: One line for each recording that is missing, unreadable, or inconsistent with run.json.
        export: Options of the dataset; None for a run or a recording.
    """

    source: Path
    config: GenerateConfig
    num_episodes: int
    versions: tuple[Mapping[str, str], ...]
    digests: Mapping[Key, str]
    faults: tuple[str, ...] = ()
    export: ExportOptions | None = None


def compare(original: Original, result: RunResult) -> dict[Key, bool]:
    """Compare a finished run with the original; returns episode and attempt -> whether its content is bit-exact."""
    made = {(a.episode_index, a.attempt): a.digest for a in result.run.attempts}
    if original.export is not None:
        made = _digests(LeRobotFolder(result.folder / DATASET))
    return {key: made.get(key) == value for key, value in original.digests.items()}


def export_as_original(original: Original, result: RunResult) -> None:
    """Export a run to its dataset with the options of the original dataset.

    Raises:
        ConfigError: The dataset's place is taken.
        ExportError: The export failed.
    """
    assert original.export is not None
    target = result.folder / DATASET
    there = os.path.lexists(target)
    if there and not is_dataset_of_run(target, result.run.config_digest):
        raise ConfigError(f"The place for the copy of the dataset is taken; choose another --out: {target}")
    export_lerobot([result.folder], target, replace(original.export, overwrite=there))


def read_original(path: Path) -> Original:
    """Read the description of a run, a recording or a dataset.

    Args:
        path: A run's folder or its run.json, a recording, or a dataset.

    Raises:
        ConfigError: The path is something else, or lacks information to reproduce it.
        RecordingError: The recording is damaged.
    """
    source = path.parent if path.name == RUN_NAME else path
    kind = expect(source, "run", "recording", "dataset").kind
    if kind == "run":
        return _read_run(source)
    if kind == "recording":
        return _read_recording(source)
    if not os.path.lexists(source / CONFIGS_PATH):
        raise ConfigError(f"The dataset has no record of its configs ({CONFIGS_PATH} is missing): {source}")
    return _read_dataset(source)


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


def _read_dataset(source: Path) -> Original:
    try:
        configs = read_json(source / CONFIGS_PATH)
        folder = LeRobotFolder(source)
        rows = folder.sidecar(_COLUMNS)
        if any(row["episode_info"] is None for row in rows):
            raise ConfigError(
                f"The episodes of this dataset were recorded by another robot or program, not generated: {source}"
            )
        if len(configs) != 1:
            raise ConfigError(
                f"The dataset was made from {len(configs)} runs: make each of them again from its own folder: {source}"
            )
        if any(row["origin"] for row in rows):
            raise ConfigError(f"The dataset holds replayed or rendered episodes, which no run makes: {source}")
        (config,) = configs.values()
        original = parse_config(config, GenerateConfig, source=str(source / CONFIGS_PATH))
        original.validate()
        return Original(
            source=source,
            config=original,
            num_episodes=1 + max(row["run_episode_index"] for row in rows),
            versions=(read_episode_info(rows[0]["episode_info"]).versions,),
            digests=_digests(folder),
            export=replace(export_options(source), episodes=read_json(source / EXPORT_PATH)["episodes"]),
        )
    except (OSError, ValueError, LookupError, TypeError, AttributeError) as error:
        raise ConfigError(
            f"The dataset lacks information to reproduce it ({describe_error(error)}): {source}"
        ) from error


def _digests(folder: LeRobotFolder) -> dict[Key, str]:
    """Compute digests of the content of a dataset's tables and videos."""
    rows, digests = folder.sidecar(_COLUMNS), episode_digests(folder)
    if len(digests) != len(rows):
        raise ConfigError(f"The dataset has {len(digests)} episodes, but its sidecar lists {len(rows)}: {folder.root}")
    return {(row["run_episode_index"], row["attempt"]): found for row, found in zip(rows, digests, strict=True)}
