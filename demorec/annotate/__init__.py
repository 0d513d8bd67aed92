"""What a recording's numbers say, in words: subtasks, plans, memories, motions, wordings of the task, and progress.

Everything is derived from what was recorded (phases, events, poses, the scene as data); nothing is guessed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

LanguageKind = Literal["subtask", "plan", "memory", "motion", "task_aug", "vqa", "trace", "interjection"]
"""`task_aug` is another wording of the task, `vqa` a question about an image, `trace` a way in an image,
`interjection` what somebody says in the midst of it."""
KINDS: tuple[LanguageKind, ...] = get_args(LanguageKind)
STATES: tuple[LanguageKind, ...] = ("subtask", "plan", "memory", "motion", "task_aug")
"""Those that hold from a moment on; the others are about one moment."""


@dataclass(frozen=True, kw_only=True)
class Statement:
    """One sentence, true from a row of the dataset on until the next one of its kind, or about this row alone.

    Attributes:
        row: Of the episode, from 0.
        kind: What it tells; `task_aug` is another wording of the task.
        role: Who says it: the user asks, the assistant does.
        text: The sentence.
        camera: Of the image that it is about, None for all that is about no image.
    """

    row: int
    kind: LanguageKind
    role: Literal["user", "assistant"]
    text: str
    camera: str | None = None
