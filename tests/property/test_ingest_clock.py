"""The message that a row takes, compared with a brute-force search."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from demorec.extensions.imports.clock import MISSING, ChosenSamples, choose, sampled

TIMES = st.lists(st.integers(0, 10**6), min_size=1, max_size=30, unique=True).map(sorted)
ROWS = st.lists(st.integers(-10, 10**6 + 10), min_size=1, max_size=30, unique=True).map(sorted)


def _chosen(index: NDArray[np.int64], fraction: NDArray[np.float64]) -> ChosenSamples:
    return ChosenSamples(index=index, fraction=fraction, age_ns=np.zeros_like(index), reach_ns=np.zeros_like(index))


@given(TIMES, ROWS)
def test_latest(times: list[int], rows: list[int]) -> None:
    chosen = choose(np.array(times), np.array(rows), "latest")
    for row, index, age in zip(rows, chosen.index, chosen.age_ns, strict=True):
        before = [time for time in times if time <= row]
        if not before:
            assert (index, age) == (-1, MISSING)
        else:
            assert (times[index], age) == (before[-1], row - before[-1])


@given(TIMES, ROWS)
def test_nearest(times: list[int], rows: list[int]) -> None:
    chosen = choose(np.array(times), np.array(rows), "nearest")
    for row, index, age in zip(rows, chosen.index, chosen.age_ns, strict=True):
        best = min(times, key=lambda time: (abs(time - row), time))
        assert (times[index], age) == (best, row - best)


@given(TIMES, ROWS)
def test_linear(times: list[int], rows: list[int]) -> None:
    values = np.array([[3.0 * time + 1.0] for time in times])
    chosen = choose(np.array(times), np.array(rows), "linear")
    inside = np.array([times[0] <= row <= times[-1] for row in rows])
    assert np.array_equal(chosen.reach_ns == MISSING, ~inside)
    assert chosen.fraction is not None
    part = _chosen(chosen.index[inside], chosen.fraction[inside])
    mixed = sampled(values, np.arange(len(times)), part, unit="", quaternions=())
    assert np.allclose(mixed[:, 0], [3.0 * row + 1.0 for row, ok in zip(rows, inside, strict=True) if ok], atol=1e-6)
    widest = max(np.diff(times), default=0)
    assert np.all(chosen.reach_ns[inside] <= widest)
    assert np.all(np.diff(np.array(rows)[inside] - chosen.age_ns[inside]) >= 0)


@given(st.floats(-3.0, 3.0), st.floats(-3.0, 3.0), st.floats(0.0, 1.0))
def test_angles_go_the_short_way_round(first: float, turn: float, fraction: float) -> None:
    wrapped = (first + turn + np.pi) % (2 * np.pi) - np.pi
    chosen = _chosen(np.array([0]), np.array([fraction]))
    (mixed,) = sampled(np.array([[first], [wrapped]]), np.arange(2), chosen, unit="rad", quaternions=())[0]
    assert abs((mixed - (first + fraction * turn) + np.pi) % (2 * np.pi) - np.pi) < 1e-9


@given(st.integers(0, 2**31), st.floats(0.0, 1.0))
def test_quaternions_against_scipy(seed: int, fraction: float) -> None:
    pair = Rotation.random(2, random_state=seed)
    chosen = _chosen(np.array([0]), np.array([fraction]))
    values = pair.as_quat()
    values[1] *= -1 if seed % 2 else 1  # the same rotation
    mixed = sampled(values, np.arange(2), chosen, unit="", quaternions=(0,))[0]
    expected = Slerp([0, 1], pair)([fraction])
    assert (Rotation.from_quat(mixed).inv() * expected[0]).magnitude() < 1e-6
