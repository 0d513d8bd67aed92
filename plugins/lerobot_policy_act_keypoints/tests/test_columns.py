"""Rows of columns, joined or in chunks."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st


@given(
    lengths=st.lists(st.integers(1, 5), min_size=1, max_size=6),
    rows=st.lists(st.integers(0, 10**6), max_size=12),
    joined=st.booleans(),
)
def test_rows_are_taken_from_any_chunks(lengths: list[int], rows: list[int], joined: bool) -> None:
    from lerobot_policy_act_keypoints import columns
    from lerobot_policy_act_keypoints.columns import Column

    values = np.arange(3 * sum(lengths), dtype=np.float32).reshape(-1, 3)
    chunks = np.split(values, np.cumsum(lengths)[:-1])
    wanted = np.array([row % len(values) for row in rows], np.int64)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(columns, "_JOINED_BYTES", 1 << 20 if joined else 0)
        column = Column(chunks)
    assert len(column) == len(values)
    assert np.array_equal(column.take(wanted), values[wanted])
    assert np.array_equal(column.take(wanted.reshape(1, -1)), values[wanted][None])
