"""Robust figures: medians instead of means, so that a bad episode does not change the usual values."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from demorec.core.geometry import Array

NORMAL = 1.4826
"""Standard deviation of a normal distribution in units of its median absolute deviation."""
MAX_PERIOD = 6
"""Longest period of samples that are searched for repeats, frames."""
MIN_IN_PHASE = 4
"""Minimum number of frames in each phase of such a period."""
MIN_REGULAR = 0.95
"""Minimum ratio of frames in a phase that repeat, or do not: the clocks of sensor and recorder slip at times."""
_RESTING = 1e-9
"""Maximum variance of a column at rest, relative to its variance in the whole episode."""


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
    return [(first, end) for first, end in edges.tolist()]


def held_period(repeats: NDArray[np.bool_], moving: NDArray[np.bool_]) -> int:
    """Find the period, frames, of samples that are held: new in one phase of it, repeated in another; 1 if none.

    Args:
        repeats: (N,) whether each sample equals the previous one.
        moving: (N,) frames in which a new sample would differ.
    """
    for period in range(2, MAX_PERIOD + 1):
        phases = [repeats[phase::period][moving[phase::period]] for phase in range(period)]
        if min(map(len, phases)) < MIN_IN_PHASE:
            return 1
        shares = [float(phase.mean()) for phase in phases]
        if min(shares) <= 1 - MIN_REGULAR and max(shares) >= MIN_REGULAR:
            return period
    return 1


def finest(lags: Sequence[int], errors: NDArray[np.floating]) -> float:
    """Return the lag of the minimum error: the best of integer lags, refined by a parabola through its neighbours."""
    best = int(np.argmin(errors))
    if best in (0, len(errors) - 1):
        return float(lags[best])
    low, middle, high = (float(error) for error in errors[best - 1 : best + 2])
    bend = low - 2 * middle + high
    return lags[best] + (0.5 * (low - high) / bend if bend > 0 else 0.0)


def lagged_correlations(values: Array, others: Array, earliest: int, latest: int) -> Array:
    """Compute (L, K) correlations of columns (T, K) with the others, delayed by `earliest` to `latest` frames.

    All lags are judged by the same frames of the values. The correlation is 0 where one of the two rests.
    """
    core = values[latest : len(values) + earliest]
    core = core - core.mean(axis=0)
    others = others - others.mean(axis=0)
    windows = sliding_window_view(others, len(core), axis=0)[::-1]
    sums, squares = (np.cumsum(np.vstack([np.zeros_like(part[:1]), part]), axis=0) for part in (others, others**2))
    sizes = _ends(squares, len(core)) - _ends(sums, len(core)) ** 2 / len(core)
    sizes = np.where(sizes > _RESTING * squares[-1], sizes, 0.0) * (core**2).sum(axis=0)
    products = np.einsum("lkn,nk->lk", windows, core)
    return np.where(sizes > 0, products / np.sqrt(np.where(sizes > 0, sizes, 1.0)), 0.0)


def _ends(sums: Array, length: int) -> Array:
    """Compute (L, K) sums over windows of some length from cumulative sums, the last window first."""
    return (sums[length:] - sums[:-length])[::-1]
