"""Which episodes a dataset has, and where their rows and images are stored, by its tables of episodes and of tasks.

If the table of episodes is missing or names other files, the rows tell: each contains the number of its episode. The
images are located by counting: an episode has as many as rows, a camera's videos hold the episodes in order, and no
episode spans two files.
"""

from __future__ import annotations

import re
import reprlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from demorec.core.errors import ExportError, describe_error
from demorec.core.files import read_text_limited
from demorec.core.plain import parse_json
from demorec.datasets.lerobot.files import (
    MAX_JSON_BYTES,
    TableReader,
    column_numbers,
    open_table,
    read_table,
    tables_in,
)
from demorec.datasets.lerobot.layout import TASKS_PATH, VIDEO_PATH, DatasetInfo, FilePosition
from demorec.extensions.datasets.mp4_index import mp4_index

OLD_EPISODES_PATH = "meta/episodes.jsonl"
OLD_TASKS_PATH = "meta/tasks.jsonl"
TIME_TOLERANCE_S = 1e-4
"""Maximum distance of a row's timestamp from the grid, as in LeRobot."""
_MAX_VALUE = 1 << 40
"""Exceeds the rows, frames and seconds of any dataset."""
_MAX_TASK_GAPS = 100_000
"""Maximum number of task numbers without a task, for tables from which tasks were removed."""
_VIDEO_COLUMNS = ("chunk_index", "file_index", "from_timestamp")
"""Columns that locate the images of an episode, for each camera."""
COUNTERS = ("episode_index", "frame_index", "index", "task_index")
_ROWS_AT_ONCE = 65536
_OLD_NAME = re.compile(r"episode_(\d{1,9})")
REPAIR = "demorec dataset repair"


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


def read_json_lines(path: Path) -> list[dict[str, Any]]:
    """Read the objects of a JSON Lines file; ExportError if it cannot be read, or a line is not an object."""
    try:
        lines = read_text_limited(path, MAX_JSON_BYTES).splitlines()
        found = [parse_json(line, allow_nan=True) for line in lines if line.strip()]
        if not all(isinstance(line, dict) for line in found):
            raise ValueError("a line is not an object")
    except (OSError, ValueError) as error:
        raise ExportError(f"The table cannot be read ({describe_error(error)}): {path}") from error
    return found


def _by_number(rows: Sequence[tuple[object, object]], path: Path) -> list[str]:
    found: dict[int, str] = {}
    for number, task in rows:
        if isinstance(number, float) and number.is_integer():
            number = int(number)
        if not isinstance(number, int) or not 0 <= number < len(rows) + _MAX_TASK_GAPS:
            raise ExportError(f"The tasks' table has {reprlib.repr(number)} as task_index: {path}")
        found[number] = str(task)
    return [found.get(number, "") for number in range(max(found, default=-1) + 1)]


@dataclass(frozen=True, kw_only=True, eq=False)
class EpisodeRun:
    """Consecutive rows of one episode in a data file.

    Attributes:
        episode_index: Number in the rows.
        first_row: Index of its first row in that file.
        counters: Column in `COUNTERS` that the file has -> (T,) its values.
    """

    episode_index: int
    data: Path
    first_row: int
    counters: Mapping[str, NDArray[np.int64]]
    length: int

    @property
    def task_indices(self) -> list[int]:
        """Numbers of its tasks, in the order of their first rows."""
        return list(dict.fromkeys(self.counters.get("task_index", np.zeros(0, np.int64)).tolist()))


def episode_runs(files: Sequence[Path], first: int = 0) -> list[EpisodeRun]:
    """Find the episodes in data files, in row order: a decrease of `frame_index` also begins a new one.

    Args:
        files: The data files.
        first: Number of the first episode, if the rows have no `episode_index`.

    Raises:
        ExportError: A file cannot be read, or its rows have no column that separates episodes.
    """
    runs: list[EpisodeRun] = []
    for path in files:
        runs += _runs_in(path, first + len(runs))
    return runs


def _runs_in(path: Path, first: int) -> Iterator[EpisodeRun]:
    counters = _counters(path)
    if (count := open_table(path).metadata.num_rows) == 0:
        return
    if "episode_index" not in counters:
        counters["episode_index"] = _numbered(path, counters, first)
    begins_another = np.diff(counters["episode_index"]) != 0
    if "frame_index" in counters:
        begins_another |= np.diff(counters["frame_index"]) < 0
    begins = [0, *(np.flatnonzero(begins_another) + 1).tolist()]
    for begin, end in zip(begins, [*begins[1:], count], strict=True):
        own = {name: values[begin:end] for name, values in counters.items()}
        number = int(own["episode_index"][0])
        yield EpisodeRun(episode_index=number, data=path, first_row=begin, length=end - begin, counters=own)


def _numbered(path: Path, counters: Mapping[str, NDArray[np.int64]], first: int) -> NDArray[np.int64]:
    """Number the rows' episodes, (T,): by the file name before v3.0, otherwise by decreases of `frame_index`."""
    if "frame_index" not in counters:
        raise ExportError(
            f"The rows have no episode_index and no frame_index, so episodes cannot be told apart: {path}"
        )
    name = _OLD_NAME.fullmatch(path.stem)
    falls = np.diff(counters["frame_index"], prepend=counters["frame_index"][0]) < 0
    return (int(name[1]) if name else first) + np.cumsum(falls)


