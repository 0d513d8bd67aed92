"""Uncertainty of a success rate: intervals and comparisons."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

Z95 = 1.959963984540054
"""Two-sided 95 % quantile of the normal distribution."""


@dataclass(frozen=True, kw_only=True)
class Rate:
    """k successes in n trials."""

    successes: int
    trials: int

    @property
    def value(self) -> float:
        """k / n; NaN without trials."""
        return self.successes / self.trials if self.trials else math.nan

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval of the true rate (Wilson 1927, https://doi.org/10.1080/01621459.1927.10502953)."""
        if not self.trials:
            return 0.0, 1.0
        n, p, z = self.trials, self.value, Z95
        centre = (p + z * z / (2 * n)) / (1 + z * z / n)
        half = z / (1 + z * z / n) * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
        # At k = 0 and k = n the exact bounds are 0 and 1; the formula adds rounding errors.
        low = 0.0 if self.successes == 0 else max(0.0, centre - half)
        high = 1.0 if self.successes == n else min(1.0, centre + half)
        return low, high

    def __str__(self) -> str:
        if not self.trials:
            return "0/0"
        low, high = self.interval
        return f"{self.successes}/{self.trials} = {100 * self.value:.1f} % [{100 * low:.1f}, {100 * high:.1f}]"


@dataclass(frozen=True, kw_only=True)
class RateComparison:
    """Comparison of two policies.

    Attributes:
        first, second: Their rates, each over its own scenes.
        difference: second - first.
        interval: 95 % interval of the difference: Newcombe's hybrid score interval
            (https://doi.org/10.1002/(SICI)1097-0258(19980430)17:8<873::AID-SIM779>3.0.CO;2-I, method 10).
        only_first, only_second: Number of scenes that both attempted and only one solved.
        p_value: Exact two-sided McNemar test over these scenes; 1 without such scenes.
    """

    first: Rate
    second: Rate
    difference: float
    interval: tuple[float, float]
    only_first: int
    only_second: int
    p_value: float


def compare(first: Mapping[int, bool], second: Mapping[int, bool]) -> RateComparison:
    """Compare two evaluations: scene (episode index) -> success."""
    a, b = (Rate(successes=sum(x.values()), trials=len(x)) for x in (first, second))
    (low_a, high_a), (low_b, high_b) = a.interval, b.interval
    difference = b.value - a.value
    shared = first.keys() & second.keys()
    only_first = sum(first[i] and not second[i] for i in shared)
    only_second = sum(second[i] and not first[i] for i in shared)
    return RateComparison(
        first=a,
        second=b,
        difference=difference,
        interval=(
            difference - math.hypot(b.value - low_b, high_a - a.value),
            difference + math.hypot(high_b - b.value, a.value - low_a),
        ),
        only_first=only_first,
        only_second=only_second,
        p_value=sign_test(only_first, only_second),
    )


def sign_test(k: int, m: int) -> float:
    """Two-sided exact p-value of k versus m under equal chances (the binomial form of McNemar's test)."""
    n = k + m
    tail = float(sum(math.comb(n, i) for i in range(min(k, m) + 1)) / 2**n)
    return min(1.0, 2.0 * tail)
