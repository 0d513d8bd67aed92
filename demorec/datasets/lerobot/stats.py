"""The ten numbers that LeRobot keeps of every feature, exact: of vectors from the values, of pictures from histograms.

LeRobot estimates quantiles with histograms of 5,000 bins; here each is what `numpy.quantile` gives.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from demorec.core.geometry import Array

QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
NAMES = ("min", "max", "mean", "std", "count", *QUANTILES)


@dataclass(frozen=True, kw_only=True, eq=False)
class Statistics:
    """The ten numbers of one feature.

    Attributes:
        values: Every name of `NAMES` but "count" -> (D,) float64.
        count: Frames.
        is_camera: Pictures have the shape (channels, 1, 1) in LeRobot's files.
    """

    values: Mapping[str, Array]
    count: int
    is_camera: bool = False

    def nested(self, name: str) -> list[Any]:
        """One of them as LeRobot writes it."""
        if name == "count":
            return [self.count]
        numbers = self.values[name].tolist()
        return [[[number]] for number in numbers] if self.is_camera else numbers

    def to_json(self) -> dict[str, list[Any]]:
        """All of them."""
        return {name: self.nested(name) for name in NAMES}

    @classmethod
    def from_json(cls, entry: Mapping[str, Any]) -> Statistics | None:
        """Inverse; None when the entry has not all ten."""
        if any(name not in entry for name in NAMES):
            return None
        values = {name: np.asarray(entry[name], dtype=np.float64).reshape(-1) for name in NAMES if name != "count"}
        count = int(np.asarray(entry["count"]).reshape(-1)[0])
        return cls(values=values, count=count, is_camera=np.asarray(entry["mean"]).ndim == 3)


@dataclass(frozen=True, kw_only=True, eq=False)
class PixelHistogram:
    """How often each level of each channel occurs.

    Attributes:
        counts: (channels, levels) int64.
        level_values: (levels,) what a level stands for: 0..1 for colour, metres for depth.
        num_pictures: Of how many pictures.
    """

    counts: NDArray[np.int64]
    level_values: Array
    num_pictures: int

    def __add__(self, other: PixelHistogram) -> PixelHistogram:
        return PixelHistogram(
            counts=self.counts + other.counts,
            level_values=self.level_values,
            num_pictures=self.num_pictures + other.num_pictures,
        )

    def statistics(self) -> Statistics:
        """Exact, over all counted pixels."""
        channels = [_of_levels(counts, self.level_values) for counts in self.counts]
        values = {name: np.array([channel[name] for channel in channels]) for name in NAMES if name != "count"}
        return Statistics(values=values, count=self.num_pictures, is_camera=True)


def _of_levels(counts: NDArray[np.int64], levels: Array) -> dict[str, float]:
    total = int(counts.sum())
    present = np.flatnonzero(counts)
    mean = float((counts * levels).sum() / total)
    deviation = levels - mean
    result = {
        "min": float(levels[present[0]]),
        "max": float(levels[present[-1]]),
        "mean": mean,
        "std": math.sqrt(float((counts * deviation * deviation).sum() / total)),
    }
    cumulative = np.cumsum(counts)
    for name, q in QUANTILES.items():
        low, high, weight = quantile_ranks(q, total)
        a, b = (float(levels[np.searchsorted(cumulative, rank, side="right")]) for rank in (low, high))
        result[name] = a + (b - a) * weight
    return result


def colour_levels() -> Array:
    """What the 256 levels of a colour channel stand for: 0..1."""
    return np.arange(256) / 255.0


def vector_statistics(columns: Mapping[str, NDArray[Any]]) -> dict[str, Statistics]:
    """Of one episode: feature -> statistics, in one sort over all components.

    Args:
        columns: Feature -> (T,) or (T, D) numbers or bools.
    """
    blocks = {name: _two_dimensional(column) for name, column in columns.items()}
    matrix = np.concatenate([block.T for block in blocks.values()], axis=0, dtype=np.float64)  # (components, T)
    count = matrix.shape[1]
    mean = matrix.mean(axis=1)
    std = np.sqrt(((matrix - mean[:, None]) ** 2).mean(axis=1))
    ordered = np.sort(matrix, axis=1)
    values = {"min": ordered[:, 0], "max": ordered[:, -1], "mean": mean, "std": std}
    for name, q in QUANTILES.items():
        low, high, weight = quantile_ranks(q, count)
        values[name] = ordered[:, low] + (ordered[:, high] - ordered[:, low]) * weight
    result = {}
    start = 0
    for name, block in blocks.items():
        end = start + block.shape[1]
        result[name] = Statistics(values={key: value[start:end] for key, value in values.items()}, count=count)
        start = end
    return result


def quantile_ranks(q: float, count: int) -> tuple[int, int, float]:
    """The two order statistics between which the quantile lies, and the weight of the upper one (as NumPy)."""
    position = q * (count - 1)
    low = int(position)
    return low, min(low + 1, count - 1), position - low


def _two_dimensional(column: NDArray[Any]) -> NDArray[Any]:
    return column.reshape(len(column), -1)
