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
    """Parameters: every row of the table; slow is the one that asks most of everything, and long are the others that
    are not quick."""
    slow, long = [pytest.mark.slow], [pytest.mark.slow, pytest.mark.long]
    marks: dict[str, list[Any]] = {name: [] for name in QUICK_TASKS} | {"pick_anything": slow}
    return [pytest.param(name, marks=marks.get(name, long)) for name in TASKS.names()]
