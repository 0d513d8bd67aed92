"""What an episode is made of: stretches of one phase, the tries at the goals that they belong to, and corrections."""

from __future__ import annotations

import re
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Literal

import numpy as np

from demorec.annotate.referring import phrases_for
from demorec.annotate.situation import Surroundings
from demorec.core.geometry import Pose
from demorec.episode.episode import INTERJECTION_EVENT, Columns
from demorec.episode.scene import Goal, Scene

if TYPE_CHECKING:
    from demorec.mcap import Recording

_SAID = (
    "No, {wanted} is meant.",
    "Stop, take {wanted}.",
    "Wait, I want {wanted}.",
    "Not that one: {wanted}, please.",
)
_SAID_OF_BOTH = (
    "No, not {mistaken}: {wanted}.",
    "Stop, that is {mistaken}. Take {wanted}.",
    "Leave {mistaken} alone, I want {wanted}.",
    "Wait, {wanted} is meant, not {mistaken}.",
)
_ANSWERED = (
    "Sorry, I will take {wanted}.",
    "All right, {wanted}.",
    "I see: {wanted}.",
    "Of course, {wanted}.",
)


@dataclass(frozen=True, kw_only=True)
class Correction:
    """An interjection of a recording.

    Attributes:
        frame: At which it comes.
        wanted, mistaken: Names of the thing that is meant, and of the one that the expert went for.
    """

    frame: int
    wanted: str
    mistaken: str


def correction_of(recording: Recording, columns: Columns) -> Correction | None:
    """The interjection of a recording; None without one.

    Raises:
        RecordingError: It is damaged.
    """
    names = {body.name for body in recording.info.scene.bodies}
    for time_ns, event in recording.events():
        match = re.fullmatch(r"(\S+) is meant, not (\S+)", event.message)
        if event.name == INTERJECTION_EVENT and match and {match[1], match[2]} <= names:
            frame = int(np.searchsorted(columns.time_ns, time_ns))
            return Correction(frame=frame, wanted=match[1], mistaken=match[2])
    return None


def interjection(correction: Correction, now: Surroundings, rng: np.random.Generator) -> tuple[str, str] | None:
    """What the user says and what is answered; None where no words mean the wanted thing alone."""
    wanted, mistaken = (next(phrases_for(name, now), "") for name in (correction.wanted, correction.mistaken))
    if not wanted:
        return None
    forms = (*_SAID, *_SAID_OF_BOTH) if mistaken else _SAID
    said, answered = forms[int(rng.integers(len(forms)))], _ANSWERED[int(rng.integers(len(_ANSWERED)))]
    return said.format(wanted=wanted, mistaken=mistaken), answered.format(wanted=wanted)


TryEnd = Literal["placed", "missed", "dropped", "misplaced", "unfinished"]
_TROUBLE: dict[str, TryEnd] = {"miss": "missed", "drop": "dropped"}
_NEAR_ENOUGH = 0.02
"""How far, metres, an object may lie from its goal after the last try to count as placed."""


@dataclass(frozen=True, kw_only=True)
class Try:
    """One try to serve a goal.

    Attributes:
        first: Its first frame.
        goal: Index of the goal, None when it is none of the scene's.
        number: 0 for the first try at this goal.
        is_deliberate_miss: Whether it misses on purpose.
        end: What came of it.
    """

    first: int
    goal: int | None
    number: int = 0
    is_deliberate_miss: bool = False
    end: TryEnd = "unfinished"


@dataclass(frozen=True, kw_only=True)
class Stretch:
    """Frames of one phase within one try.

    Attributes:
        first, end: The first frame, and the one after the last.
        phase: As recorded; "" where there is none.
        attempt: The try that it belongs to.
        is_deliberate_miss: Whether these frames are part of a deliberate miss.
    """

    first: int
    end: int
    phase: str
    attempt: Try
    is_deliberate_miss: bool


