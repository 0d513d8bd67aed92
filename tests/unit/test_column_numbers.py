"""Numbers of data columns equal PyArrow's own Python values, from any offset in a column."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import pytest

from demorec.datasets.lerobot.files import column_numbers

COLUMNS = {
    "bool": pa.array([True, False, False, True, True, False, True, False, True, True, True]),
    "float32": pa.array(np.linspace(-1, 1, 11, dtype=np.float32)),
    "int64": pa.array([2**62, *range(10)]),
    "uint8": pa.array(list(range(245, 256)), pa.uint8()),
    "with a gap": pa.array([1.5, None, *range(9)], pa.float64()),
    "vectors": pa.FixedSizeListArray.from_arrays(pa.array(np.arange(33.0)), 3),
    "lists": pa.array([[row, row + 0.5] for row in range(11)]),
    "matrices": pa.array([[[row, 1.0], [2.0, 3.0]] for row in range(11)]),
    "bools": pa.FixedSizeListArray.from_arrays(pa.array([row % 3 == 0 for row in range(22)]), 2),
}


@pytest.mark.parametrize("name", COLUMNS)
@pytest.mark.parametrize(("first", "count"), [(0, 11), (3, 5), (8, 3), (4, 0)])
def test_columns(name: str, first: int, count: int) -> None:
    column = COLUMNS[name].slice(first, count)
    found = column_numbers(column)
    rows = [np.ravel(np.array(row, dtype=object)).tolist() for row in column.to_pylist()]
    assert [[None if value != value else value for value in row] for row in found.tolist()] == rows
