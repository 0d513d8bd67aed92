"""What can be said about an episode, in the words that LeRobot has for it."""

from __future__ import annotations

from typing import Literal, get_args

Kind = Literal["subtask", "plan", "memory", "motion", "task_aug"]
"""`task_aug` is another wording of the task."""
KINDS: tuple[Kind, ...] = get_args(Kind)