@dataclass(frozen=True, kw_only=True, eq=False)
class Story:
    """A whole episode.

    Attributes:
        tries: In order of time.
        stretches: In order of time; every frame is in exactly one.
        correction: The interjection, if there is one: it comes before all tries.
    """

    tries: tuple[Try, ...]
    stretches: tuple[Stretch, ...]
    correction: Correction | None = None

    @property
    def is_dropped(self) -> bool:
        """Whether objects are let go without having been lowered, as no phase of the script says."""
        phases = {stretch.phase for stretch in self.stretches}
        return "release" in phases and "lower" not in phases and "carry" in phases


def story_of(recording: Recording, columns: Columns) -> Story:
    """Tries and stretches of a recording.

    A try begins where the script announced a grasp; a recording without such events is one try at its only goal.

    Raises:
        RecordingError: It is damaged.
    """
    scene = recording.info.scene
    tries = _tries(recording, columns, scene)
    starts = [attempt.first for attempt in tries]
    phases = columns.phase
    first = sorted({0, *starts, *(t for t in range(1, len(phases)) if phases[t] != phases[t - 1])})
    stretches = [
        Stretch(
            first=start,
            end=end,
            phase=phases[start],
            attempt=tries[max(0, bisect_right(starts, start) - 1)],
            is_deliberate_miss=bool(columns.is_deliberate_miss[start:end].any()),
        )
        for start, end in pairwise([*first, len(phases)])
    ]
    return Story(tries=tuple(tries), stretches=tuple(stretches), correction=correction_of(recording, columns))


def _tries(recording: Recording, columns: Columns, scene: Scene) -> list[Try]:
    tries: list[Try] = []
    for time_ns, event in recording.events():
        frame = int(np.searchsorted(columns.time_ns, time_ns))
        if event.name == "grasp" and (match := re.match(r"grasp (\S+) at yaw", event.message)):
            tries.append(_next_try(tries, match[1], frame, scene.goals))
        elif tries and event.name in _TROUBLE:
            tries[-1] = replace(
                tries[-1],
                end=_TROUBLE[event.name],
                is_deliberate_miss=event.name == "miss" and event.message.endswith("on purpose"),
            )
        elif tries and event.name.startswith("misplaced"):
            tries[-1] = replace(tries[-1], end="misplaced")
    if not tries:
        tries = [Try(first=0, goal=0 if len(scene.goals) == 1 else None)]
    if tries[-1].end == "unfinished" and "release" in columns.phase[tries[-1].first :]:
        lies_well = tries[-1].goal is None or _lies_at(scene.goals[tries[-1].goal], scene, columns)
        tries[-1] = replace(tries[-1], end="placed" if lies_well else "misplaced")
    return tries


def _next_try(tries: list[Try], name: str, frame: int, goals: Sequence[Goal]) -> Try:
    """The try that a new grasp begins; closes the one before it."""
    if not tries:
        return Try(first=frame, goal=_goal_of(name, goals, 0))
    before = tries[-1]
    if before.end == "unfinished":  # nothing was said of it, so the script went on to the next goal
        before = tries[-1] = replace(before, end="placed")
    if before.end == "placed":
        return Try(first=frame, goal=_goal_of(name, goals, 0 if before.goal is None else before.goal + 1))
    return Try(first=frame, goal=before.goal, number=before.number + 1)


def _goal_of(name: str, goals: Sequence[Goal], first: int) -> int | None:
    """The first goal from `first` on whose object has that name."""
    return next((index for index in range(first, len(goals)) if goals[index].object == name), None)


def _lies_at(goal: Goal, scene: Scene, columns: Columns) -> bool:
    """Whether the object is at its goal in the last frame, seen from above."""
    ends = {name: Pose(position=poses[-1, :3], quat_xyzw=poses[-1, 3:]) for name, poses in columns.object_poses.items()}
    if goal.object not in ends:
        return False
    onto = ends[goal.onto] if goal.onto in ends else scene.body(goal.onto).world_from_body if goal.onto else Pose()
    return goal.distance(onto, ends[goal.object]) <= _NEAR_ENOUGH
