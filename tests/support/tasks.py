"""Tasks that tests of every task use in `make test`, and those left to .ci/run."""

from __future__ import annotations

from typing import Any

import pytest

from demorec.core.tables import TASKS

QUICK_TASKS = ("pick_from_clutter", "tutorial")
"""Many bodies, a custom script.

Most other tests use one cube (`pick_place`); `tests/contract/test_tasks.py` always runs every task.
"""


def tasks_with_slow_ones() -> list[Any]:
    """Parameters for every task in the table: the most demanding one is marked slow, other slow ones long."""
    slow, long = [pytest.mark.slow], [pytest.mark.slow, pytest.mark.long]
    marks: dict[str, list[Any]] = {name: [] for name in QUICK_TASKS} | {"pick_anything": slow}
    return [pytest.param(name, marks=marks.get(name, long)) for name in TASKS.names()]
