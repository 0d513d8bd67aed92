"""Words and numbers derived from a recording: subtasks, plans, memories, motions, wordings, progress and boxes.

Everything is derived from the recording (phases, events, poses, the scene as data); nothing is guessed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, get_args

LanguageKind = Literal["subtask", "plan", "memory", "motion", "task_aug"]
"""`task_aug` is another wording of the task."""
KINDS: tuple[LanguageKind, ...] = get_args(LanguageKind)


@dataclass(frozen=True, kw_only=True)
class Statement:
    """One sentence, valid from a dataset row until the next one of its kind.

    Attributes:
        row: Row of the episode, from 0.
        kind: Kind of the sentence.
        text: The sentence.
    """

    row: int
    kind: LanguageKind
    text: str


BoxEntry = tuple[int, str, Mapping[str, Any]]
"""Row of a box in its episode, the kind of its object, and its other values by COCO's names.

`bbox` is (x, y, width, height) of the pixels that show the object, `area` their number. `visible_fraction` is that
number divided by the area, px, of the whole outline, including hidden parts and those beyond the image's edge; None for
a shape with unknown outline (meshes, URDFs) or behind the camera. `color` is a word, or "".
"""
