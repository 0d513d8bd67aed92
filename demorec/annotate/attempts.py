"""Timeline of an episode: segments of one phase, grouped into attempts at goals."""

from __future__ import annotations

import re
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Literal

import numpy as np

from demorec.core.geometry import Pose
from demorec.episode.episode import Trajectory
from demorec.episode.scene import Goal, Scene

if TYPE_CHECKING:
    from demorec.mcap import Recording

AttemptEnd = Literal["placed", "missed", "dropped", "misplaced", "unfinished"]
_FAILURES: dict[str, AttemptEnd] = {"miss": "missed", "drop": "dropped"}
_MAX_PLACED_DISTANCE_M = 0.02
"""Maximum distance of an object from its goal after the last attempt to count as placed."""


@dataclass(frozen=True, kw_only=True)
class GoalAttempt:
    """One attempt at a goal.

    Attributes:
        first: Its first frame.
        goal: Index of the goal, None if the scene has no such goal.
        number: 0 for the first attempt at this goal.
        is_deliberate_miss: Whether it misses on purpose.
        end: How it ended.
    """

    first: int
    goal: int | None
    number: int = 0
    is_deliberate_miss: bool = False
    end: AttemptEnd = "unfinished"


@dataclass(frozen=True, kw_only=True)
class PhaseSegment:
    """Frames of one phase within one attempt.

    Attributes:
        first, end: The first frame, and the one after the last.
        phase: As recorded; "" if missing.
        attempt: Enclosing attempt.
        is_deliberate_miss: Whether these frames are part of a deliberate miss.
    """

    first: int
    end: int
    phase: str
    attempt: GoalAttempt
    is_deliberate_miss: bool


@dataclass(frozen=True, kw_only=True, eq=False)
class EpisodeTimeline:
    """Timeline of a whole episode.

    Attributes:
        attempts: In order of time.
        segments: In order of time; every frame is in exactly one.
    """

    attempts: tuple[GoalAttempt, ...]
    segments: tuple[PhaseSegment, ...]

    @property
    def is_dropped(self) -> bool:
        """Whether objects are released from a height, i.e. no phase lowers them."""
        phases = {segment.phase for segment in self.segments}
        return "release" in phases and "lower" not in phases and "carry" in phases


def episode_timeline(recording: Recording) -> EpisodeTimeline:
    """Return attempts and segments of a recording.

    An attempt begins when the script announces a grasp; a recording without such events is one attempt at its only
    goal.

    Raises:
        RecordingError: The recording is damaged.
    """
    trajectory = recording.trajectory()
    attempts = _attempts(recording, trajectory, recording.info.simulated.scene)
    starts = [attempt.first for attempt in attempts]
    phases = trajectory.phase
    first = sorted({0, *starts, *(t for t in range(1, len(phases)) if phases[t] != phases[t - 1])})
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
    return EpisodeTimeline(attempts=tuple(attempts), segments=tuple(segments))


def _attempts(recording: Recording, trajectory: Trajectory, scene: Scene) -> list[GoalAttempt]:
    attempts: list[GoalAttempt] = []
    for time_ns, event in recording.events():
        frame = int(np.searchsorted(trajectory.time_ns, time_ns))
        if event.name == "grasp" and (match := re.match(r"grasp (\S+) at yaw", event.message)):
            attempts.append(_next_attempt(attempts, match[1], frame, scene.goals))
        elif attempts and event.name in _FAILURES:
            attempts[-1] = replace(
                attempts[-1],
                end=_FAILURES[event.name],
                is_deliberate_miss=event.name == "miss" and event.message.endswith("on purpose"),
            )
        elif attempts and event.name.startswith("misplaced"):
            attempts[-1] = replace(attempts[-1], end="misplaced")
    if not attempts:
        attempts = [GoalAttempt(first=0, goal=0 if len(scene.goals) == 1 else None)]
    last = attempts[-1]
    if last.end == "unfinished" and "release" in trajectory.phase[last.first :]:
        is_placed = last.goal is None or _is_at_goal(scene.goals[last.goal], scene, trajectory)
        attempts[-1] = replace(last, end="placed" if is_placed else "misplaced")
    return attempts


def _next_attempt(attempts: list[GoalAttempt], name: str, frame: int, goals: Sequence[Goal]) -> GoalAttempt:
    """Return the attempt that begins with a new grasp; close the previous one."""
    if not attempts:
        return GoalAttempt(first=frame, goal=_goal_of(name, goals, 0))
    before = attempts[-1]
    if before.end == "unfinished":  # no failure was recorded, so the script continued with the next goal
        before = attempts[-1] = replace(before, end="placed")
    if before.end == "placed":
        return GoalAttempt(first=frame, goal=_goal_of(name, goals, 0 if before.goal is None else before.goal + 1))
    return GoalAttempt(first=frame, goal=before.goal, number=before.number + 1)


def _goal_of(name: str, goals: Sequence[Goal], first: int) -> int | None:
    """Return the first goal from index `first` for an object with that name."""
    return next((index for index in range(first, len(goals)) if goals[index].object == name), None)


def _is_at_goal(goal: Goal, scene: Scene, trajectory: Trajectory) -> bool:
    """Whether the object is at its goal in the last frame, seen from above."""
    ends = {
        name: Pose(position=poses[-1, :3], quat_xyzw=poses[-1, 3:]) for name, poses in trajectory.object_poses.items()
    }
    if goal.object not in ends:
        return False
    onto = ends[goal.onto] if goal.onto in ends else scene.body(goal.onto).world_from_body if goal.onto else Pose()
    return goal.distance(onto, ends[goal.object]) <= _MAX_PLACED_DISTANCE_M
