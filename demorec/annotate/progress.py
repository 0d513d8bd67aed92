"""Progress within an episode: SARM's stages (arXiv 2509.25358), from the script's true phases.

A stage is one phase for one goal. Frames that undo progress belong to the stage to be repeated: after a miss, a drop or
a bad placement the next approach begins, so that progress falls back.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from demorec.core.geometry import Array
from demorec.episode.episode import consecutive_runs

if TYPE_CHECKING:
    from demorec.annotate.attempts import EpisodeTimeline, PhaseSegment

_STAGES = ("approach", "descend", "close", "lift", "transport", "lower", "release", "retreat")
_ALSO = {
    "open": "approach",
    "above_cube": "approach",
    "hold": "lift",
    "carry": "transport",
    "recover": "approach",
}
"""The tutorial's names for the same stages, and the stages to repeat after a failure."""
WHOLE_TASK = "task"
"""The only stage of an episode with unknown phases."""


@dataclass(frozen=True, kw_only=True)
class StageRun:
    """Consecutive rows of one stage.

    Attributes:
        stage: Its name, "goal 1: approach".
        first, last: Rows of the episode, both included.
    """

    stage: str
    first: int
    last: int


def dense_stages(num_goals: int, runs: Sequence[StageRun]) -> tuple[str, ...]:
    """Return all stages of an episode with this number of goals, in order, without those that a script leaves out."""
    if runs[0].stage == WHOLE_TASK:
        return (WHOLE_TASK,)
    done = {run.stage.partition(": ")[2] for run in runs}
    is_whole = "release" in done  # otherwise the episode failed before the last stages
    stages = [stage for stage in _STAGES if stage in done or not is_whole]
    return tuple(f"goal {goal}: {stage}" for goal in range(1, num_goals + 1) for stage in stages)


def dense_runs(timeline: EpisodeTimeline, rows: NDArray[np.intp]) -> list[StageRun]:
    """Return the stages of an episode's rows, in order of time; a single stage if the phases are not those of demorec's
    skills.

    Args:
        timeline: Timeline of the recording.
        rows: (T,) recorded frame of each dataset row.
    """
    names = [_stage_of(segment) for segment in timeline.segments]
    if not all(names):
        return [StageRun(stage=WHOLE_TASK, first=0, last=len(rows) - 1)]
    starts = [segment.first for segment in timeline.segments]
    numbers = np.searchsorted(starts, rows, side="right") - 1
    stages = [names[number] for number in numbers.tolist()]
    return [StageRun(stage=name, first=first, last=end - 1) for name, first, end in consecutive_runs(stages)]


def _stage_of(segment: PhaseSegment) -> str:
    """Name of a segment's stage, "" if unknown."""
    phase, attempt = _ALSO.get(segment.phase, segment.phase), segment.attempt
    if phase not in _STAGES or attempt.goal is None:
        return ""
    if attempt.end == "misplaced" and phase in ("release", "retreat"):
        phase = "approach"
    return f"goal {attempt.goal + 1}: {phase}"


def proportions(episodes: Sequence[Sequence[StageRun]], stages: Sequence[str]) -> dict[str, float]:
    """Stage -> mean share of an episode's time, over the episodes that have it; the shares sum to one."""
    shares: dict[str, list[float]] = {stage: [] for stage in stages}
    for runs in episodes:
        total = sum(run.last - run.first + 1 for run in runs)
        for stage, group in groupby(sorted(runs, key=lambda run: run.stage), key=lambda run: run.stage):
            if stage in shares:
                shares[stage].append(sum(run.last - run.first + 1 for run in group) / total)
    means = {stage: float(np.mean(found)) if found else 0.0 for stage, found in shares.items()}
    whole = sum(means.values())
    return {stage: mean / whole if whole else 0.0 for stage, mean in means.items()}


def progress(runs: Sequence[StageRun], stages: Sequence[str], share: dict[str, float]) -> Array:
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
