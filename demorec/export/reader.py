"""Reads a LeRobot dataset without LeRobot: episodes in order, their numbers and their coded pictures."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow.parquet as pq
from numpy.typing import NDArray

from demorec.errors import ExportError
from demorec.export.data_stats import column_numbers
from demorec.export.layout import TASKS_PATH, VIDEO_PATH, DatasetInfo, FilePosition


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
        try:
            rows = pq.read_table(path, columns=columns).to_pylist()
        except (OSError, ValueError) as error:
            raise ExportError(f"The episodes' table cannot be read ({error}): {path}") from error
        for row in rows:
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


def read_tasks(root: Path) -> list[str]:
    """Instructions in the order of their indices."""
    try:
        rows = pq.read_table(root / TASKS_PATH).to_pylist()
    except (OSError, ValueError) as error:
        raise ExportError(f"The tasks' table cannot be read ({error}): {root / TASKS_PATH}") from error
    rows.sort(key=lambda row: row["task_index"])
    # pandas names an index column that nobody named.
    return [str(row["task"] if "task" in row else row["__index_level_0__"]) for row in rows]


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
        """Feature -> (T, D) of an episode; episodes must be asked for in order."""
        if place.data != self._position:
            self._position = place.data
            path = self._root / place.data.path(self._info.data_path)
            try:
                self._batches = pq.ParquetFile(path).iter_batches(batch_size=4096, columns=self.names)
            except (OSError, ValueError) as error:
                raise ExportError(f"The data file cannot be read ({error}): {path}") from error
            self._held = {}
        while self._num_held() < place.length:
            batch = next(self._batches, None)
            if batch is None:
                raise ExportError(
                    f"Episode {place.episode_index} has {place.length} frames, its data file ends before: {self._root}"
                )
            new = {name: _column(batch.column(name)) for name in self.names}
            self._held = {
                name: np.concatenate([self._held[name], values]) if self._held else values
                for name, values in new.items()
            }
        rows = {name: values[: place.length] for name, values in self._held.items()}
        self._held = {name: values[place.length :] for name, values in self._held.items()}
        return rows

    def _num_held(self) -> int:
        return len(next(iter(self._held.values()))) if self._held else 0


def _column(column: Any) -> NDArray[Any]:
    if str(column.type) in ("string", "large_string"):
        return np.array(column.to_pylist(), dtype=np.str_).reshape(-1, 1)
    return column_numbers(column)


class PacketReader:
    """Coded pictures of one camera feature, in order over all its files."""

    def __init__(self, root: Path, info: DatasetInfo, key: str) -> None:
        self._root = root
        self._template = info.video_path or VIDEO_PATH
        self._key = key
        self._position: FilePosition | None = None
        self._container: Any = None
        self._packets: Iterator[bytes] = iter(())
        self._next = 0

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
            try:
                self._container = av.open(str(path))
            except (OSError, av.FFmpegError) as error:
                raise ExportError(f"The video cannot be opened ({error}): {path}") from error
            self._packets = _samples(self._container)
            self._position, self._next = position, 0
        if first < self._next:
            raise ExportError(f"Episode {place.episode_index} overlaps the one before it: {path}")
        for _ in range(first - self._next):  # pictures that belong to no episode
            next(self._packets, None)
        self._next = first + place.length
        for number in range(place.length):
            sample = next(self._packets, None)
            if sample is None:
                raise ExportError(
                    f"Episode {place.episode_index} has {place.length} frames, but {number} pictures: {path}"
                )
            yield sample


def _samples(container: Any) -> Iterator[bytes]:
    for packet in container.demux(video=0):
        if packet.size:
            yield bytes(packet)
