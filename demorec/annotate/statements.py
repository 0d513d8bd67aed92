"""All statements about one recording, row by row, as in a language column."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator

import numpy as np
from numpy.typing import NDArray

from demorec.annotate import KINDS, LanguageKind, Statement
from demorec.annotate.attempts import PhaseSegment, episode_timeline
from demorec.annotate.referring import Surroundings, situation
from demorec.annotate.subtasks import goal_words, memories, motion, plan, subtask
from demorec.annotate.wordings import task_wordings
from demorec.core.geometry import Array
from demorec.core.seeding import generator
from demorec.mcap import Recording


def episode_statements(
    recording: Recording, rows: NDArray[np.intp], kinds: Collection[LanguageKind]
) -> list[Statement]:
    """Return the statements of the requested kinds in row order; within a row, in the order of `KINDS`.

    Args:
        recording: Recording with its events.
        rows: (T,) recorded frame of each dataset row.
        kinds: Requested kinds; those that the recording does not support are left out.

    Raises:
        RecordingError: The recording is damaged.
    """
    annotator = _Annotator(recording, rows)
    found: dict[LanguageKind, Callable[[], Iterator[Statement]]] = {
        "subtask": annotator.subtasks,
        "plan": annotator.plans,
        "memory": annotator.memories,
        "motion": annotator.motions,
        "task_aug": annotator.wordings,
    }
    statements = [statement for kind in KINDS if kind in kinds for statement in found[kind]()]
    return sorted(statements, key=lambda statement: statement.row)


class _Annotator:
    """The sentences of one episode, kind by kind."""

    def __init__(self, recording: Recording, rows: NDArray[np.intp]) -> None:
        self._info, self._trajectory, self._rows = recording.info, recording.trajectory(), rows
        self._timeline = episode_timeline(recording)
        self._scene = recording.info.simulated.scene
        self._words = {
            attempt.first: goal_words(self._scene, attempt.goal, self._situation(attempt.first))
            for attempt in self._timeline.attempts
        }

    def _situation(self, frame: int) -> Surroundings:
        poses: dict[str, Array] = {name: values[frame] for name, values in self._trajectory.object_poses.items()}
        return situation(self._scene, poses)

    def _row_of(self, frame: int) -> int:
        """Return the first row at or after a frame; T if all are earlier."""
        return int(np.searchsorted(self._rows, frame))

    def _segment_rows(self) -> Iterator[tuple[PhaseSegment, int, int]]:
        """Yield (segment, first row, row after the last) of each segment that contains a row."""
        for segment in self._timeline.segments:
            first = self._row_of(segment.first)
            end = self._row_of(segment.end)
            if first < end:
                yield segment, first, end

    def subtasks(self) -> Iterator[Statement]:
        is_dropped = self._timeline.is_dropped
        for segment, first, _ in self._segment_rows():
            words = self._words[segment.attempt.first]
            text = subtask(segment, words, self._info.instruction, is_dropped=is_dropped)
            yield Statement(row=first, kind="subtask", text=text)

    def plans(self) -> Iterator[Statement]:
        for index, attempt in enumerate(self._timeline.attempts):
            if attempt.goal is None or (index > 0 and attempt.number == 0):
                continue
            row = 0 if index == 0 else self._row_of(attempt.first)
            if row < len(self._rows):
                now = self._situation(attempt.first)
                remaining = [goal_words(self._scene, goal, now) for goal in range(attempt.goal, len(self._scene.goals))]
                text = plan(remaining, is_dropped=self._timeline.is_dropped, is_retry=attempt.number > 0)
                yield Statement(row=row, kind="plan", text=text)

    def memories(self) -> Iterator[Statement]:
        latest: dict[int, Statement] = {}
        for frame, text in memories(self._timeline, self._words, is_dropped=self._timeline.is_dropped):
            row = self._row_of(frame)
            if row < len(self._rows):  # if two segments begin in one row, the later one applies
                latest[row] = Statement(row=row, kind="memory", text=text)
        yield from latest.values()

    def motions(self) -> Iterator[Statement]:
        trajectory, last = self._trajectory, self._rows[-1]
        for _, first, end in self._segment_rows():
            frames = [self._rows[first], self._rows[end] if end < len(self._rows) else last]
            text = motion(trajectory.base_from_tcp[frames, :3], trajectory.gripper_width[frames])
            yield Statement(row=first, kind="motion", text=text)

    def wordings(self) -> Iterator[Statement]:
        info = self._info
        rng = generator(
            root_seed=info.simulated.root_seed,
            episode_index=info.episode_index,
            attempt=info.attempt,
            purpose="language",
        )
        for text in task_wordings(self._scene, info.instruction, rng, is_dropped=self._timeline.is_dropped):
            yield Statement(row=0, kind="task_aug", text=text)
