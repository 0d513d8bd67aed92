"""Row columns that refer to the table of tasks by number, such as GR00T's `annotation.*`."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from demorec.core.errors import ConfigError
from demorec.datasets.lerobot.layout import DatasetInfo, is_task_reference
from demorec.extensions.editing.plan import Plan

_KNOWN = "annotation."
"""Prefix of GR00T's columns with task numbers."""


def reference_columns(info: DatasetInfo) -> tuple[str, ...]:
    """Find the columns that may hold task numbers."""
    return tuple(name for name, feature in info.features.items() if is_task_reference(name, feature))


def kept_tasks(plan: Plan) -> tuple[str, ...]:
    """Return the first tasks of the new dataset; empty if no column refers to them."""
    if not any(reference_columns(source.info) for source in plan.sources):
        return ()
    return tuple(dict.fromkeys(task for source in plan.sources for task in source.tasks))


def new_task_numbers(plan: Plan, number: int) -> NDArray[np.int64]:
    """Map a source's task numbers to those of `kept_tasks`, (N,).

    Raises:
        ConfigError: Numbers change, and a column of unknown kind may refer to them.
    """
    source, places = plan.sources[number], {task: place for place, task in enumerate(kept_tasks(plan))}
    numbers = np.array([places[task] for task in source.tasks], dtype=np.int64)
    unknown = [name for name in reference_columns(source.info) if not name.startswith(_KNOWN)]
    taken = {mapping.feature for mapping in plan.mappings[number].values()}
    if (numbers != np.arange(len(numbers))).any() and (lost := [name for name in unknown if name in taken]):
        raise ConfigError(
            f"The column {lost[0]} may hold task numbers, which would change: leave it out first (demorec "
            f"dataset drop-features), or give the datasets the same tasks: {source.root}"
        )
    return numbers


def renumbered(values: NDArray[np.int64], numbers: NDArray[np.int64]) -> NDArray[np.int64]:
    """Replace task numbers; other values stay."""
    is_task = (values >= 0) & (values < len(numbers))
    found = values.copy()
    found[is_task] = numbers[values[is_task]]
    return found
