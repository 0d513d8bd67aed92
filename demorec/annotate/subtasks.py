"""Sentences for phase segments and goals: subtask, plan, memory, motion."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from demorec.annotate.attempts import EpisodeTimeline, GoalAttempt, PhaseSegment
from demorec.annotate.referring import Surroundings, phrase_for, place_of
from demorec.core.geometry import Array
from demorec.episode.scene import Scene
from demorec.episode.words import VESSELS, nouns_of

_SENTENCES = {
    "open": "open the gripper",
    "approach": "move above {object}",
    "above_cube": "move above {object}",
    "descend": "lower the open gripper around {object}",
    "close": "grasp {object}",
    "lift": "lift {object}",
    "hold": "lift {object}",
    "transport": "carry {object} to {place}",
    "carry": "carry {object} over {place}",
    "lower": "lower {object} {into} {place}",
    "release": "let go of {object}",
    "retreat": "move away from {object}",
}
_MISSING = {
    "approach": "move beside {object}, to miss it on purpose",
    "descend": "lower the open gripper beside {object}, to miss it on purpose",
    "close": "close the gripper beside {object}, missing it on purpose",
    "lift": "lift the empty gripper, having missed {object} on purpose",
}
_AGAIN = ("approach", "descend", "close")
"""Phases of a later attempt in which the subtask begins with "try again"."""
_RECOVERY = {
    "missed": "open the gripper and rise after missing {object}",
    "dropped": "open the gripper and rise after dropping {object}",
}
# Half of the last printed digit.
_MIN_MOVE_M = 0.005
_MIN_OPENING_CHANGE_M = 0.0025


@dataclass(frozen=True, kw_only=True)
class GoalWords:
    """Words for the objects of one goal during an attempt.

    Attributes:
        object: "the red cube".
        place: "the blue tray", or "its place" if the scene has no object there.
        into: "into", "onto" or "to": preposition before the place.
        inside: "in", "on" or "at": final position relative to the place.
    """

    object: str
    place: str
    into: str
    inside: str


def goal_words(scene: Scene, goal_index: int | None, now: Surroundings) -> GoalWords:
    """Phrases that distinguish a goal's object and place from all other objects at this moment."""
    if goal_index is None:
        return GoalWords(object="the object", place="its place", into="to", inside="at")
    goal = scene.goals[goal_index]
    name = place_of(scene, goal)
    into, inside = prepositions(scene, name)
    return GoalWords(
        object=phrase_for(goal.object, now),
        place=phrase_for(name, now) if name else "its place",
        into=into,
        inside=inside,
    )


def prepositions(scene: Scene, place: str) -> tuple[str, str]:
    """("into", "in") for a container, ("to", "at") for a place without an object, ("onto", "on") otherwise."""
    if not place:
        return "to", "at"
    return ("into", "in") if nouns_of(scene.body(place))[0] in VESSELS else ("onto", "on")


def subtask(segment: PhaseSegment, words: GoalWords, instruction: str, *, is_dropped: bool) -> str:
    """Return the imperative for a segment; the instruction if the recording has no phases."""
    phase, attempt = segment.phase, segment.attempt
    if phase == "recover":
        text = _RECOVERY.get(attempt.end, "open the gripper and rise")
        if attempt.is_deliberate_miss:
            text += " on purpose"
    elif segment.is_deliberate_miss and phase in _MISSING:
        text = _MISSING[phase]
    elif phase == "release" and is_dropped:
        text = "drop {object} {into} {place}"
    else:
        text = _SENTENCES.get(phase, phase.replace("_", " ") or instruction)
        if attempt.number > 0 and phase in _AGAIN:
            text = f"try again: {text}"
    for field in ("object", "place", "into"):
        text = text.replace(f"{{{field}}}", getattr(words, field))
    return text


def plan(goals: Sequence[GoalWords], *, is_dropped: bool, is_retry: bool) -> str:
    """Return a numbered list of the remaining actions."""
    lines = []
    for index, words in enumerate(goals):
        again = " again" if is_retry and index == 0 else ""
        lines.append(f"pick up {words.object}{again}")
        verb = "drop" if is_dropped else "put"
        lines.append(f"{verb} it {words.into} {words.place}" if words.into != "to" else "put it in its place")
    return "\n".join(f"{number}. {line}" for number, line in enumerate(lines, start=1))


def memories(timeline: EpisodeTimeline, words: dict[int, GoalWords], *, is_dropped: bool) -> Iterator[tuple[int, str]]:
    """Yield (first frame, text) of the actions done by then, in the first person.

    Args:
        timeline: Timeline of the episode.
        words: First frame of an attempt -> words for its objects.
        is_dropped: Whether objects are released from a height.
    """
    done: list[str] = []
    for before, segment in zip((None, *timeline.segments), timeline.segments, strict=False):
        attempt = segment.attempt
        spoken = words[attempt.first]
        present = ""
        if before is not None and before.attempt is attempt:
            if before.phase in ("lift", "hold") and segment.phase != "recover":
                present = f"I picked up {spoken.object}."
            elif before.phase == "release" and attempt.end == "placed":
                done.append(_placed(spoken, is_dropped=is_dropped))
            elif before.phase == "release" and attempt.end == "misplaced":
                present = f"I put {spoken.object} down in the wrong place."
            elif segment.phase == "recover":
                present = _failure(attempt, spoken)
            else:
                continue
            yield segment.first, " ".join([*done, *([present] if present else [])])


def _placed(words: GoalWords, *, is_dropped: bool) -> str:
    if words.into == "to":
        return f"I put {words.object} in its place."
    verb, where = ("dropped", words.into) if is_dropped else ("put", words.inside)
    return f"I {verb} {words.object} {where} {words.place}."


def _failure(attempt: GoalAttempt, words: GoalWords) -> str:
    verb = "dropped" if attempt.end == "dropped" else "missed"
    return f"I {verb} {words.object}{' on purpose' if attempt.is_deliberate_miss else ''}."


def motion(position: Array, opening: Array) -> str:
    """Describe the TCP displacement and the gripper motion between two moments, to whole centimetres.

    Args:
        position: (2, 3) TCP before and after, base frame (x forward, y left, z up), metres.
        opening: (2,) gripper opening before and after, metres.
    """
    parts = []
    for change, positive, negative in zip(
        (position[1] - position[0]).tolist(), ("forward", "left", "up"), ("backward", "right", "down"), strict=True
    ):
        centimetres = round(abs(change) * 100)
        if abs(change) >= _MIN_MOVE_M and centimetres:
            parts.append((centimetres, positive if change > 0 else negative))
    parts.sort(key=lambda part: -part[0])
    said = [f"{centimetres} cm {direction}" for centimetres, direction in parts]
    sentences = [f"move {joined(said)}"] if said else []
    change = float(opening[1]) - float(opening[0])
    if abs(change) >= _MIN_OPENING_CHANGE_M:
        verb = "open" if change > 0 else "close"
        sentences.append(f"{verb} the gripper by {max(0.5, round(abs(change) * 200) / 2):g} cm")
    return ", ".join(sentences) or "hold still"


def joined(parts: Sequence[str]) -> str:
    """Join words as "a", "a and b", "a, b and c"."""
    return parts[0] if len(parts) == 1 else f"{', '.join(parts[:-1])} and {parts[-1]}"
