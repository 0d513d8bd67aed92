"""Columns of a table as arrays, from which the rows of a whole batch are taken at once.

A table of LeRobot is a memory-mapped Arrow file in chunks. Long columns stay in that memory, which several processes
share; short ones are joined, so that one index is enough to take rows from them.

Language columns hold a list of statements in each row, the same in most rows of an episode. The package datasets
converts every value of every statement, since one of their fields may hold JSON. Here it converts only rows with JSON,
and equal rows are converted once.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pyarrow as pa
import torch
from numpy.typing import NDArray

_JOINED_BYTES = 64 << 20
"""Maximum size of a column for its chunks to be joined."""


class Column:
    """Numbers of one feature, a row for each frame.

    Args:
        chunks: Consecutive arrays (n, ...), at least one.
    """

    def __init__(self, chunks: Sequence[NDArray[Any]]) -> None:
        joined = len(chunks) == 1 or sum(chunk.nbytes for chunk in chunks) <= _JOINED_BYTES
        self._chunks = [np.concatenate(chunks)] if joined and len(chunks) > 1 else list(chunks)
        self._starts = np.cumsum([0, *(len(chunk) for chunk in self._chunks)])

    def __len__(self) -> int:
        return int(self._starts[-1])

    def take(self, rows: NDArray[np.int64]) -> NDArray[Any]:
        """Take rows: an array of `rows.shape` and the shape of a value, in new memory."""
        if len(self._chunks) == 1:
            return self._chunks[0][rows]
        flat = rows.reshape(-1)
        order = np.argsort(flat, kind="stable")
        in_order = flat[order]
        bounds = np.searchsorted(in_order, self._starts)
        taken = np.empty((len(flat), *self._chunks[0].shape[1:]), self._chunks[0].dtype)
        for number in np.flatnonzero(np.diff(bounds)):
            part = slice(bounds[number], bounds[number + 1])
            taken[order[part]] = self._chunks[number][in_order[part] - self._starts[number]]
        return taken.reshape(*rows.shape, *taken.shape[1:])

    def tensor(self, rows: NDArray[np.int64]) -> torch.Tensor:
        """Take rows as a tensor of the type that `torch.tensor` gives to numbers of Python."""
        values = torch.from_numpy(self.take(rows))
        if values.dtype.is_floating_point:
            return values.to(torch.get_default_dtype())
        return values if values.dtype == torch.bool else values.to(torch.int64)


def numbers(column: pa.ChunkedArray) -> Column | None:
    """Convert a column to arrays; None unless it holds only numbers of one shape, without gaps."""
    chunks = [_array(chunk) for chunk in column.chunks if len(chunk)]
    known = [chunk for chunk in chunks if chunk is not None]
    if not known or len(known) < len(chunks) or len({chunk.shape[1:] for chunk in known}) > 1:
        return None
    return Column(known)


def _array(chunk: pa.Array) -> NDArray[Any] | None:
    """View a chunk as an array (n, ...), a copy if it holds bits (bool); None as in `numbers`."""
    shape = [len(chunk)]
    while True:
        if chunk.null_count:
            return None
        if isinstance(chunk, pa.ExtensionArray):
            chunk = chunk.storage
        elif pa.types.is_fixed_size_list(chunk.type):
            shape.append(chunk.type.list_size)
            chunk = chunk.flatten()
        elif pa.types.is_list(chunk.type) or pa.types.is_large_list(chunk.type):
            lengths = np.diff(chunk.offsets.to_numpy())
            if not len(lengths) or (lengths != lengths[0]).any():
                return None
            shape.append(int(lengths[0]))
            chunk = chunk.flatten()
        else:
            break
    is_number = pa.types.is_float32(chunk.type) or pa.types.is_float64(chunk.type) or pa.types.is_boolean(chunk.type)
    is_number = is_number or (pa.types.is_integer(chunk.type) and chunk.type != pa.uint64())
    if not is_number or not math.prod(shape):
        return None
    values: NDArray[Any] = chunk.to_numpy(zero_copy_only=False)
    return values.reshape(shape)


Statement = dict[str, Any]
_MAX_KEPT_LISTS = 1024
"""Lists of about 40 statements that are kept, usually one per episode."""
_BITS = {pa.float32(): pa.int32(), pa.float64(): pa.int64()}


class Statements:
    """Rows of one language column, as LeRobot returns them.

    Args:
        table: Table of the package datasets, with this column alone.
    """

    def __init__(self, table: Any) -> None:
        (self._name,) = table.column_names
        self._table = table
        self._lists: pa.ChunkedArray = table.with_format("arrow")[:].column(self._name)
        self._bits = pa.chunked_array(map(_as_bits, self._lists.chunks or [self._lists.combine_chunks()]))
        self._places = np.full(len(self._lists), -1, np.int32)
        self._kept: list[list[Statement]] = []
        self._known: dict[tuple[pa.Scalar, pa.Scalar], int] = {}

    def take(self, rows: NDArray[np.int64]) -> list[list[Statement] | None]:
        """Take the given rows (B,)."""
        return [self._at(row) for row in rows.tolist()]

    def _at(self, row: int) -> list[Statement] | None:
        place = self._places[row]
        if place < 0:
            bits = self._bits[row]
            statements = bits.values
            if statements is None or not len(statements):
                return None if statements is None else []
            key = statements[len(statements) - 1], bits  # Arrow's hash of a list is that of its length
            if key not in self._known:
                found = self._read(row)
                if found is None:
                    of_table: list[Statement] = self._table[row][self._name]
                    return of_table
                if len(self._kept) >= _MAX_KEPT_LISTS:
                    self._places.fill(-1)
                    self._kept.clear()
                    self._known.clear()
                self._known[key] = len(self._kept)
                self._kept.append(found)
            place = self._places[row] = self._known[key]
        return [dict(statement) for statement in self._kept[place]]  # the caller may change it

    def _read(self, row: int) -> list[Statement] | None:
        """Convert a row; None if a value is more than text or a number."""
        statements = self._lists[row].values
        values = statements.flatten()
        if statements.null_count or not all(map(_is_plain, values)):
            return None
        columns = [
            [None] * len(statements)
            if array.null_count == len(statements)
            else array.to_numpy(zero_copy_only=False).tolist()
            for array in values
        ]
        fields = [field.name for field in statements.type]
        return [dict(zip(fields, statement, strict=True)) for statement in zip(*columns, strict=True)]


def _is_plain(values: pa.Array) -> bool:
    """Whether NumPy converts these values as Python does."""
    if values.null_count == len(values) or pa.types.is_string(values.type):
        return True
    return bool(pa.types.is_floating(values.type)) and not values.null_count


def _as_bits(lists: pa.ListArray) -> pa.ListArray:
    """Replace floats by their bits, so that 0.0 differs from -0.0 and NaN equals NaN."""
    if lists.null_count:  # Arrow takes no mask with offsets that begin within an array
        lists = lists.take(pa.array(range(len(lists))))
    statements = lists.values
    values = [array.view(_BITS[array.type]) if array.type in _BITS else array for array in statements.flatten()]
    names = [field.name for field in statements.type]
    alike = pa.StructArray.from_arrays(values, names, mask=statements.is_null() if statements.null_count else None)
    return pa.ListArray.from_arrays(lists.offsets, alike, mask=lists.is_null() if lists.null_count else None)


def is_statements(column: pa.ChunkedArray) -> bool:
    """Whether this is a language column."""
    return bool(pa.types.is_list(column.type)) and bool(pa.types.is_struct(column.type.value_type))
