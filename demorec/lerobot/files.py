"""The files of a dataset of unknown origin, opened within bounds: JSON, Parquet tables, mp4 videos.

Anyone writes LeRobot datasets, and people pass them on. A table of a few kB can claim a thousand million rows, a video
as many pictures, and under the name of either may lie something that is no file at all.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import pyarrow as pa
import pyarrow.parquet as pq

from demorec.errors import ExportError, in_words
from demorec.plain import parse_json
from demorec.safety.files import open_regular, read_text_limited

MAX_JSON_BYTES = 32 << 20
"""Of info.json, stats.json and the like; ours have some ten kB."""
_FLOOR_BYTES = 128 << 20
_RATIO = 16
"""A table may unpack to so much, or so many times its size; rows of a robot that moves hardly compress."""
_ROWS_AT_ONCE = 64
_REPEATED = "language_"
_MOST_SAID = 4096
"""Values of the language columns in a row; what holds for an episode stands in each of its rows and compresses well."""
_BYTES_PER_VALUE = 8
_PARENT_BOXES = frozenset((b"moov", b"trak", b"mdia", b"minf", b"stbl", b"moof", b"traf"))
_MAX_BOXES = 100_000


def read_json(path: Path) -> Any:
    """The content of a JSON file of a dataset; NaN, which other writers leave in statistics, is taken.

    Raises:
        OSError: It is missing, no regular file, or very large.
        ValueError: It is no JSON, or nested very deeply.
    """
    return parse_json(read_text_limited(path, MAX_JSON_BYTES), allow_nan=True)


def open_table(path: Path, columns: Sequence[str] | None = None) -> pq.ParquetFile:
    """A Parquet file that has these columns, and whose values take no more memory than one of its size may.

    Raises:
        ExportError: It is missing, no regular file, no Parquet, lacks a column, or claims too many values.
    """
    try:
        with open_regular(path) as file:
            size = os.fstat(file.fileno()).st_size
        table = pq.ParquetFile(path)
        groups = [table.metadata.row_group(number) for number in range(table.metadata.num_row_groups)]
        parts = [group.column(number) for group in groups for number in range(group.num_columns)]
        said = sum(part.num_values for part in parts if part.path_in_schema.startswith(_REPEATED))
        values = sum(part.num_values for part in parts) - said
    except (OSError, ValueError, pa.ArrowException) as error:
        raise ExportError(f"The table cannot be read ({in_words(error)}): {path}") from error
    if _BYTES_PER_VALUE * max(values, table.metadata.num_rows) > _most_bytes(size):
        raise ExportError(f"The table claims {values:,} values in {size / 1000:,.0f} kB, so it is not read: {path}")
    if said > _MOST_SAID * table.metadata.num_rows:
        raise ExportError(f"The table claims {said:,} values of language in so few rows, so it is not read: {path}")
    missing = set(columns or ()) - set(table.schema_arrow.names)
    if missing:
        raise ExportError(f"The table has no column {', '.join(sorted(missing))}: {path}")
    return table


def read_table(path: Path, columns: Sequence[str] | None = None, *, schema: pa.Schema | None = None) -> pa.Table:
    """Some columns, or all, of a table.

    Args:
        path: The file.
        columns: Names; None for all.
        schema: Of which types the columns must be.

    Raises:
        ExportError: As `open_table`, a column has another type, or the values unpack to too much.
    """
    table = open_table(path, columns)
    for name in columns or ():
        if schema is not None and table.schema_arrow.field(name).type != schema.field(name).type:
            raise ExportError(
                f"The column {name} is {table.schema_arrow.field(name).type}, not {schema.field(name).type}: {path}"
            )
    allowed = _most_bytes(path.stat().st_size)
    batches, num_bytes = [], 0
    try:
        for batch in table.iter_batches(batch_size=_ROWS_AT_ONCE, columns=None if columns is None else list(columns)):
            batches.append(batch)
            num_bytes += batch.nbytes
            if num_bytes > allowed:
                raise ExportError(f"The table would unpack to more than {allowed / 1e6:,.0f} MB: {path}")
        return pa.Table.from_batches(batches, schema=batches[0].schema if batches else table.schema_arrow)
    except (OSError, ValueError, pa.ArrowException) as error:
        raise ExportError(f"The table cannot be read ({in_words(error)}): {path}") from error


def _most_bytes(size: int) -> int:
    return max(_FLOOR_BYTES, _RATIO * size)


def check_video(path: Path) -> None:
    """Refuse what no decoder should be given: no regular mp4 file, or one that claims more pictures than it can hold.

    Raises:
        ExportError: That.
    """
    try:
        with open_regular(path) as file:
            size = os.fstat(file.fileno()).st_size
            claimed = sum(_samples(file, 0, size, size, [_MAX_BOXES]))
    except (OSError, ValueError, struct.error) as error:
        raise ExportError(f"The video cannot be opened ({in_words(error)}): {path}") from error
    if claimed > size:
        raise ExportError(f"The video claims {claimed:,} bytes or pictures, but has {size:,} bytes: {path}")


def _samples(file: BinaryIO, start: int, end: int, size: int, left: list[int]) -> Iterator[int]:
    """What the sample tables in part of an mp4 file claim: bytes of their samples, or their number where it is larger.

    ISO/IEC 14496-12: a box has its length (1: 64 bits follow; 0: to the end) and its kind in front.
    """
    while start + 8 <= end:
        left[0] -= 1
        if left[0] < 0:
            raise ValueError(f"more than {_MAX_BOXES:,} boxes")
        file.seek(start)
        length, kind = struct.unpack(">I4s", file.read(8))
        head = 8
        if length == 1:
            (length,) = struct.unpack(">Q", file.read(8))
            head = 16
        elif length == 0:
            length = end - start
        if length < head or start + length > end:
            if start == 0:
                raise ValueError("no mp4 file")
            raise ValueError("a box that is cut off")
        if kind in _PARENT_BOXES:
            yield from _samples(file, start + head, start + length, size, left)
        elif kind in (b"stsz", b"stz2"):
            _, each, count = struct.unpack(">III", file.read(12))
            if kind == b"stsz" and each == 0 and 4 * count <= length:
                found = struct.iter_unpack(">I", file.read(4 * count))
                yield max(count, sum(number for (number,) in found))
            else:
                yield max(count, each * count if kind == b"stsz" else 0)
        elif kind == b"trun":
            yield struct.unpack(">II", file.read(8))[1]
        start += length
