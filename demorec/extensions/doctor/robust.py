"""Robust figures: medians instead of means, so that a bad episode does not change the usual values."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from demorec.core.geometry import Array

NORMAL = 1.4826
"""Standard deviation of a normal distribution in units of its median absolute deviation."""


def usual(values: Sequence[float] | NDArray[np.floating], floor: float = 0.0) -> tuple[float, float]:
    """Return the median and the robust standard deviation, at least `floor`; NaN are ignored."""
    known = np.asarray(values, dtype=np.float64)
    known = known[np.isfinite(known)]
    if not len(known):
        return float("nan"), floor
    middle = float(np.median(known))
    return middle, max(NORMAL * float(np.median(np.abs(known - middle))), floor)


def without_gaps(values: NDArray[np.floating]) -> Array:
    """Fill gaps in (T, D) values with the preceding number; gaps at the start take the first number.

    A column without any number becomes zero.
    """
    known = np.isfinite(values)
    if known.all():
        return np.asarray(values, dtype=np.float64)
    frames = np.arange(len(values))[:, None]
    last = np.maximum.accumulate(np.where(known, frames, -1), axis=0)
    source = np.where(last >= 0, last, known.argmax(axis=0))
    return np.nan_to_num(np.take_along_axis(np.asarray(values, dtype=np.float64), source, axis=0), posinf=0, neginf=0)


def runs(flags: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return (first, end) of each run of true values in (N,) flags."""
    padded = np.concatenate([[False], flags, [False]])
    edges = np.flatnonzero(padded[1:] != padded[:-1]).reshape(-1, 2)
    return [(int(first), int(end)) for first, end in edges]


def finest(lags: Sequence[int], errors: NDArray[np.floating]) -> float:
    """Return the lag of the minimum error: the best of integer lags, refined by a parabola through its neighbours."""
    best = int(np.argmin(errors))
    if best in (0, len(errors) - 1):
        return float(lags[best])
    low, middle, high = (float(error) for error in errors[best - 1 : best + 2])
    bend = low - 2 * middle + high
    return lags[best] + (0.5 * (low - high) / bend if bend > 0 else 0.0)
