"""Does a run's folder hold what its run.json says, each episode once, and do they cover what was randomised."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from demorec.check.base import Measurement, check, worst
from demorec.check.coverage import infos_by_task, largest_gap, start_vector, twins
from demorec.errors import ConfigError, RecordingError, in_words, resource_error
from demorec.lerobot.files import read_json
from demorec.lerobot.paths import INFO_PATH
from demorec.recording import Recording
from demorec.safety.files import open_regular, read_json_limited
from demorec.scene.episode import EpisodeInfo

RUN_NAME = "run.json"
_MAX_JSON_BYTES = 2 << 30
_LINE = {"episode_index": int, "attempt": int, "seed": int, "success": bool, "file": str, "sha256": str}
"""What the line of an attempt says, as far as it is checked."""


class CheckedRun:
    """A run on disk, read from its own files.

    Args:
        path: The folder with run.json.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    @cached_property
    def run(self) -> dict[str, Any]:
        """run.json; ConfigError when it cannot be read."""
        try:
            run = read_json_limited(self.path / RUN_NAME, _MAX_JSON_BYTES)
            lines = run["episodes"]
            for line in (line for line in lines if line["state"] != "planned"):
                wrong = [key for key, kind in _LINE.items() if not isinstance(line[key], kind)]
                if wrong:
                    raise ValueError(f"the line of an episode with an impossible {wrong[0]}")
            if not isinstance(run["num_episodes"], int):
                raise ValueError("num_episodes is no whole number")
        except OSError as error:
            unusable = ConfigError(f"{RUN_NAME} cannot be used ({error.strerror}): {self.path}")
            raise resource_error(error) or unusable from error
        except (ValueError, KeyError, TypeError) as error:
            raise ConfigError(f"{RUN_NAME} cannot be used ({in_words(error)}): {self.path}") from error
        return dict(run)

    @property
    def lines(self) -> list[dict[str, Any]]:
        """Of the attempts that have a recording."""
        return [line for line in self.run["episodes"] if line["state"] != "planned" and line.get("file")]

    @property
    def recordings(self) -> list[Path]:
        """Every recording there is, successes first."""
        return [*sorted((self.path / "episodes").glob("*.mcap")), *sorted((self.path / "failed").glob("*.mcap"))]

    @cached_property
    def infos(self) -> dict[str, EpisodeInfo]:
        """File (relative) -> its info, of the recordings that can be opened."""
        found = {}
        for path in self.recordings:
            try:
                with Recording(path) as recording:
                    found[str(path.relative_to(self.path))] = recording.info
            except RecordingError:
                continue  # check `opens` of that recording says so
        return found

    @property
    def successes(self) -> list[EpisodeInfo]:
        """Infos of the recordings in episodes/ that were asked for last (others may be there from a larger request)."""
        asked = self.run["num_episodes"]
        return [
            info for file, info in self.infos.items() if file.startswith("episodes/") and info.episode_index < asked
        ]


@check(group="run", scope="run", measures="files missing, changed since they were made, or not in run.json", warn=0)
def run_files(run: CheckedRun) -> Measurement:
    """The recordings are exactly those that run.json lists, with the same SHA-256."""
    wrong = []
    listed = {line["file"]: line for line in run.lines}
    there = {str(path.relative_to(run.path)) for path in run.recordings}
    wrong += [f"{file} is missing" for file in sorted(listed.keys() - there)]
    wrong += [f"{file} is not in run.json" for file in sorted(there - listed.keys())]
    for file in sorted(there & listed.keys()):
        try:
            with open_regular(run.path / file) as stream:
                if hashlib.file_digest(stream, "sha256").hexdigest() != listed[file]["sha256"]:
                    wrong.append(f"{file} has changed")
        except OSError as error:
            if (lack := resource_error(error, run.path / file)) is not None:
                raise lack from error
            wrong.append(f"{file} cannot be read ({error.strerror})")
    return Measurement(value=len(wrong), detail="; ".join(wrong[:3]) or f"{len(there)} recordings")


@check(group="run", scope="run", measures="recordings whose own account differs from run.json or the run", warn=0)
def run_agrees(run: CheckedRun) -> Measurement:
    """Number, attempt, seed and config of each recording are those of its line and of the run."""
    wrong = []
    for line in run.lines:
        info = run.infos.get(line["file"])
        if info is None:
            continue
        said = (line["episode_index"], line["attempt"], line["seed"])
        if (info.episode_index, info.attempt, info.root_seed) != said:
            wrong.append(f"{line['file']} is episode {info.episode_index}, attempt {info.attempt}")
        elif info.config_digest != run.run.get("config_digest"):
            wrong.append(f"{line['file']} was made with another config")
        elif line["success"] != line["file"].startswith("episodes/"):
            wrong.append(f"{line['file']} lies in the wrong folder")
    return Measurement(value=len(wrong), detail="; ".join(wrong[:3]) or f"{len(run.lines)} lines")


@check(group="run", scope="run", measures="episodes that have the start or the motion of another", warn=0)
def run_duplicates(run: CheckedRun) -> Measurement | None:
    """Every episode is there once: no two start alike (within a tenth of a millimetre) or move alike."""
    files = [file for file in run.infos if file.startswith("episodes/")]
    if len(files) < 2:
        return None
    starts = [start_vector(run.infos[file].scene) for file in files]
    motions = []
    for file in files:
        try:
            with Recording(run.path / file) as recording:
                motions.append(motion_vector(recording.columns().joint_position))
        except RecordingError:
            motions.append(np.full(1, float(len(motions))))
    same_start, start_pair = twins(starts, files, tolerance=1e-4)
    same_motion, motion_pair = twins(motions, files, tolerance=1e-4)
    return worst(
        Measurement(value=same_start, detail=start_pair or f"{len(files)} different starts"),
        Measurement(value=same_motion, detail=motion_pair or f"{len(files)} different motions"),
    )


def motion_vector(joint_position: np.ndarray[Any, np.dtype[Any]]) -> np.ndarray[Any, np.dtype[np.float64]]:
    """A motion as one row of fixed length: joint positions at 32 moments, evenly spread."""
    if not len(joint_position):
        return np.zeros(32)
    moments = np.linspace(0, len(joint_position) - 1, 32).round().astype(int)
    return np.asarray(joint_position[moments], dtype=np.float64).reshape(-1)


@check(
    group="run", scope="run", measures="largest gap in the range of a randomised quantity, share", warn=0.35, fail=0.6
)
def run_coverage(run: CheckedRun) -> Measurement | None:
    """Start places, yaws, sizes and goals are spread over their ranges (judged from 50 episodes on)."""
    return worst_gap(run.successes)


def worst_gap(infos: Sequence[EpisodeInfo]) -> Measurement | None:
    """The largest gap over all tasks."""
    return worst(*(largest_gap(group) for group in infos_by_task(infos).values()))


@check(group="run", scope="run", measures="episodes that the run's dataset lacks or has too many", warn=0)
def run_dataset(run: CheckedRun) -> Measurement | None:
    """The dataset that was made from the run has an episode for each success of those asked for last."""
    path = run.path / "dataset" / INFO_PATH
    if not path.is_file():
        return None
    try:
        episodes = int(read_json(path)["total_episodes"])
    except (OSError, ValueError, KeyError, TypeError, OverflowError) as error:
        raise ConfigError(f"info.json of the dataset cannot be used ({in_words(error)}): {path}") from error
    successes = sum(1 for line in run.lines if line["success"] and line["episode_index"] < run.run["num_episodes"])
    return Measurement(value=abs(episodes - successes), detail=f"{episodes} in the dataset, {successes} successes")
