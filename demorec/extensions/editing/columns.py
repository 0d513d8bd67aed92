"""Columns of a dataset's episodes for conditions and sorting: from its tables and from extensions."""

from __future__ import annotations

import pkgutil
from collections.abc import Collection
from typing import Any

from demorec.core.extensions import rows_of
from demorec.datasets.lerobot.episode_records import episode_columns
from demorec.datasets.lerobot.folder import LeRobotFolder


def columns_of(folder: LeRobotFolder, names: Collection[str]) -> list[dict[str, Any]]:
    """Read the columns of each episode, including requested columns of extensions that the dataset lacks."""
    columns = episode_columns(folder)
    wanted: dict[str, list[str]] = {}
    for name, target in rows_of("columns"):
        if name in names and not any(name in row for row in columns):
            wanted.setdefault(target, []).append(name)
    for target, added in wanted.items():
        values = pkgutil.resolve_name(target)(folder, added)
        columns = [row | more for row, more in zip(columns, values, strict=True)]
    return columns
