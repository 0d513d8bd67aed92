"""Reads the tables of a LeRobot dataset without LeRobot: where its episodes lie, their tasks and their rows."""

from __future__ import annotations

import math
import reprlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from demorec.core.errors import ExportError, describe_error
from demorec.datasets.lerobot.files import (
    TableRows,
    column_numbers,
    open_table,
    read_json_lines,
    read_table,
    table_batches,
    tables_in,
)
from demorec.datasets.lerobot.language import column_digests
from demorec.datasets.lerobot.layout import (
    OLD_EPISODES_PATH,
    OLD_TASKS_PATH,
    TASKS_PATH,
    VIDEO_PATH,
    DatasetInfo,
    FilePosition,
)

_MOST = 1 << 40
"""Above all rows, frames and seconds of any dataset."""
_INDEX_ROWS = 4096
_OF_VIDEO = ("chunk_index", "file_index", "from_timestamp")
"""Columns that say of each camera where an episode's images lie."""


@dataclass(frozen=True, kw_only=True)
class EpisodePlace:
    """Where an episode lies.

    Attributes:
        episode_index, length, tasks: As the episodes' table has them.
        data: File of its rows.
        first_row: Of its rows in that file.
        from_index: Of its first row over the whole dataset.
        videos: Camera feature -> (mp4 file, first image in it).
    """

    episode_index: int
    length: int
    tasks: tuple[str, ...]
    data: Path
    first_row: int
    from_index: int
    videos: dict[str, tuple[Path, int]]


