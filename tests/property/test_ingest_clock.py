"""The message that a row takes, compared with a brute-force search."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from demorec.extensions.imports.clock import choose

TIMES = st.lists(st.integers(0, 10**6), min_size=1, max_size=30, unique=True).map(sorted)
ROWS = st.lists(st.integers(-10, 10**6 + 10), min_size=1, max_size=30, unique=True).map(sorted)


@given(TIMES, ROWS)
def test_nearest(times: list[int], rows: list[int]) -> None:
    chosen = choose(np.array(times), np.array(rows), "nearest")
    for row, index, age in zip(rows, chosen.index, chosen.age_ns, strict=True):
        best = min(times, key=lambda time: (abs(time - row), time))
        assert (times[index], age) == (best, row - best)
