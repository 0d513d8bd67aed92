"""Which tasks a test over every task takes in `make test`, and which are left to .ci/run."""

from __future__ import annotations

from typing import Any

import pytest

from demorec.tables import TASKS

LONG_TASKS = ("line_up", "sort_by_color", "stack_three")
"""Several objects are moved, which takes three times as long; `tests/contract/test_tasks.py` runs these always."""


def tasks_with_long_ones_slow() -> list[Any]:
    """Parameters: every row of the table, the long ones marked as slow."""
    return [pytest.param(name, marks=pytest.mark.slow if name in LONG_TASKS else ()) for name in TASKS.names()]
