"""Timeline of an episode: segments of one phase, grouped into attempts at goals."""

from __future__ import annotations

import re
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal, NamedTuple

import numpy as np

from demorec.core.geometry import Pose
from demorec.episode.episode import Trajectory, consecutive_runs
from demorec.episode.scene import Goal, Scene
from demorec.mcap import Recording

AttemptEnd = Literal["placed", "missed", "dropped", "misplaced", "unfinished"]
_FAILURES: Mapping[str, AttemptEnd] = {"miss": "missed", "drop": "dropped", "misplaced": "misplaced"}
_MAX_PLACED_DISTANCE_M = 0.02
"""Maximum distance of an object from its goal after the last attempt to count as placed."""


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
