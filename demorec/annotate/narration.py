"""All that is said about one recording, row by row as a language column wants it."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from demorec.annotate import KINDS, LanguageKind, Statement
from demorec.annotate.questions import questions, traces
from demorec.annotate.referring import phrase_for
from demorec.annotate.situation import Surroundings, situation
from demorec.annotate.subtasks import GoalWords, goal_words, memories, motion, plan, subtask
from demorec.annotate.tries import Story, Stretch, interjection, story_of
from demorec.annotate.wordings import task_wordings
from demorec.core.geometry import Array
from demorec.core.seeding import generator
from demorec.episode.episode import MISTAKEN_PHASE, Columns
from demorec.episode.scene import Scene
from demorec.mcap import Recording


def narrate(
    recording: Recording,
    columns: Columns,
    rows: NDArray[np.intp],
    kinds: Collection[LanguageKind],
    cameras: Sequence[str] = (),
    *,
    about: Collection[int] | None = None,
) -> list[Statement]:
    """Everything of the wanted kinds, in the order of the rows; kinds of one row in the order of `KINDS`.

    Args:
        recording: With its events.
        columns: All of its numbers.
        rows: (T,) which of its frames the dataset has.
        kinds: What shall be said, as far as the recording has it.
        cameras: Those whose images may be spoken of.
        about: The rows whose images are spoken of, None for all.

    Raises:
        RecordingError: The recording is damaged.
    """
    narrator = _Narrator(recording, columns, rows)
    stride = int(rows[1] - rows[0]) if len(rows) > 1 else 1
    a_second = range(0, len(rows), max(1, recording.info.fps // stride))
    asked = {row: turn for turn, row in enumerate(a_second) if about is None or row in about}
    found: dict[LanguageKind, Callable[[], Iterator[Statement]]] = {
        "subtask": narrator.subtasks,
        "plan": narrator.plans,
        "memory": narrator.memories,
        "motion": narrator.motions,
        "task_aug": narrator.wordings,
        "vqa": lambda: questions(recording, columns, rows, cameras, asked),
        "trace": lambda: traces(recording, columns, rows, cameras, asked),
        "interjection": narrator.interjections,
    }
    statements = [statement for kind in KINDS if kind in kinds for statement in found[kind]()]
    return sorted(statements, key=lambda statement: statement.row)


class _Narrator:
    """The sentences of one episode, kind by kind."""

    def __init__(self, recording: Recording, columns: Columns, rows: NDArray[np.intp]) -> None:
        self._info, self._columns, self._rows = recording.info, columns, rows
        self._story: Story = story_of(recording, columns)
        self._scene: Scene = recording.info.scene
        self._words = {
            attempt.first: goal_words(self._scene, attempt.goal, self._situation(attempt.first))
            for attempt in self._story.tries
        }

    def _situation(self, frame: int) -> Surroundings:
        poses: dict[str, Array] = {name: values[frame] for name, values in self._columns.object_poses.items()}
        return situation(self._scene, poses)

    def _rng(self, purpose: Literal["language", "interjection"]) -> np.random.Generator:
        info = self._info
        return generator(
            root_seed=info.root_seed, episode_index=info.episode_index, attempt=info.attempt, purpose=purpose
        )

    def _row_of(self, frame: int) -> int:
        """The first row of the dataset that is not before a frame; T when there is none."""
        return int(np.searchsorted(self._rows, frame))

    def _stretch_rows(self) -> Iterator[tuple[Stretch, int, int]]:
        """(stretch, first row, row after the last) of each stretch that any row is in."""
        for stretch in self._story.stretches:
            first, end = self._row_of(stretch.first), self._row_of(stretch.end)
            if first < end:
                yield stretch, first, end

    def subtasks(self) -> Iterator[Statement]:
        is_dropped = self._story.is_dropped
        for stretch, first, _ in self._stretch_rows():
            words = self._words[stretch.attempt.first]
            if stretch.phase == MISTAKEN_PHASE:
                words = self._mistaken(words)
            text = subtask(stretch, words, self._info.instruction, is_dropped=is_dropped)
            yield Statement(row=first, kind="subtask", role="assistant", text=text)

    def plans(self) -> Iterator[Statement]:
        for index, attempt in enumerate(self._story.tries):
            if attempt.goal is None or (index > 0 and attempt.number == 0):
                continue
            row = 0 if index == 0 else self._row_of(attempt.first)
            if row < len(self._rows):
                remaining = self._remaining(attempt.first, attempt.goal)
                if row == 0:
                    remaining[0] = self._mistaken(remaining[0])
                text = plan(remaining, is_dropped=self._story.is_dropped, is_retry=attempt.number > 0)
                yield Statement(row=row, kind="plan", role="assistant", text=text)

        correction = self._story.correction
        if correction is not None and self._story.tries[0].goal is not None:
            goal = self._story.tries[0].goal
            text = plan(self._remaining(correction.frame, goal), is_dropped=self._story.is_dropped, is_retry=False)
            yield Statement(row=self._row_of(correction.frame), kind="plan", role="assistant", text=text)

    def _mistaken(self, words: GoalWords) -> GoalWords:
        """The same, spoken before the interjection: of the thing that was mistaken."""
        correction = self._story.correction
        if correction is None:
            return words
        return replace(words, object=phrase_for(correction.mistaken, self._situation(0)))

    def interjections(self) -> Iterator[Statement]:
        correction = self._story.correction
        if correction is None or (row := self._row_of(correction.frame)) >= len(self._rows):
            return
        exchange = interjection(correction, self._situation(correction.frame), self._rng("interjection"))
        if exchange is not None:
            yield Statement(row=row, kind="interjection", role="user", text=exchange[0])
            yield Statement(row=row, kind="interjection", role="assistant", text=exchange[1])

    def _remaining(self, frame: int, goal: int) -> list[GoalWords]:
        now = self._situation(frame)
        return [goal_words(self._scene, index, now) for index in range(goal, len(self._scene.goals))]

    def memories(self) -> Iterator[Statement]:
        latest: dict[int, Statement] = {}
        for frame, text in memories(self._story, self._words, is_dropped=self._story.is_dropped):
            row = self._row_of(frame)
            if row < len(self._rows):  # of two that fall into one row, the later one holds
                latest[row] = Statement(row=row, kind="memory", role="assistant", text=text)
        yield from latest.values()

    def motions(self) -> Iterator[Statement]:
        columns, last = self._columns, self._rows[-1]
        for _, first, end in self._stretch_rows():
            frames = [self._rows[first], self._rows[end] if end < len(self._rows) else last]
            text = motion(columns.base_from_tcp[frames, :3], columns.gripper_width[frames])
            yield Statement(row=first, kind="motion", role="assistant", text=text)

    def wordings(self) -> Iterator[Statement]:
        rng, is_dropped = self._rng("language"), self._story.is_dropped
        for text in task_wordings(self._scene, self._info.instruction, rng, is_dropped=is_dropped):
            yield Statement(row=0, kind="task_aug", role="user", text=text)
