"""Rows of a dataset's tables by episode, in any order, in one pass over the files and with one episode in memory."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from demorec.core.errors import ExportError, in_words
from demorec.datasets.editing.plan import Source
from demorec.datasets.lerobot.files import open_table, table_batches
from demorec.datasets.lerobot.reader import RowStream


class _SetAside:
    """Batches of rows in a file of their own, found by a number.

    Args:
        path: Of the file, which is made here.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._places: dict[int, list[int]] = {}
        self._count = 0
        self._writer: Any = None
        self._file: Any = None

    def put(self, number: int, batch: pa.RecordBatch) -> None:
        """Add rows, all with the same columns, to those of a number."""
        if self._writer is None:
            self._writer = pa.ipc.new_file(str(self._path), batch.schema)
        self._writer.write_batch(batch)
        self._places.setdefault(number, []).append(self._count)
        self._count += 1

    def read(self, number: int) -> list[pa.RecordBatch]:
        """All rows of a number; after that none are added."""
        if self._file is None and self._writer is not None:
            self._writer.close()
            # Read, not mapped: what is mapped counts as memory until the system wants it back.
            self._file = pa.ipc.open_file(pa.OSFile(str(self._path)))
        return [self._file.get_batch(place) for place in self._places.get(number, ())]


class Rows:
    """Rows of the data files by number of the episode; set aside unless they are asked for in order.

    Args:
        source: The dataset.
        names: Of the columns.
        order: Numbers of the episodes as they will be asked for.
        aside: File for rows that are not asked for in order.
    """

    def __init__(self, source: Source, names: list[str], order: list[int], aside: Path) -> None:
        self._source = source
        self._stream = RowStream(source.root, source.info, names, rows=4096 if _is_narrow(source, names) else 64)
        self._aside: _SetAside | None = None
        if order != sorted(order):
            self._aside = _SetAside(aside)
            for episode in sorted(set(order)):
                for batch in self._batches(episode):
                    self._aside.put(episode, batch)

    def _batches(self, episode: int) -> Iterator[pa.RecordBatch]:
        return self._stream.batches(self._source.places[episode])

    def read(self, episode: int) -> pa.Table:
        """All rows of an episode; ExportError when they cannot be read, or there are none."""
        batches = list(self._batches(episode)) if self._aside is None else self._aside.read(episode)
        if not batches:
            raise ExportError(f"Episode {episode} has no frames, drop it: {self._source.root}")
        return pa.Table.from_batches(batches)


def _is_narrow(source: Source, names: list[str]) -> bool:
    return all(source.info.features[name].dtype not in ("string", "image", "language") for name in names)


class RowsBeside:
    """Rows of tables with a column `episode_index`, set aside; ExportError when they cannot be read.

    Args:
        paths: The tables.
        aside: File for their rows.
        schema: Columns that they have, null where a table lacks one; by default those of the first table.
        rows: That are read at once, at most.
    """

    def __init__(self, paths: Sequence[Path], aside: Path, schema: pa.Schema | None = None, *, rows: int) -> None:
        self._aside = _SetAside(aside)
        for path in paths:
            there = open_table(path).schema_arrow
            schema = schema or there.remove_metadata()
            for found in table_batches(path, [name for name in schema.names if name in there.names], rows=rows):
                batch = _conformed(found, schema, path)
                episodes = batch.column("episode_index").to_numpy(zero_copy_only=False)
                begins = [0, *(np.flatnonzero(np.diff(episodes)) + 1).tolist()] if len(episodes) else []
                for begin, end in zip(begins, [*begins[1:], len(episodes)], strict=True):
                    self._aside.put(int(episodes[begin]), batch.slice(begin, end - begin))

    def read(self, episode_index: int) -> pa.Table | None:
        """All rows of an episode; None where there are none."""
        batches = self._aside.read(episode_index)
        return pa.Table.from_batches(batches) if batches else None

    def frames(self, episode_index: int, first: int, last: int) -> pa.Table | None:
        """Those whose `frame_index` is from `first` to before `last`, in order."""
        if (rows := self.read(episode_index)) is None:
            return None
        frames = rows.column("frame_index").to_numpy()
        kept = np.flatnonzero((frames >= first) & (frames < last))
        return rows.take(pa.array(kept[np.argsort(frames[kept], kind="stable")]))


def _conformed(batch: pa.RecordBatch, schema: pa.Schema, path: Path) -> pa.RecordBatch:
    try:
        columns = [
            batch.column(item.name).cast(item.type)
            if item.name in batch.schema.names
            else pa.nulls(len(batch), item.type)
            for item in schema
        ]
        return pa.RecordBatch.from_arrays(columns, schema=schema)
    except (ValueError, pa.ArrowException) as error:
        raise ExportError(f"The table has columns of other types ({in_words(error)}): {path}") from error
