"""Errors of a dataset's statistics, which normalise training data: of the whole dataset and of each episode.

A quantile may also be the mean of the episodes' quantiles, as LeRobot computes it, or between them, as after its merge.
The deviation of a joint parked far from zero may have the rounding of LeRobot's float32.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from demorec.core.geometry import Array
from demorec.datasets.lerobot.layout import STATS_PATH
from demorec.datasets.lerobot.stats import NAMES, QUANTILES
from demorec.extensions.datasets.folder import LeRobotFolder
from demorec.extensions.datasets.inspect import OLD_STATS, episode_statistics

_MEASURED = tuple(name for name in NAMES if name != "count")
_RENUMBERED = ("index", "episode_index")
"""Columns that LeRobot's delete, split and merge renumber without updating the statistics."""
MAX_ERROR = 0.02
"""Maximum error of statistics, in standard deviations: histograms and sampling cause errors of 0.01."""
MIN_DEVIATION = 1e-4
"""Minimum standard deviation used as the unit, for elements that hardly move."""
MAX_SUMMED = 4000
"""Number of rows over which the rounding of a float32 sum accumulates: an episode of over a minute at 60 fps."""
FLOAT32_SUM = 0.25
"""Error of a float32 sum of N equal values, in N roundings of its result: rounding is uniform while the sum grows."""
FLOAT32_VARIANCE = 3 * FLOAT32_SUM
"""Error of a variance of N rows, in N roundings of the squared mean: of the mean square, and twice of the mean."""
Ranges = Array
"""(2, Q, D) minimum and maximum allowed value of each quantile."""


class StatisticError(NamedTuple):
    """The largest error of a feature's statistics.

    Attributes:
        episode: Episode whose own statistics are wrong; None for those of the whole dataset.
        place: File with the statistics.
        error: Error in standard deviations; infinite if the quantity is missing.
    """

    episode: int | None
    place: str
    feature: str
    quantity: str
    error: float


def statistic_errors(
    folder: LeRobotFolder, episodes: Mapping[int, Mapping[str, NDArray[Any]]]
) -> Iterator[StatisticError]:
    """Recompute the statistics of every numeric feature, and yield the first error in each episode and each feature.

    Those of the whole dataset are left out before v3.0, and if not all episodes are given.

    Args:
        episodes: Episode number -> feature -> (T, ...) rows.

    Raises:
        ExportError: The stored statistics cannot be read.
    """
    stats = {} if folder.info.is_old else folder.statistics
    unused = (*_RENUMBERED, *(name for name in folder.roles.having("label") if name not in stats))
    names = [name for name, f in folder.info.features.items() if f.is_numeric and name not in unused]
    yield from _of_episodes(folder, episodes, names)
    if folder.info.is_old or len(episodes) < len(folder.listed):
        return
    for name in names:
        values = [_vectors(folder, name, rows[name]) for rows in episodes.values() if name in rows]
        if not values:
            continue
        ranges = [_quantile_ranges(each) for each in values]
        count = sum(len(rows[name]) for rows in episodes.values())
        [(error, quantity)] = _largest_errors([stats.get(name)], [np.concatenate(values)], [count], ranges)
        if error > MAX_ERROR:
            yield StatisticError(None, STATS_PATH, name, quantity, error)


def _of_episodes(
    folder: LeRobotFolder, episodes: Mapping[int, Mapping[str, NDArray[Any]]], names: Sequence[str]
) -> Iterator[StatisticError]:
    entries: dict[int, dict[str, Mapping[str, Any]]] = {}
    for number, name, entry in episode_statistics(folder, names):
        entries.setdefault(number, {})[name] = entry
    place = OLD_STATS if folder.info.is_old else "the table of episodes"
    for number, rows in episodes.items():
        stored = entries.get(number, {})
        values = {name: _vectors(folder, name, rows[name]) for name in stored if name in rows}
        for length in {len(each) for each in values.values()}:
            same = [name for name, each in values.items() if len(each) == length]
            errors = _largest_errors(
                [stored[name] for name in same], [values[name] for name in same], [len(rows[name]) for name in same], ()
            )
            for name, (error, quantity) in zip(same, errors, strict=True):
                if error > MAX_ERROR:
                    yield StatisticError(number, place, name, quantity, error)
                    break


def _vectors(folder: LeRobotFolder, name: str, rows: Any) -> Array:
    """Convert rows to (N, D); arrays keep only their last dimension, as in LeRobot's statistics."""
    return np.asarray(rows, dtype=np.float64).reshape(-1, folder.info.features[name].shape[-1])


