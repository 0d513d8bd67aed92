"""All that is said about one recording, row by row as a language column wants it."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from demorec.annotate.kinds import KINDS, LanguageKind
from demorec.annotate.questions import asked_rows, questions, traces
from demorec.annotate.referring import phrase_for
from demorec.annotate.situation import Situations, Surroundings
from demorec.annotate.subtasks import GoalWords, goal_words, memories, plan, subtask, tcp_motion
from demorec.annotate.tries import Story, interjection, story_of
from demorec.annotate.wordings import task_wordings
from demorec.core.geometry import Array
from demorec.core.seeding import generator
from demorec.episode.episode import MISTAKEN_PHASE, SimulatedColumns
from demorec.episode.scene import Scene
from demorec.mcap import SimulatedRecording


@dataclass(frozen=True, kw_only=True)
class Statement:
    """One sentence, true from a row of the dataset on until the next one of its kind, or about this row alone.

    Attributes:
        row: Of the episode, from 0.
        kind: What it tells; `task_aug` is another wording of the task.
        role: Who says it: the user asks, the assistant does.
        text: The sentence.
        camera: Of the picture that it is about, None for all that is about no picture.
    """

    row: int
    kind: LanguageKind
    role: Literal["user", "assistant"]
    text: str
    camera: str | None = None


def narrate(
    recording: SimulatedRecording,
    columns: SimulatedColumns,
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
        cameras: Those whose pictures may be spoken of.
        about: The rows whose pictures are spoken of, None for all.

    Raises:
        RecordingError: The recording is damaged.
    """
    story = story_of(recording, columns)
    told = _Told(recording, columns, rows, story)
    asked = {row: turn for row, turn in told.asked().items() if about is None or row in about}
    found: dict[LanguageKind, Callable[[], Iterator[Statement]]] = {
        "subtask": told.subtasks,
        "plan": told.plans,
        "memory": told.memories,
        "motion": told.motions,
        "task_aug": told.wordings,
        "vqa": lambda: told.questions(cameras, asked),
        "trace": lambda: told.traces(cameras, asked),
        "interjection": told.interjections,
    }
    statements = [statement for kind in KINDS if kind in kinds for statement in found[kind]()]
    return sorted(statements, key=lambda statement: statement.row)


class _Told:
    """The sentences of one episode, kind by kind."""

    def __init__(
        self, recording: SimulatedRecording, columns: SimulatedColumns, rows: NDArray[np.intp], story: Story
    ) -> None:
        self._recording = recording
        self._info, self._columns, self._rows, self._story = recording.info, columns, rows, story
        self._scene: Scene = recording.info.scene
        self._situations = Situations(self._scene)
        self._words = {
            attempt.first: goal_words(self._scene, attempt.goal, self._situation(attempt.first))
            for attempt in story.tries
        }

    def _situation(self, frame: int) -> Surroundings:
        poses: dict[str, Array] = {name: values[frame] for name, values in self._columns.object_poses.items()}
        return self._situations.at(poses)

    def _row_of(self, frame: int) -> int:
        """The first row of the dataset that is not before a frame; T when there is none."""
        return int(np.searchsorted(self._rows, frame))

    def _stretch_rows(self) -> list[tuple[int, int, int]]:
        """(number of the stretch, first row, row after the last) of each stretch that any row is in."""
        found = [
            (number, self._row_of(stretch.first), self._row_of(stretch.end))
            for number, stretch in enumerate(self._story.stretches)
        ]
        return [(number, first, end) for number, first, end in found if first < end]

    def subtasks(self) -> Iterator[Statement]:
        is_dropped = self._story.is_dropped
        for number, first, _ in self._stretch_rows():
            stretch = self._story.stretches[number]
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
                text = plan(
                    remaining,
                    is_dropped=self._story.is_dropped,
                    is_retry=attempt.number > 0,
                )
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
        correction, info = self._story.correction, self._info
        if correction is None or (row := self._row_of(correction.frame)) >= len(self._rows):
            return
        rng = generator(
            root_seed=info.root_seed, episode_index=info.episode_index, attempt=info.attempt, purpose="interjection"
        )
        told = interjection(correction, self._situation(correction.frame), rng)
        if told is not None:
            yield Statement(row=row, kind="interjection", role="user", text=told[0])
            yield Statement(row=row, kind="interjection", role="assistant", text=told[1])

    def _remaining(self, frame: int, goal: int) -> list[GoalWords]:
        now = self._situation(frame)
        return [goal_words(self._scene, index, now) for index in range(goal, len(self._scene.goals))]

    def memories(self) -> Iterator[Statement]:
        latest: dict[int, Statement] = {}
        for item in memories(self._story, self._words, is_dropped=self._story.is_dropped):
            row = self._row_of(item.frame)
            if row < len(self._rows):  # of two that fall into one row, the later one holds
                latest[row] = Statement(row=row, kind="memory", role="assistant", text=item.text)
        yield from latest.values()

    def motions(self) -> Iterator[Statement]:
        columns, last = self._columns, self._rows[-1]
        for _, first, end in self._stretch_rows():
            until = self._rows[end] if end < len(self._rows) else last
            text = tcp_motion(columns.base_from_tcp, columns.gripper_width, int(self._rows[first]), int(until))
            yield Statement(row=first, kind="motion", role="assistant", text=text)

    def wordings(self) -> Iterator[Statement]:
        info = self._info
        rng = generator(
            root_seed=info.root_seed, episode_index=info.episode_index, attempt=info.attempt, purpose="language"
        )
        for text in task_wordings(self._scene, info.instruction, rng, is_dropped=self._story.is_dropped):
            yield Statement(row=0, kind="task_aug", role="user", text=text)

    def asked(self) -> dict[int, int]:
        """Of all pictures that are spoken of: row -> turn."""
        stride = int(self._rows[1] - self._rows[0]) if len(self._rows) > 1 else 1
        return asked_rows(len(self._rows), self._info.fps // stride)

    def questions(self, cameras: Sequence[str], asked: Mapping[int, int]) -> Iterator[Statement]:
        for item in questions(self._recording, self._columns, self._rows, cameras, asked):
            yield Statement(row=item.row, kind="vqa", role="user", text=item.text, camera=item.camera)
            yield Statement(row=item.row, kind="vqa", role="assistant", text=item.answer, camera=item.camera)

    def traces(self, cameras: Sequence[str], asked: Mapping[int, int]) -> Iterator[Statement]:
        for item in traces(self._recording, self._columns, self._rows, cameras, asked):
            yield Statement(row=item.row, kind="trace", role="assistant", text=item.answer, camera=item.camera)
