"""Words and numbers derived from a recording: subtasks, plans, memories, motions, wordings, progress and boxes.

Everything follows from what was recorded (phases, events, poses, the scene as data); nothing is guessed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

LanguageKind = Literal["subtask", "plan", "memory", "motion", "task_aug"]
"""`task_aug` is another wording of the task."""
KINDS: tuple[LanguageKind, ...] = get_args(LanguageKind)


@dataclass(frozen=True, kw_only=True)
class Statement:
    """One sentence, true from a row of the dataset on until the next one of its kind.

    Attributes:
        row: Row of the episode, from 0.
        kind: Subject of the sentence.
        role: Speaker: the user asks, the assistant does.
        text: The sentence.
    """

    row: int
    kind: LanguageKind
    role: Literal["user", "assistant"]
    text: str
