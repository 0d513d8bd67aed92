"""Words and numbers derived from a recording: subtasks, plans, memories, motions, wordings, progress and boxes.

Everything is derived from the recording (phases, events, poses, the scene as data); nothing is guessed.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, NamedTuple, get_args

LanguageKind = Literal["subtask", "plan", "memory", "motion", "task_aug"]
"""`task_aug` is another wording of the task."""
KINDS: tuple[LanguageKind, ...] = get_args(LanguageKind)


class Statement(NamedTuple):
    """One sentence, valid from a row of the episode, counted from 0, until the next one of its kind."""

    row: int
    kind: LanguageKind
    text: str


BoxEntry = tuple[int, str, Mapping[str, Any]]
"""Row of a box in its episode, the kind of its object, and its other values by COCO's names.

`bbox` is (x, y, width, height) of the pixels that show the object, `area` their number, `color` a word or "".
"""
