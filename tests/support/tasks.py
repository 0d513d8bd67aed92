"""Which tasks a test over every task takes in `make test`, and which are left to .ci/run."""

from __future__ import annotations

from typing import Any

import pytest

from demorec.core.tables import ROBOTS, TASKS

QUICK_TASKS = ("pick_from_clutter", "tutorial")
"""Many bodies, an own script. Most other tests take one cube (`pick_place`); `tests/contract/test_tasks.py` runs every
task always."""

PAIRS = [
    (task, robot)
    for task in TASKS.names()
    for robot in ROBOTS.names()
    if not TASKS.load(task).refusal(ROBOTS.load(robot))
]
"""Every task with every robot that does it."""


def tasks_with_slow_ones() -> list[Any]:
    """Parameters: every row of the table, all but the quick ones marked as slow."""
    return [pytest.param(name, marks=() if name in QUICK_TASKS else pytest.mark.slow) for name in TASKS.names()]
