"""Parquet files that grow by row groups and roll over to the next number by size."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from demorec.datasets.lerobot.files import plain_column
from demorec.datasets.lerobot.layout import MEBIBYTE, DatasetInfo, FilePosition

_ROWS_PER_TABLE = 100
_ROWS_PER_GROUP = 4096
_BYTES_PER_GROUP = 2 * MEBIBYTE
"""Tables are collected up to this many bytes or a number of rows: a row group costs a writer and a reader far more than
its rows.
"""


def next_position(folder: Path, chunks_size: int) -> FilePosition:
    """First number without a file in a folder (chunk-CCC/file-FFF.*), counting from the last one."""
    last: FilePosition | None = None
    for path in folder.glob("chunk-*/file-*"):
        chunk, file = path.parent.name.removeprefix("chunk-"), path.stem.removeprefix("file-")
        if chunk.isdigit() and file.isdigit():
            position = FilePosition(chunk=int(chunk), file=int(file))
            if last is None or (position.chunk, position.file) > (last.chunk, last.file):
                last = position
    return FilePosition() if last is None else last.next(chunks_size)


class RollingParquet:
    """Writer of tables to numbered files; a table is never split across two of them.

    Attributes:
        position: Position of the current file, or of the next one.
        schema: Schema of the tables.

    Args:
        template: Template of the files' paths in the dataset's folder.
        info: Limits of file and folder sizes.
        repeating: Columns with dictionary encoding; all by default.
    """

    def __init__(
        self,
        root: Path,
        template: str,
        schema: pa.Schema,
        info: DatasetInfo,
        *,
        compression: str = "snappy",
        repeating: Sequence[str] | None = None,
    ) -> None:
        self._folder = template.partition("/chunk-")[0]
        self.position = next_position(root / self._folder, info.chunks_size)
        self._root = root
        self._template = template
        self.schema = schema
        self._limit = info.data_files_size_in_mb * MEBIBYTE
        self._chunks_size = info.chunks_size
        self._compression = compression
        # A dictionary of rarely repeated numbers costs time and makes the file larger.
        self._dictionary = True if repeating is None else list(repeating)
        self._rows = 0
        self._pending: list[Mapping[str, Any]] = []
        self._waiting: list[pa.Table] = []
        self._waiting_rows = 0
        self._waiting_bytes = 0
        self._sink: Any = None
        self._writer: Any = None

    def make_room(self, rows: int) -> FilePosition:
        """Begin the next file if these rows would not fit into the current one; return their position."""
        if self._writer is not None:
            size = self._sink.tell() + self._waiting_bytes
            if size * (1 + rows / max(1, self._rows)) >= self._limit:
                self._finish_file()
                self.position = self.position.next(self._chunks_size)
        return self.position

    def add_row(self, row: Mapping[str, Any]) -> None:
        """Append a row; a table is written for every few rows. Columns FOLDER/chunk_index and FOLDER/file_index record
        its position.
        """
        self._pending.append(row)
        if len(self._pending) >= _ROWS_PER_TABLE:
            self._write_rows()

    def _write_rows(self) -> None:
        if self._pending:
            position = self.make_room(len(self._pending))
            place = {f"{self._folder}/chunk_index": position.chunk, f"{self._folder}/file_index": position.file}
            self.write(pa.Table.from_pylist([{**row, **place} for row in self._pending], schema=self.schema))
            self._pending.clear()

    def write(self, table: pa.Table) -> None:
        """Append a table."""
        if self._writer is None:
            path = self._root / self.position.path(self._template)
            path.parent.mkdir(parents=True, exist_ok=True)
            self._sink = pa.OSFile(str(path), "wb")
            self._writer = pq.ParquetWriter(
                self._sink, self.schema, compression=self._compression, use_dictionary=self._dictionary
            )
            self._rows = 0
        self._waiting.append(table)
        self._waiting_rows += table.num_rows
        self._waiting_bytes += table.nbytes
        self._rows += table.num_rows
        if self._waiting_rows >= _ROWS_PER_GROUP or self._waiting_bytes >= _BYTES_PER_GROUP:
            self._write_group()

    def _write_group(self) -> None:
        if self._waiting:
            table = pa.concat_tables(self._waiting)
            self._writer.write_table(table, row_group_size=max(1, table.num_rows))
            self._waiting, self._waiting_rows, self._waiting_bytes = [], 0, 0

    def close(self) -> None:
        """Finish the last file; idempotent."""
        self._write_rows()
        if self._writer is not None:
            self._finish_file()

    def _finish_file(self) -> None:
        try:
            self._write_group()
            self._writer.close()
        finally:
            self._writer = None
            self._sink.close()

    def abort(self) -> None:
        """Close the file after an error, in any state."""
        if self._sink is not None and not self._sink.closed:
            self._writer = None
            self._sink.close()


def vector_array(values: NDArray[Any] | pa.Array, arrow_type: pa.DataType) -> pa.Array:
    """Build a column of scalars (T,) or fixed-size vectors (T, D); an existing column stays bit-exact."""
    if isinstance(values, pa.Array):
        values = plain_column(values)
        if pa.types.is_primitive(arrow_type) and not pa.types.is_primitive(values.type):
            values = _only_elements(values)
        return values if values.type == arrow_type else values.cast(arrow_type)
    if pa.types.is_fixed_size_list(arrow_type):
        flat = pa.array(np.ascontiguousarray(values).reshape(-1), arrow_type.value_type)
        return pa.FixedSizeListArray.from_arrays(flat, type=arrow_type)
    return pa.array(np.ascontiguousarray(values).reshape(-1), arrow_type)


def _only_elements(lists: pa.Array) -> pa.Array:
    """Unwrap a column of one-element lists, which other writers use for scalars; return other columns unchanged."""
    is_list = pa.types.is_list(lists.type) or pa.types.is_fixed_size_list(lists.type)
    numbers = lists.flatten() if is_list and not lists.null_count else lists
    return numbers if len(numbers) == len(lists) else lists
