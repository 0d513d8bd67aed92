"""Progress of each frame: the column `progress_dense` of `sarm_progress.parquet`, for every row of the dataset.

Progress has SARM's stages (arXiv 2509.25358): a stage is one phase for one goal. Frames that undo progress belong to
the stage to be repeated: after a miss, a drop or a bad placement the next approach begins, so progress falls back.
`lerobot-train --sample_weighting.type=rabc --sample_weighting.head_mode=dense` weights samples by it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from demorec.core.geometry import Array
from demorec.datasets.episode import ExportEpisode
from demorec.datasets.lerobot.paths import PROGRESS_PATH
from demorec.episode.episode import consecutive_runs
from demorec.extensions.language.timeline import EpisodeTimeline, PhaseSegment, episode_timeline

_STAGES = ("approach", "descend", "close", "lift", "transport", "lower", "release", "retreat")
_STAGE_OF_PHASE = {phase: phase for phase in _STAGES} | {
    "open": "approach",
    "above_cube": "approach",
    "hold": "lift",
    "carry": "transport",
    "recover": "approach",
}
"""Phase -> stage, with the tutorial's names, and the stage to repeat after a failure."""
WHOLE_TASK = "task"
"""The only stage of an episode with unknown phases."""


class StageRun(NamedTuple):
    """Rows `first` to `last` of an episode, both included, in one stage, such as "goal 1: approach"."""

    stage: str
    first: int
    last: int


class ProgressFile:
    """Writer of the file, which needs the stages of all episodes."""

    def __init__(self, root: Path, fps: int) -> None:
        del fps
        self._path = root / PROGRESS_PATH
        self._episodes: list[tuple[int, list[StageRun]]] = []

    @staticmethod
    def read(episode: ExportEpisode[Any]) -> tuple[int, list[StageRun]]:
        """Return the number of goals, and the stages of all rows."""
        return len(episode.info.simulated.scene.goals), dense_runs(episode_timeline(episode.recording))

    def add(self, goals_and_runs: tuple[int, list[StageRun]]) -> None:
        """Add the next episode."""
        self._episodes.append(goals_and_runs)

    def finish(self) -> None:
        """Write the file of progress for all episodes of a new dataset."""
        possible = [dense_stages(num_goals, runs) for num_goals, runs in self._episodes]
        stages = dict.fromkeys(chain.from_iterable(possible))
        shares = proportions([runs for _, runs in self._episodes], tuple(stages))
        parts = [progress(runs, own, shares) for (_, runs), own in zip(self._episodes, possible, strict=True)]
        lengths = [len(part) for part in parts]
        columns = {
            "index": np.arange(sum(lengths)),
            "episode_index": np.repeat(np.arange(len(lengths)), lengths),
            "frame_index": np.concatenate([np.arange(length) for length in lengths]),
            "progress_dense": np.concatenate(parts).astype(np.float32),
        }
        pq.write_table(pa.table(columns), self._path, use_dictionary=["episode_index"])


def dense_stages(num_goals: int, runs: Sequence[StageRun]) -> tuple[str, ...]:
    """Return all stages of an episode with this number of goals, in order, without those that a script leaves out."""
    if runs[0].stage == WHOLE_TASK:
        return (WHOLE_TASK,)
    done = {run.stage.partition(": ")[2] for run in runs}
    is_whole = "release" in done  # otherwise the episode failed before the last stages
    stages = [stage for stage in _STAGES if stage in done or not is_whole]
    return tuple(f"goal {goal}: {stage}" for goal in range(1, num_goals + 1) for stage in stages)


def dense_runs(timeline: EpisodeTimeline) -> list[StageRun]:
    """Return the stages of an episode, in order of time; a single stage if the phases are not those of demorec's
    skills.
    """
    names = [_stage_name(segment) for segment in timeline.segments]
    if not all(names):
        return [StageRun(WHOLE_TASK, 0, timeline.segments[-1].end - 1)]
    stages = np.repeat(names, [segment.end - segment.first for segment in timeline.segments]).tolist()
    return [StageRun(name, first, end - 1) for name, first, end in consecutive_runs(stages)]


def _stage_name(segment: PhaseSegment) -> str:
    """Name of a segment's stage, "" if unknown."""
    stage, attempt = _STAGE_OF_PHASE.get(segment.phase, ""), segment.attempt
    if not stage or attempt.goal is None:
        return ""
    if attempt.end == "misplaced" and stage in ("release", "retreat"):
        stage = "approach"
    return f"goal {attempt.goal + 1}: {stage}"


def proportions(episodes: Sequence[Sequence[StageRun]], stages: Sequence[str]) -> dict[str, float]:
    """Stage -> mean share of an episode's time, over the episodes that have it; the shares sum to one."""
    shares: dict[str, list[float]] = {stage: [] for stage in stages}
    for runs in episodes:
        lengths = dict.fromkeys((run.stage for run in runs), 0)
        for run in runs:
            lengths[run.stage] += run.last - run.first + 1
        total = sum(lengths.values())
        for stage in shares.keys() & lengths.keys():
            shares[stage].append(lengths[stage] / total)
    means = {stage: float(np.mean(found)) if found else 0.0 for stage, found in shares.items()}
    whole = sum(means.values())
    return {stage: mean / whole if whole else 0.0 for stage, mean in means.items()}


def progress(runs: Sequence[StageRun], stages: Sequence[str], share: Mapping[str, float]) -> Array:
    """(T,) progress in 0..1: the sum of the preceding stages' shares, plus a linear increase within the stage.

    Args:
        runs: Runs of one episode, in order, without gaps.
        stages: Stages of this episode, in intended order.
        share: Stage -> share of the whole.
    """
    weights = np.array([share.get(stage, 0.0) for stage in stages])
    total = float(weights.sum())
    bounds = np.concatenate([[0.0], np.cumsum(weights / total if total else np.full(len(stages), 1 / len(stages)))])
    found = np.empty(runs[-1].last + 1)
    for run in runs:
        index = stages.index(run.stage)
        length = run.last - run.first
        within = np.arange(length + 1) / length if length else np.ones(1)
        found[run.first : run.last + 1] = bounds[index] + within * (bounds[index + 1] - bounds[index])
    return np.clip(found, 0.0, 1.0)
