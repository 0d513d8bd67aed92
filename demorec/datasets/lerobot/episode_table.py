"""The tables of episodes and of tasks: which episodes a dataset has, and where their rows and images are stored."""

from __future__ import annotations

import reprlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from demorec.core.errors import ExportError
from demorec.datasets.lerobot.files import read_json_lines, read_table, tables_in
from demorec.datasets.lerobot.layout import (
    OLD_EPISODES_PATH,
    OLD_TASKS_PATH,
    TASKS_PATH,
    VIDEO_PATH,
    DatasetInfo,
    FilePosition,
)

TIME_TOLERANCE_S = 1e-4
"""Maximum distance of a row's timestamp from the grid, as in LeRobot."""
_MAX_VALUE = 1 << 40
"""Exceeds the rows, frames and seconds of any dataset."""
_MAX_TASK_GAPS = 100_000
"""Maximum number of task numbers without a task, for tables from which tasks were removed."""
_VIDEO_COLUMNS = ("chunk_index", "file_index", "from_timestamp")
"""Columns that locate the images of an episode, for each camera."""


def are_on_grid(seconds: NDArray[np.float64], fps: int, first_s: float = 0.0) -> bool:
    """Whether float32 timestamps (T,) are `first_s` and multiples of 1/fps, within LeRobot's tolerance and rounding."""
    precision_s = float(np.spacing(np.float32(np.abs(seconds).max(initial=0.0))))
    off = np.abs(seconds - first_s - np.arange(len(seconds)) / fps)
    return bool((off <= TIME_TOLERANCE_S + precision_s).all())


@dataclass(frozen=True, kw_only=True)
class EpisodePlace:
    """Where the rows and images of an episode are stored.

    Attributes:
        episode_index, length, tasks: Same as in the episodes' table.
        data: File of its rows.
        first_row: Index of its first row in that file.
        from_index: Index of its first row in the whole dataset.
        videos: Camera feature -> (mp4 file, first image in it).
    """

    episode_index: int
    length: int
    tasks: tuple[str, ...]
    data: Path
    first_row: int
    from_index: int
    videos: dict[str, tuple[Path, int]]


def has_episode_table(root: Path, info: DatasetInfo) -> bool:
    """Whether the dataset has a table of episodes; recordings that were never finalized lack it."""
    return (root / OLD_EPISODES_PATH).exists() if info.is_old else bool(tables_in(root, "meta/episodes"))


def read_episode_table(root: Path, info: DatasetInfo) -> Iterator[EpisodePlace]:
    """Read the place of every episode in order. Raises ExportError if a table cannot be read."""
    columns = ["episode_index", "length", "tasks", "data/chunk_index", "data/file_index", "dataset_from_index"]
    for key in info.video_keys:
        columns += [f"videos/{key}/{name}" for name in _VIDEO_COLUMNS]
    if info.is_old:
        rows = _old_rows(root, info)
    else:
        rows = (
            (path, row) for path in tables_in(root, "meta/episodes") for row in read_table(path, columns).to_pylist()
        )
    ends: dict[Path, int] = {}

    @cache  # many episodes share a file
    def file(template: str, key: str, chunk: int, number: int) -> Path:
        path = root / FilePosition(chunk=chunk, file=number).path(template, key)
        return path if path.exists() else elsewhere(root, path, key) or path

    for path, row in rows:
        _check_row(row, path)
        data = file(info.data_path, "", row["data/chunk_index"], row["data/file_index"])
        first = ends.get(data, 0)
        ends[data] = first + row["length"]
        videos = {}
        for key in info.video_keys:
            chunk, number, start = (row[f"videos/{key}/{name}"] for name in _VIDEO_COLUMNS)
            videos[key] = file(info.video_path or VIDEO_PATH, key, chunk, number), round(start * info.fps)
        yield EpisodePlace(
            episode_index=row["episode_index"],
            length=row["length"],
            tasks=tuple(row["tasks"]),
            data=data,
            first_row=first,
            from_index=row["dataset_from_index"],
            videos=videos,
        )


def elsewhere(root: Path, path: Path, key: str) -> Path | None:
    """Find the only file with this name (for a camera, in a folder named after it) where info.json is wrong."""
    others = [(other, other.relative_to(root).parts) for other in root.rglob(path.name)]
    found = [other for other, parts in others if (key in parts if key else parts[0] != "meta")]
    if len(found) > 1:
        found = [other for other in found if other.parent.name == path.parent.name]
    return found[0] if len(found) == 1 else None


def _old_rows(root: Path, info: DatasetInfo) -> Iterator[tuple[Path, dict[str, Any]]]:
    """Convert the lines of a table before v3.0, where each episode has its own files, to the columns of v3.0."""
    path, begin = root / OLD_EPISODES_PATH, 0
    for line in read_json_lines(path):
        row: dict[str, Any] = {name: line.get(name) for name in ("episode_index", "length", "tasks")}
        _check_row(row, path)
        number = row["episode_index"]
        row |= {"data/chunk_index": number // int(info.chunks_size), "data/file_index": number}
        row["dataset_from_index"] = begin
        for key in info.video_keys:
            row |= {f"videos/{key}/{name}_index": row[f"data/{name}_index"] for name in ("chunk", "file")}
            row[f"videos/{key}/from_timestamp"] = 0
        begin += row["length"]
        yield path, row


def _check_row(row: dict[str, Any], path: Path) -> None:
    for name, value in row.items():
        if name == "tasks":
            is_good = isinstance(value, list) and all(isinstance(task, str) for task in value)
        elif name.endswith("/from_timestamp"):
            is_good = isinstance(value, float | int) and 0 <= value < _MAX_VALUE
        else:
            is_good = isinstance(value, int) and 0 <= value < _MAX_VALUE
        if not is_good:
            raise ExportError(f"The episodes' table has {reprlib.repr(value)} as {name}: {path}")


def read_tasks(root: Path) -> list[str]:
    """Read the instructions in the order of their indices. Raises ExportError if the table cannot be read."""
    path = root / TASKS_PATH
    if not path.exists() and (root / OLD_TASKS_PATH).exists():
        path = root / OLD_TASKS_PATH
        return _by_number([(line.get("task_index"), line.get("task")) for line in read_json_lines(path)], path)
    table = read_table(path)
    # pandas names an index column without a name.
    column = next((name for name in ("task", "__index_level_0__") if name in table.column_names), None)
    if column is None or "task_index" not in table.column_names:
        raise ExportError(f"The tasks' table has no task or no task_index: {path}")
    numbers, texts = table.column("task_index").to_pylist(), table.column(column).to_pylist()
    return _by_number(list(zip(numbers, texts, strict=True)), path)


def _by_number(rows: Sequence[tuple[object, object]], path: Path) -> list[str]:
    found: dict[int, str] = {}
    for number, task in rows:
        if isinstance(number, float) and number.is_integer():
            number = int(number)
        if not isinstance(number, int) or not 0 <= number < len(rows) + _MAX_TASK_GAPS:
            raise ExportError(f"The tasks' table has {reprlib.repr(number)} as task_index: {path}")
        found[number] = str(task)
    return [found.get(number, "") for number in range(max(found, default=-1) + 1)]