def _quantile_ranges(values: Array) -> Ranges:
    """Compute the values of the neighbouring ranks: LeRobot reads quantiles off a histogram, others interpolate."""
    ordered, last = np.sort(values, axis=0), len(values) - 1
    ranks = np.array(list(QUANTILES.values())) * last
    first_ranks, last_ranks = np.ceil(ranks) - 1, np.floor(ranks) + 1
    return ordered[np.clip([first_ranks, last_ranks], 0, last).astype(np.intp)]


def _largest_errors(
    stored: Sequence[Mapping[str, Any] | None],
    values: Sequence[Array],
    counts: Sequence[int],
    episodes: Sequence[Ranges],
) -> list[tuple[float, str]]:
    """Find the largest error of each feature's (N, D) values in standard deviations, and its quantity."""
    widths = [each.shape[1] for each in values]
    entries = [entry or {} for entry in stored]
    found = np.stack(
        [np.concatenate([_stored(e, name, w) for e, w in zip(entries, widths, strict=True)]) for name in _MEASURED]
    )
    rows = np.hstack(values)
    known = np.isfinite(rows).all(axis=0)  # another check reports the others
    rows = np.where(known, rows, 0.0)
    std = rows.std(axis=0)
    low, high = _bounds(rows, std, episodes)
    errors = np.maximum(np.maximum(low - found, found - high), 0.0) / np.maximum(std, MIN_DEVIATION)
    errors = np.where(known, np.where(np.isfinite(errors), errors, math.inf), 0.0)
    largest = []
    for entry, part, count in zip(entries, np.split(errors, np.cumsum(widths)[:-1], axis=1), counts, strict=True):
        of_quantity = dict(zip(_MEASURED, part.max(axis=1).tolist(), strict=True))
        counted = numbers_of(entry.get("count"))
        of_quantity["count"] = float(np.abs(counted - count).max()) if len(counted) else math.inf
        needed = [name for name in NAMES if name in entry or name not in QUANTILES]  # older writers have no quantiles
        worst = max(needed, key=of_quantity.__getitem__)
        largest.append((of_quantity[worst], worst))
    return largest


def _stored(entry: Mapping[str, Any], quantity: str, width: int) -> Array:
    """Return the (D,) numbers of a quantity; NaN if they are missing or have another length."""
    found = numbers_of(entry.get(quantity))
    return found if found.shape == (width,) else np.full(width, np.nan)


def _bounds(values: Array, std: Array, episodes: Sequence[Ranges]) -> tuple[Array, Array]:
    """Compute the minimum and maximum value (Q, D) of each quantity, given the rounding of LeRobot's float32."""
    low, high = values.min(axis=0), values.max(axis=0)
    mean, variance = values.mean(axis=0), std**2
    float32 = float(np.finfo(np.float32).eps)
    roundings = min(len(values), MAX_SUMMED) * float32
    slack, variance_slack = FLOAT32_SUM * roundings * np.abs(mean), FLOAT32_VARIANCE * roundings * (variance + mean**2)
    width = (high - low) / 5000  # LeRobot reads quantiles off a histogram of 5,000 bins
    ranges = np.stack([_quantile_ranges(values), *episodes])
    lowest, highest = ranges[:, 0].min(axis=0) - width, ranges[:, 1].max(axis=0) + width
    bounds = {
        "min": (low - 4 * float32 * np.abs(low), low + 4 * float32 * np.abs(low)),
        "max": (high - 4 * float32 * np.abs(high), high + 4 * float32 * np.abs(high)),
        "mean": (mean - slack, mean + slack),
        "std": (np.sqrt(np.maximum(variance - variance_slack, 0.0)), np.sqrt(variance + variance_slack)),
        **{name: (lowest[place], highest[place]) for place, name in enumerate(QUANTILES)},
    }
    return np.stack([bounds[name][0] for name in _MEASURED]), np.stack([bounds[name][1] for name in _MEASURED])


def numbers_of(value: Any) -> Array:
    """Flatten a nested entry of the statistics to (N,) numbers; (0,) for anything else, including text of numbers."""
    try:
        found = np.asarray(value)
    except (ValueError, OverflowError):
        return np.zeros(0)
    return found.reshape(-1).astype(np.float64) if found.dtype.kind in "biuf" else np.zeros(0)
