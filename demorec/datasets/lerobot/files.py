"""JSON files and Parquet tables of a dataset from any writer."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from demorec.core.errors import ExportError, describe_error, resource_error
from demorec.core.files import open_regular, read_text_limited
from demorec.core.plain import parse_json

MAX_JSON_BYTES = 32 << 20
"""Maximum size of info.json, stats.json and the like; demorec's have tens of kB."""
_BATCH_BYTES = 32 << 20
"""Size of the rows read at once, according to the table's footer."""
_ROWS_AT_ONCE = 64
_MAX_OPEN_TABLES = 16


def write_text(path: Path, text: str) -> None:
    """Write a new text file, and create its folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


def read_json(path: Path) -> Any:
    """Read a JSON file of a dataset; accepts NaN, which other writers leave in statistics. Raises OSError if it is
    missing, not a regular file, or very large, and ValueError if it is not JSON, or nested too deeply.
    """
    return parse_json(read_text_limited(path, MAX_JSON_BYTES), allow_nan=True)


def open_table(path: Path, columns: Sequence[str] | None = None) -> pq.ParquetFile:
    """Open a Parquet file with these columns for its footer; only `TableReader` reads its rows. Raises ExportError if
    it is missing, not a regular file, not Parquet, or lacks a column.
    """
    with _table_errors(path):
        open_regular(path).close()
        table = pq.ParquetFile(path, pre_buffer=False)  # buffering would hold the whole file in memory
        num_rows = table.metadata.num_rows
        groups = [table.metadata.row_group(number).num_rows for number in range(table.metadata.num_row_groups)]
        if min(groups, default=0) < 0 or sum(groups) != num_rows:
            raise ValueError(f"its row groups have {sum(groups):,} rows, its footer {num_rows:,}")
    missing = set(columns or ()) - set(table.schema_arrow.names)
    if missing:
        raise ExportError(f"The table has no column {', '.join(sorted(missing))}: {path}")
    return table


def check_tables(root: Path) -> None:
    """Read the ends of all tables and the JSON files. Raises ExportError for an empty or truncated one."""
    for file in sorted(root.rglob("*")):
        try:
            if file.suffix == ".parquet":
                open_table(file)
            elif file.suffix == ".json":
                read_json(file)
        except (OSError, ValueError) as error:
            raise ExportError(f"The dataset is damaged ({describe_error(error)}): {file}") from error


def tables_in(root: Path, place: str) -> list[Path]:
    """List the numbered tables of one kind, in order: in a dataset's folder "data", "meta/episodes" or another one."""
    return sorted(root.glob(f"{place}/*/*.parquet"))


def table_batches(
    path: Path, columns: Sequence[str] | None = None, *, rows: int = _ROWS_AT_ONCE
) -> Iterator[pa.RecordBatch]:
    """Yield all rows of some columns of a table, in batches; arguments and errors as in `TableReader`."""
    yield from TableReader(columns, rows=rows).read(path)


