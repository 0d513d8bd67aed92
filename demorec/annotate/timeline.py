"""Timeline of an episode: segments of one phase, grouped into attempts at goals, and the progress that they make.

Progress has SARM's stages (arXiv 2509.25358): a stage is one phase for one goal. Frames that undo progress belong to
the stage to be repeated: after a miss, a drop or a bad placement the next approach begins, so progress falls back.
"""

from __future__ import annotations

import re
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from demorec.core.geometry import Array, Pose
from demorec.episode.episode import Trajectory, consecutive_runs
from demorec.episode.scene import Goal, Scene

if TYPE_CHECKING:
    from demorec.mcap import Recording

AttemptEnd = Literal["placed", "missed", "dropped", "misplaced", "unfinished"]
_FAILURES: Mapping[str, AttemptEnd] = {"miss": "missed", "drop": "dropped", "misplaced": "misplaced"}
_MAX_PLACED_DISTANCE_M = 0.02
"""Maximum distance of an object from its goal after the last attempt to count as placed."""
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


@dataclass(frozen=True, kw_only=True)
class GoalAttempt:
    """One attempt at a goal."""

    first: int
    goal: int | None  # index of the goal, None if the scene has no such goal
    number: int = 0  # 0 for the first attempt at this goal
    is_deliberate_miss: bool = False
    end: AttemptEnd = "unfinished"


class PhaseSegment(NamedTuple):
    """Frames `first` to `end` - 1 of one recorded phase, "" if missing, within one attempt."""

    first: int
    end: int
    phase: str
    attempt: GoalAttempt
    is_deliberate_miss: bool


class EpisodeTimeline(NamedTuple):
    """Attempts and segments in order of time; every frame is in exactly one segment."""

    attempts: Sequence[GoalAttempt]
    segments: Sequence[PhaseSegment]

    @property
    def is_dropped(self) -> bool:
        """Whether objects are released from a height, i.e. no phase lowers them."""
        phases = {segment.phase for segment in self.segments}
        return "release" in phases and "lower" not in phases and "carry" in phases


def episode_timeline(recording: Recording) -> EpisodeTimeline:
    """Return attempts and segments of a recording.

    An attempt begins when the script announces a grasp; a recording without such events is one attempt at its only
    goal.
    """
    trajectory = recording.trajectory()
    attempts = _attempts(recording, trajectory, recording.info.simulated.scene)
    starts = [attempt.first for attempt in attempts]
    phases = trajectory.phase
    first = sorted({0, *starts, *(start for _, start, _ in consecutive_runs(phases))})
    segments = [
        PhaseSegment(
            first=start,
            end=end,
            phase=phases[start],
            attempt=attempts[max(0, bisect_right(starts, start) - 1)],
            is_deliberate_miss=bool(trajectory.is_deliberate_miss[start:end].any()),
        )
        for start, end in pairwise([*first, len(phases)])
    ]
    return EpisodeTimeline(attempts, segments)


def _attempts(recording: Recording, trajectory: Trajectory, scene: Scene) -> list[GoalAttempt]:
    attempts: list[GoalAttempt] = []
    for time_ns, event in recording.events():
        if event.name == "grasp" and (match := re.match(r"grasp (\S+) at yaw", event.message)):
            frame = int(np.searchsorted(trajectory.time_ns, time_ns))
            if attempts and attempts[-1].end == "unfinished":  # no failure was recorded, so the next goal follows
                attempts[-1] = replace(attempts[-1], end="placed")
            attempts.append(_next_attempt(attempts, match[1], frame, scene.goals))
        elif attempts and (end := _FAILURES.get(event.name.partition("_")[0])):
            is_deliberate = end == "missed" and event.message.endswith("on purpose")
            attempts[-1] = replace(attempts[-1], end=end, is_deliberate_miss=is_deliberate)
    if not attempts:
        attempts = [GoalAttempt(first=0, goal=0 if len(scene.goals) == 1 else None)]
    last = attempts[-1]
    if last.end == "unfinished" and "release" in trajectory.phase[last.first :]:
        is_placed = last.goal is None or _is_at_goal(scene.goals[last.goal], scene, trajectory)
        attempts[-1] = replace(last, end="placed" if is_placed else "misplaced")
    return attempts


def _next_attempt(attempts: Sequence[GoalAttempt], name: str, frame: int, goals: Sequence[Goal]) -> GoalAttempt:
    """Return the attempt that begins with a new grasp: at the same goal after a failure, else at the object's next."""
    before = attempts[-1] if attempts else None
    if before and before.end != "placed":
        return GoalAttempt(first=frame, goal=before.goal, number=before.number + 1)
    start = 0 if before is None or before.goal is None else before.goal + 1
    goal = next((index for index in range(start, len(goals)) if goals[index].object == name), None)
    return GoalAttempt(first=frame, goal=goal)


def _is_at_goal(goal: Goal, scene: Scene, trajectory: Trajectory) -> bool:
    """Whether the object is at its goal in the last frame, seen from above."""
    ends = {body.name: body.world_from_body for body in scene.bodies} | {
        name: Pose(position=poses[-1, :3], quat_xyzw=poses[-1, 3:]) for name, poses in trajectory.object_poses.items()
    }
    return goal.distance(ends.get(goal.onto, Pose()), ends[goal.object]) <= _MAX_PLACED_DISTANCE_M


class StageRun(NamedTuple):
    """Rows `first` to `last` of an episode, both included, in one stage, such as "goal 1: approach"."""

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


def dense_runs(timeline: EpisodeTimeline) -> list[StageRun]:
    """Return the stages of an episode, in order of time; a single stage if the phases are not those of demorec's
    skills.
    """
    names = [_stage_name(segment) for segment in timeline.segments]
    if not all(names):
        return [StageRun(WHOLE_TASK, 0, timeline.segments[-1].end - 1)]
    stages: list[str] = []
    for segment, name in zip(timeline.segments, names, strict=True):
        stages += [name] * (segment.end - segment.first)
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
