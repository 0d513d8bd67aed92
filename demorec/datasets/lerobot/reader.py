"""Reads a LeRobot dataset without LeRobot: episodes in order, their numbers and their coded pictures."""

from __future__ import annotations

import math
import reprlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from demorec.core.errors import ExportError, in_words
from demorec.datasets.lerobot.data_stats import column_numbers
from demorec.datasets.lerobot.files import check_video, read_table, table_batches
from demorec.datasets.lerobot.language import column_digests
from demorec.datasets.lerobot.layout import TASKS_PATH, VIDEO_PATH, DatasetInfo, FilePosition

_MOST = 1 << 40
"""Above all rows, frames and seconds of any dataset."""


@dataclass(frozen=True, kw_only=True)
class EpisodePlace:
    """Where an episode lies.

    Attributes:
        episode_index, length, tasks: As the episodes' table has them.
        data: File of its rows.
        from_index: Of its first row over the whole dataset.
        videos: Camera feature -> (file, first picture in it).
    """

    episode_index: int
    length: int
    tasks: tuple[str, ...]
    data: FilePosition
    from_index: int
    videos: dict[str, tuple[FilePosition, int]]


def episode_places(root: Path, info: DatasetInfo) -> Iterator[EpisodePlace]:
    """Every episode in order; ExportError when a table cannot be read."""
    keys = info.video_keys
    columns = ["episode_index", "length", "tasks", "data/chunk_index", "data/file_index", "dataset_from_index"]
    for key in keys:
        columns += [f"videos/{key}/{name}" for name in ("chunk_index", "file_index", "from_timestamp")]
    for path in sorted((root / "meta" / "episodes").glob("*/*.parquet")):
        for row in read_table(path, columns).to_pylist():
            _check_place(row, path)
            yield EpisodePlace(
                episode_index=row["episode_index"],
                length=row["length"],
                tasks=tuple(row["tasks"]),
                data=FilePosition(chunk=row["data/chunk_index"], file=row["data/file_index"]),
                from_index=row["dataset_from_index"],
                videos={
                    key: (
                        FilePosition(chunk=row[f"videos/{key}/chunk_index"], file=row[f"videos/{key}/file_index"]),
                        round(row[f"videos/{key}/from_timestamp"] * info.fps),
                    )
                    for key in keys
                },
            )


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


class RowReader:
    """Rows of the data files, episode after episode; keeps one file's row group in memory."""

    def __init__(self, root: Path, info: DatasetInfo) -> None:
        self._root = root
        self._info = info
        self.names = [name for name, feature in info.features.items() if not feature.is_video]
        self._position: FilePosition | None = None
        self._batches: Iterator[Any] = iter(())
        self._held: dict[str, NDArray[Any]] = {}

    def read(self, place: EpisodePlace) -> dict[str, NDArray[Any]]:
        """Feature -> (T, D) of an episode, of language columns digests; episodes must be asked for in order."""
        if place.data != self._position:
            self._position = place.data
            path = self._root / place.data.path(self._info.data_path)
            has_strings = any(feature.dtype in ("string", "language") for feature in self._info.features.values())
            self._batches = table_batches(path, self.names, rows=64 if has_strings else 4096)
            self._held = {}
        while self._num_held() < place.length:
            batch = next(self._batches, None)
            if batch is None:
                raise ExportError(
                    f"Episode {place.episode_index} has {place.length} frames, its data file ends before: {self._root}"
                )
            new = {name: self._column(name, batch.column(name)) for name in self.names}
            self._held = {
                name: np.concatenate([self._held[name], values]) if self._held else values
                for name, values in new.items()
            }
        rows = {name: values[: place.length] for name, values in self._held.items()}
        self._held = {name: values[place.length :] for name, values in self._held.items()}
        return rows

    def _column(self, name: str, column: Any) -> NDArray[Any]:
        """(N, D) of a feature, (N, 1) digests of language; ExportError unless it is as info.json says."""
        feature = self._info.features[name]
        try:
            values = column_digests(column) if feature.dtype == "language" else _column(column)
        except (ValueError, TypeError, pa.ArrowException) as error:
            raise ExportError(f"The column {name} holds something else than numbers: {self._root}") from error
        if feature.dtype in _NUMBERS and values.shape[1:] != (math.prod(feature.shape),):
            raise ExportError(
                f"The column {name} has {values.shape[1:]} values, expected {feature.shape}: {self._root}"
            )
        return values

    def _num_held(self) -> int:
        return len(next(iter(self._held.values()))) if self._held else 0


def _column(column: Any) -> NDArray[Any]:
    if str(column.type) in ("string", "large_string"):
        return np.array(column.to_pylist(), dtype=np.str_).reshape(-1, 1)
    return column_numbers(column)


class PacketReader:
    """Coded pictures of one camera feature, in order over all its files.

    Attributes:
        keyframe: Number, in its file, of the keyframe from which on the picture read last can be decoded; -1 for none.
    """

    def __init__(self, root: Path, info: DatasetInfo, key: str) -> None:
        self._root = root
        self._template = info.video_path or VIDEO_PATH
        self._key = key
        self._position: FilePosition | None = None
        self._container: Any = None
        self._packets: Iterator[av.Packet] = iter(())
        self._next = 0
        self.keyframe = -1

    def close(self) -> None:
        """Close the open file; harmless when called twice."""
        if self._container is not None:
            self._container.close()
            self._container = None

    def read(self, place: EpisodePlace) -> Iterator[bytes]:
        """The samples of an episode as they lie in the mp4 file; episodes must be asked for in order."""
        position, first = place.videos[self._key]
        path = self._root / position.path(self._template, self._key)
        if position != self._position:
            self.close()
            check_video(path)
            try:
                self._container = av.open(str(path), format="mp4")
            except (OSError, av.FFmpegError) as error:
                raise ExportError(f"The video cannot be opened ({in_words(error)}): {path}") from error
            self._packets = (packet for packet in self._container.demux(video=0) if packet.size)
            self._position, self._next, self.keyframe = position, 0, -1
        if first < self._next:
            raise ExportError(f"Episode {place.episode_index} overlaps the one before it: {path}")
        begin, self._next = self._next, first + place.length
        for number in range(begin, self._next):  # those before the first belong to no episode
            packet = next(self._packets, None)
            if packet is None:
                raise ExportError(
                    f"Episode {place.episode_index} has {place.length} frames, but {max(0, number - first)} pictures: "
                    f"{path}"
                )
            if packet.is_keyframe:
                self.keyframe = number
            if number >= first:
                yield bytes(packet)
