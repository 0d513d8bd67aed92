"""What can be said about an episode, in the words that LeRobot has for it."""

from __future__ import annotations

from typing import Literal, get_args

LanguageKind = Literal["subtask", "plan", "memory", "motion", "task_aug", "vqa", "trace", "interjection"]
"""`task_aug` is another wording of the task, `vqa` a question about a picture, `trace` a way in a picture,
`interjection` what somebody says in the midst of it."""
KINDS: tuple[LanguageKind, ...] = get_args(LanguageKind)
STATES: tuple[LanguageKind, ...] = ("subtask", "plan", "memory", "motion", "task_aug")
"""Those that hold from a moment on; the others are about one moment."""
