"""LeRobot's language columns: for each row a list of statements, of which most rows of an episode have the same.

The package datasets walks through every value of every statement, since one of their fields may hold JSON. Here only
the rows in which one does are left to it, and what stands in many rows one after the other is read once.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

Statement = dict[str, Any]
_MOST_KEPT = 1024
"""Lists of statements, of some 40 each, that are kept: one an episode, as a rule."""
_SAME_BITS = {pa.float32(): pa.int32(), pa.float64(): pa.int64()}


class Statements:
    """Rows of one language column, as LeRobot gives them, in memory of their own.

    Args:
        table: Of the package datasets, with this column alone.
    """

    def __init__(self, table: Any) -> None:
        (self._name,) = table.column_names
        self._table = table
        self._lists: pa.ChunkedArray = table.with_format("arrow")[:].column(self._name)
        self._first = _first_alike(self._lists)
        self._kept: dict[int, list[Statement]] = {}

    def take(self, rows: NDArray[np.int64]) -> list[list[Statement] | None]:
        """What stands in the given rows (B,)."""
        return [self._at(row) for row in rows.tolist()]

    def _at(self, row: int) -> list[Statement] | None:
        first = int(self._first[row])
        if first < 0:
            return self._read(row)
        if first not in self._kept:
            if len(self._kept) >= _MOST_KEPT:
                del self._kept[next(iter(self._kept))]
            self._kept[first] = self._read(first) or []
        return [dict(statement) for statement in self._kept[first]]  # whoever gets it may change it

    def _read(self, row: int) -> list[Statement] | None:
        said = self._lists[row].values
        if said is None or not len(said):
            return None if said is None else []
        fields = [field.name for field in said.type]
        values = said.flatten()
        if said.null_count or not all(map(_is_plain, values)):
            found: list[Statement] = self._table[row][self._name]
            return found
        columns = [
            [None] * len(said) if array.null_count == len(said) else array.to_numpy(zero_copy_only=False).tolist()
            for array in values
        ]
        return [dict(zip(fields, statement, strict=True)) for statement in zip(*columns, strict=True)]


def _is_plain(values: pa.Array) -> bool:
    """Whether NumPy makes of these values what Python would."""
    if values.null_count == len(values) or pa.types.is_string(values.type):
        return True
    return bool(pa.types.is_floating(values.type)) and not values.null_count


def _first_alike(lists: pa.ChunkedArray) -> NDArray[np.int64]:
    """(N,) the first of the rows, one after the other, that say the same to the bit as this one; -1 for lone rows."""
    if not len(lists):
        return np.zeros(0, np.int64)
    is_like_before = np.concatenate([_like_before(chunk) for chunk in lists.chunks])
    rows = np.arange(len(lists))
    first = np.maximum.accumulate(np.where(is_like_before, 0, rows))
    is_lone = ~is_like_before & ~np.append(is_like_before[1:], False)
    return np.where(is_lone, -1, first)


def _like_before(lists: pa.ListArray) -> NDArray[np.bool_]:
    """(N,) whether a row says the same as the one before it; False where it says nothing."""
    ends = lists.offsets.to_numpy()
    lengths = np.diff(ends)
    found = np.zeros(len(lists), dtype=np.bool_)
    if lists.null_count or lists.values.null_count:
        return found
    turns = np.flatnonzero(np.diff(lengths)) + 1
    for start, end in zip([0, *turns.tolist()], [*turns.tolist(), len(lists)], strict=True):
        length = int(lengths[start]) if start < len(lists) else 0
        if length and end - start > 1:
            said = lists.values.slice(int(ends[start]), int(ends[end] - ends[start]))
            alike = _alike(said[:-length], said[length:])
            found[start + 1 : end] = alike.reshape(-1, length).all(axis=1)
    return found


def _alike(one: pa.StructArray, other: pa.StructArray) -> NDArray[np.bool_]:
    """(N,) whether statements are equal to the bit; False for those with values that are no text and no number."""
    found = np.ones(len(one), dtype=np.bool_)
    for a, b in zip(one.flatten(), other.flatten(), strict=True):
        same = pc.and_(a.is_null(), b.is_null())
        if pa.types.is_string(a.type) or a.type in _SAME_BITS:
            kind = _SAME_BITS.get(a.type, a.type)
            same = pc.or_(same, pc.fill_null(pc.equal(a.view(kind), b.view(kind)), False))
        found &= same.to_numpy(zero_copy_only=False)
    return found


def is_statements(column: pa.ChunkedArray) -> bool:
    """Whether this is a language column."""
    return bool(pa.types.is_list(column.type)) and bool(pa.types.is_struct(column.type.value_type))
