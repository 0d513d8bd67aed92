"""Exact histograms of any number of values in bounded memory, without knowing their range beforehand.

Bins are 2^k wide and begin at multiples of their width, so that two neighbours make one bin of the next width and no
value is ever counted twice or moved: whatever the order in which values come, the counts are the same.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

MOST_BINS = 48
_FINEST = 40
"""Bins are no finer than 2^-40 of the largest value, so that their numbers stay exact, and no finer than 2^-40: what is
smaller counts as zero, whether a zero came before it or after."""


class Histogram:
    """Counts of finite values in bins of one width.

    Attributes:
        exponent: Bins are 2^exponent wide.
        bins: Number n of a bin -> how many values are in [n, n + 1) * 2^exponent.
        count: How many finite values there are.
        minimum, maximum, total: Of them.
        not_finite: How many values are no finite numbers.
    """

    def __init__(self) -> None:
        self.exponent = -(1 << 20)
        self.bins: dict[int, int] = {}
        self.count = self.not_finite = 0
        self.minimum, self.maximum, self.total = math.inf, -math.inf, 0.0

    @property
    def mean(self) -> float:
        """Of the finite values; NaN without any."""
        return self.total / self.count if self.count else math.nan

    @property
    def width(self) -> float:
        """Of a bin."""
        return math.ldexp(1.0, self.exponent)

    def add(self, values: NDArray[np.floating | np.integer | np.bool_]) -> None:
        """Count values of any shape."""
        flat = np.asarray(values, dtype=np.float64).ravel()
        finite = flat[np.isfinite(flat)]
        self.not_finite += len(flat) - len(finite)
        if not len(finite):
            return
        self.total += float(finite.sum())
        self.count += len(finite)
        self._make_room(float(finite.min()), float(finite.max()))
        places = np.floor(np.ldexp(finite, -self.exponent)).astype(np.int64)
        places[(places == 0) & (finite < 0)] = -1  # so small that dividing it made zero of it
        numbers, counts = np.unique(places, return_counts=True)
        self._count(zip(numbers.tolist(), counts.tolist(), strict=True), 0)

    def _make_room(self, low: float, high: float) -> None:
        """For values from `low` to `high`."""
        self.minimum, self.maximum = min(self.minimum, low), max(self.maximum, high)
        largest = max(abs(self.minimum), abs(self.maximum))
        exponent = max(self.exponent, max(math.frexp(largest)[1], 0) - _FINEST)
        while self._number(self.maximum, exponent) - self._number(self.minimum, exponent) >= MOST_BINS:
            exponent += 1
        if self.bins and exponent != self.exponent:
            old, self.bins = self.bins, {}
            self._count(old.items(), exponent - self.exponent)
        self.exponent = exponent

    @staticmethod
    def _number(value: float, exponent: int) -> int:
        return math.floor(math.ldexp(value, -exponent)) or -int(value < 0)

    def _count(self, counted: Iterable[tuple[int, int]], shift: int) -> None:
        for number, count in counted:
            self.bins[number >> shift] = self.bins.get(number >> shift, 0) + count