class TableReader:
    """Rows of tables by number; all rows of datasets are read by this class. One batch of one table is in memory.

    Rows requested in ascending order are read in one pass; row groups before the requested rows are skipped.

    Args:
        columns: Names that every table must have; None for all.
        optional: Names that are read if a table has them.
        rows: Maximum number of rows in a batch; fewer if they may be large.

    Methods raise ExportError as in `open_table`.
    """

    def __init__(
        self, columns: Sequence[str] | None = None, *, optional: Sequence[str] = (), rows: int = _ROWS_AT_ONCE
    ) -> None:
        self._columns, self._optional, self._max_rows = columns, optional, rows
        self._table = lru_cache(maxsize=_MAX_OPEN_TABLES)(lambda path: open_table(path, columns))
        self._path: Path | None = None
        self._batches: Iterator[pa.RecordBatch] = iter(())
        self._held: pa.RecordBatch | None = None
        self._next = 0

    def num_rows(self, path: Path) -> int:
        """Number of rows of a table."""
        return int(self._table(path).metadata.num_rows)

    def read(self, path: Path, first: int = 0, count: int | None = None) -> Iterator[pa.RecordBatch]:
        """Yield `count` rows from row `first`, by default all; fewer if the table ends earlier."""
        end = self.num_rows(path) if count is None else first + count
        if path != self._path or first < self._next:
            self._seek(path, first)
        while self._next < end:
            with _table_errors(path):
                batch = next(self._batches, None) if self._held is None else self._held
            if batch is None:
                return
            skipped = min(len(batch), max(0, first - self._next))
            taken = min(len(batch), end - self._next) - skipped
            rest = batch.slice(skipped + taken)
            self._held = rest if len(rest) else None
            self._next += skipped + taken
            if taken:
                yield batch.slice(skipped, taken)

    def _seek(self, path: Path, first: int) -> None:
        table = self._table(path)
        names, metadata = table.schema_arrow.names, table.metadata
        begins = np.cumsum([0, *(metadata.row_group(number).num_rows for number in range(metadata.num_row_groups))])
        group = max(0, int(np.searchsorted(begins, first, side="right")) - 1)
        groups = range(group, metadata.num_row_groups)
        columns = self._columns
        if columns is not None:
            columns = [*columns, *(name for name in self._optional if name in names and name not in columns)]
        num_rows = max(1, min(self._max_rows, _BATCH_BYTES // _row_bytes(metadata, columns)))
        self._path, self._held, self._next = path, None, int(begins[group])
        self._batches = table.iter_batches(batch_size=num_rows, row_groups=groups, columns=columns)


def read_table(path: Path, columns: Sequence[str] | None = None, *, schema: pa.Schema | None = None) -> pa.Table:
    """Read some columns of a table, or all. Raises ExportError as in `open_table`, or if `schema` has other types."""
    found = open_table(path, columns).schema_arrow
    for name in columns or ():
        if schema is not None and found.field(name).type != schema.field(name).type:
            raise ExportError(f"The column {name} is {found.field(name).type}, not {schema.field(name).type}: {path}")
    batches = list(table_batches(path, columns))
    with _table_errors(path):
        return pa.Table.from_batches(batches, schema=batches[0].schema if batches else found)


def column_values(column: pa.Array) -> NDArray[Any]:
    """Convert a column to (T, D) numbers, or (T, 1) texts."""
    if str(column.type) in ("string", "large_string"):
        return np.array(column.to_pylist(), dtype=np.str_).reshape(-1, 1)
    return column_numbers(column)


def column_numbers(column: pa.Array) -> NDArray[Any]:
    """(T, D) numbers of a data column, D = 1 for a scalar one; multi-dimensional arrays are flattened row by row."""
    flat = plain_column(column)
    if not pa.types.is_list(flat.type) and not pa.types.is_fixed_size_list(flat.type):
        return _numbers(flat).reshape(-1, 1)
    while pa.types.is_list(flat.type) or pa.types.is_fixed_size_list(flat.type):
        flat = _elements(flat)
    return _numbers(flat).reshape(len(column), -1 if len(column) else 0)


def _numbers(flat: pa.Array) -> NDArray[Any]:
    """PyArrow's own `to_numpy` would first import pandas, which takes a quarter of a second."""
    if not flat.null_count and (pa.types.is_integer(flat.type) or pa.types.is_floating(flat.type)):
        return np.from_dlpack(flat)
    if not flat.null_count and pa.types.is_boolean(flat.type):
        bits = np.unpackbits(np.frombuffer(flat.buffers()[1], np.uint8), bitorder="little")
        return bits[flat.offset : flat.offset + len(flat)].astype(bool)
    return np.asarray(flat.to_numpy(zero_copy_only=False))


def _elements(lists: pa.Array) -> pa.Array:
    """Concatenate the elements of all lists, like `flatten`, which would import pyarrow.compute when no list is
    missing.
    """
    if lists.null_count or not len(lists):
        return lists.flatten()
    if pa.types.is_list(lists.type):
        first, last = lists.offsets[0].as_py(), lists.offsets[-1].as_py()
    else:
        first, last = (row * lists.type.list_size for row in (lists.offset, lists.offset + len(lists)))
    return lists.values[first:last]


def plain_column(column: pa.Array) -> pa.Array:
    """Convert a column to lists; HF datasets, once imported, gives it one of its own array types."""
    return column.storage if isinstance(column, pa.ExtensionArray) else column


@contextmanager
def _table_errors(path: Path) -> Iterator[None]:
    try:
        yield
    except (OSError, ValueError, IndexError, KeyError, MemoryError, pa.ArrowException) as error:
        damaged = ExportError(f"The table cannot be read ({describe_error(error)}): {path}")
        raise resource_error(error, path) or damaged from error


def _row_bytes(metadata: pq.FileMetaData, columns: Sequence[str] | None) -> int:
    """Mean size of a row in some columns, bytes, at least 1."""
    beginnings = tuple(f"{name}." for name in columns or ())
    num_bytes = 0
    for group in (metadata.row_group(number) for number in range(metadata.num_row_groups)):
        for part in (group.column(number) for number in range(group.num_columns)):
            if columns is None or f"{part.path_in_schema}.".startswith(beginnings):
                num_bytes += part.total_uncompressed_size
    num_rows: int = metadata.num_rows
    return max(1, num_bytes // max(1, num_rows))
