"""LeRobot's language columns: for each row a list of statements, of which most rows of an episode have the same.

The package datasets walks through every value of every statement, since one of their fields may hold JSON. Here only
the rows in which one does are left to it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

Statement = dict[str, Any]


class Statements:
    """Rows of one language column, as LeRobot gives them, in memory of their own.

    Args:
        table: Of the package datasets, with this column alone.
    """

    def __init__(self, table: Any) -> None:
        (self._name,) = table.column_names
        self._table = table
        self._lists: pa.ChunkedArray = table.with_format("arrow")[:].column(self._name)

    def take(self, rows: NDArray[np.int64]) -> list[list[Statement] | None]:
        """What stands in the given rows (B,)."""
        return [self._at(row) for row in rows.tolist()]

    def _at(self, row: int) -> list[Statement] | None:
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


def is_statements(column: pa.ChunkedArray) -> bool:
    """Whether this is a language column."""
    return bool(pa.types.is_list(column.type)) and bool(pa.types.is_struct(column.type.value_type))