def _counters(path: Path) -> dict[str, NDArray[np.int64]]:
    schema = open_table(path).schema_arrow
    names = [name for name in COUNTERS if name in schema.names]
    parts: dict[str, list[NDArray[np.int64]]] = {name: [np.zeros(0, np.int64)] for name in names}
    for batch in TableReader(names, rows=_ROWS_AT_ONCE).read(path) if names else ():
        for name in names:
            values = column_numbers(batch.column(name)).reshape(-1)
            is_whole = values.dtype.kind in "iu" or bool(values.dtype.kind == "f" and (values % 1 == 0).all())
            if len(values) != len(batch) or not is_whole:
                raise ExportError(f"The column {name} does not hold one integer per row: {path}")
            parts[name].append(values.astype(np.int64))
    return {name: np.concatenate(values) for name, values in parts.items()}


def places_by_rows(root: Path, info: DatasetInfo, tasks: Sequence[str]) -> tuple[EpisodePlace, ...]:
    """Locate every episode by its rows, in the order of their numbers. Raises ExportError if two have the same number,
    or the images of one cannot be determined.
    """
    runs = sorted(episode_runs(tables_in(root, "data")), key=lambda run: run.episode_index)
    numbers = [run.episode_index for run in runs]
    if twice := [number for number, other in pairwise(numbers) if number == other]:
        raise ExportError(
            f"Two episodes of the dataset have the number {twice[0]} in their rows; {REPAIR} numbers them: {root}"
        )
    return placed(runs, {key: images_by_rows(root, info, key, runs) for key in info.video_keys}, tasks)


def placed(
    runs: Sequence[EpisodeRun], images: Mapping[str, Sequence[tuple[Path, int]]], tasks: Sequence[str]
) -> tuple[EpisodePlace, ...]:
    """Place the episodes in sequence.

    Args:
        runs: Rows of the episodes.
        images: Camera feature -> file and first image of each episode.
        tasks: Instructions by number.
    """
    begins = np.cumsum([0, *(run.length for run in runs)]).tolist()
    return tuple(
        EpisodePlace(
            episode_index=run.episode_index,
            length=run.length,
            tasks=tuple(tasks[index] for index in run.task_indices if 0 <= index < len(tasks)),
            data=run.data,
            first_row=run.first_row,
            from_index=begin,
            videos={key: found[number] for key, found in images.items()},
        )
        for number, (run, begin) in enumerate(zip(runs, begins, strict=False))
    )


def images_by_rows(root: Path, info: DatasetInfo, key: str, runs: Sequence[EpisodeRun]) -> list[tuple[Path, int]]:
    """Locate a camera's images by counting: file and first image of each episode, in order. Raises ExportError if the
    videos have a different number of images.
    """
    if info.is_old:
        template, size = info.video_path or VIDEO_PATH, int(info.chunks_size)
        numbers = [FilePosition(chunk=run.episode_index // size, file=run.episode_index) for run in runs]
        paths = [root / position.path(template, key) for position in numbers]
        return [(path if path.exists() else elsewhere(root, path, key) or path, 0) for path in paths]
    counts = {path: len(mp4_index(path)[0]) for path in sorted(root.glob(f"videos/{key}/*/*.mp4"))}
    rows, total = sum(run.length for run in runs), sum(counts.values())
    # Extra images belong to episodes with lost rows, the last ones of an interrupted recording.
    if total not in (rows, int(info.total_frames)) or total < rows:
        raise _unknown_images(root, key, f"{total} images for {rows} rows")
    found: list[tuple[Path, int]] = []
    files, path, first = iter(counts), Path(), 0
    for run in runs:
        if first == counts.get(path, 0):
            path, first = next(files), 0
        if first + run.length > counts[path]:
            raise _unknown_images(root, key, f"{path.name} ends within episode {run.episode_index}")
        found.append((path, first))
        first += run.length
    return found


def _unknown_images(root: Path, key: str, found: str) -> ExportError:
    return ExportError(
        f"The images of {key} cannot be assigned to rows ({found}): leave the camera out (demorec "
        f"dataset drop-features), or restore its videos: {root}"
    )


def relocated(root: Path, listed: Sequence[EpisodePlace]) -> tuple[EpisodePlace, ...] | None:
    """Locate the rows of episodes if their table names other data files; None if the table fits, or no file does.
    Raises ExportError if a data file cannot be read.
    """
    files = tables_in(root, "data")
    there = {path: open_table(path).metadata.num_rows for path in files}
    if rows_by_file(listed).items() >= {path: count for path, count in there.items() if count}.items():
        return None
    runs = {run.episode_index: run for run in episode_runs(files)}
    found = tuple(
        replace(place, data=run.data, first_row=run.first_row)
        if (run := runs.get(place.episode_index)) is not None and run.length == place.length
        else place
        for place in listed
    )
    return found if rows_by_file(found).items() >= there.items() else None


def rows_by_file(places: Sequence[EpisodePlace]) -> dict[Path, int]:
    """Data file -> number of its episodes' rows."""
    found: dict[Path, int] = {}
    for place in places:
        found[place.data] = found.get(place.data, 0) + place.length
    return found
