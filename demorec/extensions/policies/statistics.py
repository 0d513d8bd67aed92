"""Uncertainty of a success rate."""

from __future__ import annotations

import math
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
