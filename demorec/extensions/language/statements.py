"""All statements about one recording, row by row, as in a language column: subtask, plan, memory, motion, wordings."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from itertools import pairwise

from demorec.core.geometry import Array
from demorec.core.seeding import generator
from demorec.datasets.lerobot.language import Statement
from demorec.extensions.language.referring import joined, phrase_for, place_of, prepositions, situation
from demorec.extensions.language.timeline import PhaseSegment, episode_timeline
from demorec.extensions.language.wordings import task_wordings
from demorec.mcap import Recording

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


def episode_statements(recording: Recording, kinds: Collection[str]) -> list[Statement]:
    """Return the statements of the requested kinds, kind by kind. Raises RecordingError if the recording is damaged."""
    narrator = _Narrator(recording)
    sentences = {
        "subtask": narrator.subtasks,
        "plan": narrator.plans,
        "memory": narrator.memories,
        "motion": narrator.motions,
        "task_aug": narrator.wordings,
    }
    return [Statement(row, kind, text) for kind, said in sentences.items() if kind in kinds for row, text in said()]


class _Narrator:
    """The sentences of one episode, kind by kind, each with its row."""

    def __init__(self, recording: Recording) -> None:
        self._info, self._trajectory = recording.info, recording.trajectory()
        self._num_frames = recording.num_frames
        self._scene = recording.info.simulated.scene
        self._timeline = episode_timeline(recording)
        self._is_dropped = self._timeline.is_dropped
        self._words = {
            attempt.first: self._goal_words(attempt.goal, attempt.first) for attempt in self._timeline.attempts
        }

    def _goal_words(self, goal_index: int | None, frame: int) -> dict[str, str]:
        """Return phrases that distinguish a goal's "object" and "place" from all other objects at a frame, and the
        prepositions "into" ("into", "onto" or "to") and "inside" ("in", "on" or "at").
        """
        if goal_index is None:
            return {"object": "the object", "place": "its place", "into": "to", "inside": "at"}
        goal = self._scene.goals[goal_index]
        poses: dict[str, Array] = {name: values[frame] for name, values in self._trajectory.object_poses.items()}
        now, name = situation(self._scene, poses), place_of(self._scene, goal)
        into, inside = prepositions(self._scene, name)
        place = phrase_for(name, now) if name else "its place"
        return {"object": phrase_for(goal.object, now), "place": place, "into": into, "inside": inside}

    def subtasks(self) -> Iterator[tuple[int, str]]:
        for segment in self._timeline.segments:
            yield segment.first, self._subtask(segment)

    def _subtask(self, segment: PhaseSegment) -> str:
        """Return the imperative for a segment; the instruction if the recording has no phases."""
        phase, attempt = segment.phase, segment.attempt
        if phase == "recover":
            text = _RECOVERY.get(attempt.end, "open the gripper and rise")
            text += " on purpose" if attempt.is_deliberate_miss else ""
        elif segment.is_deliberate_miss and phase in _MISSING:
            text = _MISSING[phase]
        elif phase == "release" and self._is_dropped:
            text = "drop {object} {into} {place}"
        elif phase in _SENTENCES:
            is_again = attempt.number > 0 and phase in _AGAIN
            text = f"try again: {_SENTENCES[phase]}" if is_again else _SENTENCES[phase]
        else:
            return phase.replace("_", " ") or self._info.instruction
        return text.format(**self._words[attempt.first])

    def plans(self) -> Iterator[tuple[int, str]]:
        """Yield numbered lists of the remaining actions, at the start and at each repeated attempt."""
        for index, attempt in enumerate(self._timeline.attempts):
            row = 0 if index == 0 else attempt.first
            is_new_goal = index > 0 and attempt.number == 0
            if attempt.goal is None or is_new_goal:
                continue
            actions: list[str] = []
            for goal in range(attempt.goal, len(self._scene.goals)):
                words = self._goal_words(goal, attempt.first)
                again = " again" if attempt.number > 0 and not actions else ""
                put = f"{'drop' if self._is_dropped else 'put'} it {words['into']} {words['place']}"
                actions += [
                    f"pick up {words['object']}{again}",
                    "put it in its place" if words["into"] == "to" else put,
                ]
            yield row, "\n".join(f"{number}. {action}" for number, action in enumerate(actions, start=1))

    def memories(self) -> Iterator[tuple[int, str]]:
        """Yield the actions done so far, in the first person."""
        done: list[str] = []
        for before, segment in pairwise(self._timeline.segments):
            if before.attempt is not segment.attempt:
                continue
            deed = self._deed(before, segment)
            if deed:
                yield segment.first, " ".join([*done, deed])
            if before.phase == "release" and segment.attempt.end == "placed":
                done.append(deed)

    def _deed(self, before: PhaseSegment, segment: PhaseSegment) -> str:
        """Return the deed done when one segment of an attempt follows another; "" for none."""
        attempt, words = segment.attempt, self._words[segment.attempt.first]
        object_ = words["object"]
        if before.phase in ("lift", "hold") and segment.phase != "recover":
            return f"I picked up {object_}."
        if before.phase == "release" and attempt.end == "placed":
            verb, where = ("dropped", words["into"]) if self._is_dropped else ("put", words["inside"])
            has_place = words["into"] != "to"
            return f"I {verb} {object_} {where} {words['place']}." if has_place else f"I put {object_} in its place."
        if before.phase == "release" and attempt.end == "misplaced":
            return f"I put {object_} down in the wrong place."
        if segment.phase == "recover":
            verb = "dropped" if attempt.end == "dropped" else "missed"
            return f"I {verb} {object_}{' on purpose' if attempt.is_deliberate_miss else ''}."
        return ""

    def motions(self) -> Iterator[tuple[int, str]]:
        trajectory = self._trajectory
        for segment in self._timeline.segments:
            frames = [segment.first, min(segment.end, self._num_frames - 1)]
            yield segment.first, _motion(trajectory.base_from_tcp[frames, :3], trajectory.gripper_width[frames])

    def wordings(self) -> Iterator[tuple[int, str]]:
        info = self._info
        seed = info.simulated.root_seed
        rng = generator(root_seed=seed, episode_index=info.episode_index, attempt=info.attempt, purpose="language")
        for text in task_wordings(self._scene, info.instruction, rng, is_dropped=self._is_dropped):
            yield 0, text


def _motion(position: Array, opening: Array) -> str:
    """Describe, to whole centimetres, the displacement of the TCP (2, 3) in the base frame, metres, and of the gripper
    opening (2,), metres, between two moments.
    """
    parts = []
    directions = ("forward", "backward"), ("left", "right"), ("up", "down")
    for change, (positive, negative) in zip((position[1] - position[0]).tolist(), directions, strict=True):
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
