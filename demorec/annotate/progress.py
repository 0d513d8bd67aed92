"""How far an episode has come: stages as SARM (arXiv 2509.25358) has them, from the true phases of the script.

A stage is one phase in the service of one goal. What undoes progress belongs to the stage that must be done again:
after a miss, a drop or a bad placement the next approach begins, so that progress falls back to where it was.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from demorec.core.geometry import Array
from demorec.episode.episode import CORRECTED_PHASE, MISTAKEN_PHASE

if TYPE_CHECKING:
    from demorec.annotate.tries import Story, Stretch

_STAGES = ("approach", "descend", "close", "lift", "transport", "lower", "release", "retreat")
_ALSO = {
    "open": "approach",
    "above_cube": "approach",
    "hold": "lift",
    "carry": "transport",
    "recover": "approach",
    MISTAKEN_PHASE: "approach",
    CORRECTED_PHASE: "approach",
}
"""The tutorial's words for the same, and what a failure or a correction leads back to."""
_PICK = ("approach", "descend", "close", "lift")
WHOLE_TASK = "task"
"""The only stage of an episode whose phases nobody knows."""


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
    """All stages of an episode with so many goals, in order; a script that lets things fall has fewer."""
    done = {run.stage.partition(": ")[2] for run in runs}
    is_dropped = "release" in done and "lower" not in done
    left_out = ("lower", "retreat") if is_dropped else ()
    stages = [stage for stage in _STAGES if stage not in left_out]
    return tuple(f"goal {goal}: {stage}" for goal in range(1, num_goals + 1) for stage in stages)


def sparse_stages(num_goals: int) -> tuple[str, ...]:
    """The same, a pick and a place for each goal."""
    return tuple(f"goal {goal}: {stage}" for goal in range(1, num_goals + 1) for stage in ("pick", "place"))


def dense_runs(story: Story, rows: NDArray[np.intp]) -> list[StageRun]:
    """The stages of an episode's rows, in order of time; one alone where the phases are not those of our skills.

    Args:
        story: Of the recording.
        rows: (T,) which of its frames the dataset has.
    """
    names = [_stage_of(stretch) for stretch in story.stretches]
    if not all(names):
        return [StageRun(stage=WHOLE_TASK, first=0, last=len(rows) - 1)]
    starts = [stretch.first for stretch in story.stretches]
    numbers = np.searchsorted(starts, rows, side="right") - 1
    of_rows = [names[number] for number in numbers.tolist()]
    runs = []
    for name, group in groupby(range(len(rows)), key=lambda row: of_rows[row]):
        members = list(group)
        runs.append(StageRun(stage=name, first=members[0], last=members[-1]))
    return runs


def _stage_of(stretch: Stretch) -> str:
    """Name of the stage that a stretch belongs to, "" when nobody knows."""
    phase, attempt = _ALSO.get(stretch.phase, stretch.phase), stretch.attempt
    if phase not in _STAGES or attempt.goal is None:
        return ""
    if attempt.end == "misplaced" and phase in ("release", "retreat"):
        phase = "approach"
    return f"goal {attempt.goal + 1}: {phase}"


def sparse_runs(dense: Sequence[StageRun]) -> list[StageRun]:
    """The same rows in the stages of `sparse_stages`; a new try begins its pick anew."""
    found: list[StageRun] = []
    for run in dense:
        goal, _, phase = run.stage.partition(": ")
        stage = f"{goal}: {'pick' if phase in _PICK else 'place'}" if phase else run.stage
        if found and found[-1].stage == stage and phase != _STAGES[0]:
            found[-1] = replace(found[-1], last=run.last)
        else:
            found.append(replace(run, stage=stage))
    return found


def proportions(episodes: Sequence[Sequence[StageRun]], stages: Sequence[str]) -> dict[str, float]:
    """Stage -> mean share of it in the time of an episode, of those episodes that have it; they sum up to one."""
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
    """(T,) progress in 0..1: what the stages before take of the whole, and within a stage evenly over its rows.

    Args:
        runs: Of one episode, in order, without gaps.
        stages: Of this episode, in the order in which they shall be done.
        share: Stage -> its share of the whole.
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