class OpenDataset:
    """A dataset, whoever wrote it: what is in it, and where.

    Attributes:
        root, info: Its folder and what info.json says.
        places: Where its episodes lie, in order.

    Raises:
        ExportError: There is none, or it is damaged.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        self.info = DatasetInfo.load(root)
        self.places = tuple(episode_places(root, self.info))
        if missing := [name for name in ("timestamp", "task_index") if name not in self.info.features]:
            raise ExportError(f"The dataset has no {', '.join(missing)}: {root}")

    @cached_property
    def tasks(self) -> list[str]:
        """Instructions."""
        return read_tasks(self.root)


def episode_places(root: Path, info: DatasetInfo) -> Iterator[EpisodePlace]:
    """Every episode in order; ExportError when a table cannot be read."""
    columns = ["episode_index", "length", "tasks", "data/chunk_index", "data/file_index", "dataset_from_index"]
    for key in info.video_keys:
        columns += [f"videos/{key}/{name}" for name in _OF_VIDEO]
    if info.is_old:
        rows = _old_rows(root, info)
    else:
        rows = (
            (path, row) for path in tables_in(root, "meta/episodes") for row in read_table(path, columns).to_pylist()
        )
    ends: dict[Path, int] = {}

    @cache  # many episodes share a file
    def file(template: str, key: str, chunk: int, number: int) -> Path:
        return root / FilePosition(chunk=chunk, file=number).path(template, key)

    for path, row in rows:
        _check_place(row, path)
        data = file(info.data_path, "", row["data/chunk_index"], row["data/file_index"])
        first = ends.get(data, 0)
        ends[data] = first + row["length"]
        videos = {}
        for key in info.video_keys:
            chunk, number, start = (row[f"videos/{key}/{name}"] for name in _OF_VIDEO)
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


def _old_rows(root: Path, info: DatasetInfo) -> Iterator[tuple[Path, dict[str, Any]]]:
    """The lines of a table before v3.0 with the columns of today's: each episode has files of its own."""
    path, begin = root / OLD_EPISODES_PATH, 0
    for line in read_json_lines(path):
        row: dict[str, Any] = {name: line.get(name) for name in ("episode_index", "length", "tasks")}
        _check_place(row, path)
        number = row["episode_index"]
        row |= {"data/chunk_index": number // int(info.chunks_size), "data/file_index": number}
        row["dataset_from_index"] = begin
        for key in info.video_keys:
            row |= {f"videos/{key}/{name}_index": row[f"data/{name}_index"] for name in ("chunk", "file")}
            row[f"videos/{key}/from_timestamp"] = 0
        begin += row["length"]
        yield path, row


def _check_place(row: dict[str, Any], path: Path) -> None:
    """ExportError for an episode's row with other values than positions can have."""
    for name, value in row.items():
        if name == "tasks":
            is_good = isinstance(value, list) and all(isinstance(task, str) for task in value)
        elif name.endswith("/from_timestamp"):
            is_good = isinstance(value, float | int) and 0 <= value < _MOST
        else:
            is_good = isinstance(value, int) and 0 <= value < _MOST
        if not is_good:
            raise ExportError(f"The episodes' table has {reprlib.repr(value)} as {name}: {path}")


def read_tasks(root: Path) -> list[str]:
    """Instructions in the order of their indices; ExportError when the table cannot be read."""
    path = root / TASKS_PATH
    if not path.exists() and (root / OLD_TASKS_PATH).exists():
        path = root / OLD_TASKS_PATH
        lines = [(line.get("task_index"), str(line.get("task"))) for line in read_json_lines(path)]
        if not all(isinstance(index, int) for index, _ in lines):
            raise ExportError(f"The tasks' table has no task_index: {path}")
        return [task for _, task in sorted(lines)]
    table = read_table(path)
    # pandas names an index column that nobody named.
    column = next((name for name in ("task", "__index_level_0__") if name in table.column_names), None)
    if (
        column is None
        or "task_index" not in table.column_names
        or not pa.types.is_integer(table.schema.field("task_index").type)
    ):
        raise ExportError(f"The tasks' table has no task or no task_index: {path}")
    rows = zip(table.column("task_index").to_pylist(), table.column(column).to_pylist(), strict=True)
    return [str(task) for _, task in sorted(rows, key=lambda row: -1 if row[0] is None else row[0])]


_NUMBERS = ("float32", "float64", "int64", "bool")


_MOST_FILES = 16
"""That a stream of rows holds open."""


class RowStream:
    """Some columns of the data files, episode after episode, in any order; one batch is in memory.

    Attributes:
        names: Of the columns, by default all that are in the data files.
    """

    def __init__(self, info: DatasetInfo, names: Sequence[str] | None = None) -> None:
        self.names = [name for name, item in info.features.items() if not item.is_video] if names is None else names
        self._features = {name: info.features[name] for name in self.names}
        kinds = {feature.dtype for feature in self._features.values()}
        self._at_once = 16 if "image" in kinds else 64 if kinds & {"string", "language"} else 4096
        self._tables: dict[Path, TableRows] = {}

    def batches(self, place: EpisodePlace) -> Iterator[pa.RecordBatch]:
        """The rows of an episode; ExportError when they cannot be read."""
        left = place.length
        for batch in self._table(place.data).read(place.first_row, place.length) if left else ():
            left -= len(batch)
            yield batch
        if left:
            raise ExportError(
                f"Episode {place.episode_index} has {place.length} frames, its data file ends before: {place.data}"
            )

    def read(self, place: EpisodePlace) -> pa.Table:
        """All rows of an episode, as `batches`; ExportError for one without any, too."""
        if not place.length:
            raise ExportError(
                f"Episode {place.episode_index} has no frames, drop that episode: its data would be in {place.data}"
            )
        return pa.Table.from_batches(list(self.batches(place)))

    def numbers(self, place: EpisodePlace) -> dict[str, NDArray[Any]]:
        """Feature -> (T, D) of an episode, (T, 1) of texts, of language digests; ExportError as `batches`, or unless
        they are as info.json says.
        """
        parts = [
            [self._values(name, batch.column(name), place) for name in self.names] for batch in self.batches(place)
        ]
        if not parts:
            return {name: np.zeros((0, 1)) for name in self.names}
        columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
        return dict(zip(self.names, columns, strict=True))

    def _values(self, name: str, column: pa.Array, place: EpisodePlace) -> NDArray[Any]:
        feature = self._features[name]
        try:
            values = column_digests(column) if feature.dtype == "language" else column_values(column)
        except (ValueError, TypeError, pa.ArrowException) as error:
            raise ExportError(f"The column {name} holds something else than numbers: {place.data}") from error
        if feature.dtype in _NUMBERS and values.shape[1:] != (math.prod(feature.shape),):
            raise ExportError(
                f"The column {name} has {values.shape[1:]} values, expected {feature.shape}: {place.data}"
            )
        return values

    def _table(self, path: Path) -> TableRows:
        found = self._tables.pop(path, None)
        if self._tables and (found is None or len(self._tables) >= _MOST_FILES):
            self._tables[next(reversed(self._tables))].rest()
        if found is None:
            found = TableRows(path, self.names, rows=self._at_once)
        self._tables[path] = found
        if len(self._tables) > _MOST_FILES:
            del self._tables[next(iter(self._tables))]
        return found


class EpisodeRows:
    """Rows of tables with a column `episode_index`, by episode; ExportError when they cannot be read.

    Args:
        paths: The tables.
        schema: Columns that they have, null where a table lacks one; by default those of the first table.
        rows: That are read at once, at most.
    """

    def __init__(self, paths: Sequence[Path], schema: pa.Schema | None = None, *, rows: int) -> None:
        self._schema, self._at_once = schema, rows
        self._stretches: dict[int, list[tuple[Path, int, int]]] = {}
        self._last: tuple[Path, TableRows] | None = None
        for path in paths:
            there, first = open_table(path, ["episode_index"]).schema_arrow, 0
            self._schema = self._schema or there.remove_metadata()
            for batch in table_batches(path, ["episode_index"], rows=_INDEX_ROWS):
                episodes = column_numbers(batch.column(0))[:, 0]
                begins = [0, *(np.flatnonzero(np.diff(episodes)) + 1).tolist()]
                for begin, end in zip(begins, [*begins[1:], len(episodes)], strict=True):
                    self._stretches.setdefault(int(episodes[begin]), []).append((path, first + begin, end - begin))
                first += len(batch)

    def read(self, episode_index: int) -> pa.Table | None:
        """All rows of an episode; None where there are none."""
        batches = [
            self._conformed(batch, path)
            for path, first, count in self._stretches.get(episode_index, ())
            for batch in self._table(path).read(first, count)
        ]
        return pa.Table.from_batches(batches) if batches else None

    def frames(self, episode_index: int, first: int, last: int) -> pa.Table | None:
        """Those whose `frame_index` is from `first` to before `last`, in order."""
        if (rows := self.read(episode_index)) is None:
            return None
        frames = rows.column("frame_index").to_numpy()
        kept = np.flatnonzero((frames >= first) & (frames < last))
        return rows.take(pa.array(kept[np.argsort(frames[kept], kind="stable")]))

    def _table(self, path: Path) -> TableRows:
        """The table, the last one of which stays open."""
        if self._last is None or self._last[0] != path:
            there = open_table(path).schema_arrow.names
            names = [item.name for item in self._schema or () if item.name in there]
            self._last = path, TableRows(path, names, rows=self._at_once)
        return self._last[1]

    def _conformed(self, batch: pa.RecordBatch, path: Path) -> pa.RecordBatch:
        try:
            columns = [
                batch.column(item.name).cast(item.type)
                if item.name in batch.schema.names
                else pa.nulls(len(batch), item.type)
                for item in self._schema or ()
            ]
            return pa.RecordBatch.from_arrays(columns, schema=self._schema)
        except (ValueError, pa.ArrowException) as error:
            raise ExportError(f"The table has columns of other types ({describe_error(error)}): {path}") from error


def column_values(column: pa.Array) -> NDArray[Any]:
    """(T, D) numbers of a column, or (T, 1) texts."""
    if str(column.type) in ("string", "large_string"):
        return np.array(column.to_pylist(), dtype=np.str_).reshape(-1, 1)
    return column_numbers(column)
