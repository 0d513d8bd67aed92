"""Episodes located by a dataset's rows, if the table of episodes is missing or names other files.

Each row contains the number of its episode. The images are located by counting: an episode has as many as rows, a
camera's videos hold the episodes in order, and no episode spans two files.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from demorec.core.errors import ExportError
from demorec.datasets.lerobot.episode_table import EpisodePlace, elsewhere
from demorec.datasets.lerobot.files import TableReader, column_numbers, open_table, tables_in
from demorec.datasets.lerobot.layout import VIDEO_PATH, DatasetInfo, FilePosition
from demorec.datasets.lerobot.mp4_index import mp4_index

COUNTERS = ("episode_index", "frame_index", "index", "task_index")
_ROWS_AT_ONCE = 65536
_OLD_NAME = re.compile(r"episode_(\d{1,9})")
REPAIR = "demorec dataset repair"


@dataclass(frozen=True, kw_only=True, eq=False)
class EpisodeRun:
    """Consecutive rows of one episode in a data file.

    Attributes:
        episode_index: Number in the rows.
        data: The file.
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
