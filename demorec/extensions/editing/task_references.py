"""Columns of rows that refer to the table of tasks by number, as GR00T's `annotation.*` do."""

from __future__ import annotations

import re

import numpy as np
from numpy.typing import NDArray

from demorec.core.errors import ConfigError
from demorec.datasets.lerobot.layout import AUTOMATIC_FEATURES, DatasetInfo
from demorec.extensions.editing.plan import Plan

_KNOWN = "annotation."
"""Beginning of the names of GR00T's columns, whose values are numbers of tasks."""
_TASK_WORD = re.compile(r"(^|[._])(annotations?|tasks?|subtasks?)([._]|$)")


def reference_columns(info: DatasetInfo) -> tuple[str, ...]:
    """Find the columns of whole numbers whose names say that they may be numbers of tasks."""
    return tuple(
        name
        for name, feature in info.features.items()
        if name not in AUTOMATIC_FEATURES
        and feature.dtype.startswith("int")
        and feature.shape == (1,)
        and _TASK_WORD.search(name)
    )


def kept_tasks(plan: Plan) -> tuple[str, ...]:
    """Return the tasks that the new dataset begins with; none where no column refers to them."""
    if not any(reference_columns(source.info) for source in plan.sources):
        return ()
    return tuple(dict.fromkeys(task for source in plan.sources for task in source.tasks))


def new_task_numbers(plan: Plan, number: int) -> NDArray[np.int64]:
    """Map the numbers of a source's tasks to those of `kept_tasks`, (N,).

    Raises:
        ConfigError: Numbers change, and a column that may refer to them is of an unknown kind.
    """
    source, places = plan.sources[number], {task: place for place, task in enumerate(kept_tasks(plan))}
    numbers = np.array([places[task] for task in source.tasks], dtype=np.int64)
    unknown = [name for name in reference_columns(source.info) if not name.startswith(_KNOWN)]
    taken = {mapping.feature for mapping in plan.mappings[number].values()}
    if (numbers != np.arange(len(numbers))).any() and (lost := [name for name in unknown if name in taken]):
        raise ConfigError(
            f"The column {lost[0]} may hold numbers of tasks, which this renumbers: leave it out first (demorec "
            f"dataset drop-features), or give the datasets the same tasks: {source.root}"
        )
    return numbers


def renumbered(values: NDArray[np.int64], numbers: NDArray[np.int64]) -> NDArray[np.int64]:
    """Replace numbers of tasks by the new ones; values that are not numbers of tasks stay."""
    is_task = (values >= 0) & (values < len(numbers))
    found = values.copy()
    found[is_task] = numbers[values[is_task]]
    return found
