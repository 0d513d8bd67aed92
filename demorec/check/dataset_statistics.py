"""Are a dataset's statistics, by which training normalises, those of its data: of all together and of each episode."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np

from demorec.check.base import Found, Measurement, dataset_check, worst
from demorec.check.dataset import Dataset, read_rows
from demorec.core.errors import ExportError, describe_error
from demorec.core.geometry import Array
from demorec.datasets.lerobot.files import read_json
from demorec.datasets.lerobot.layout import STATS_PATH
from demorec.datasets.lerobot.stats import NAMES, QUANTILES

_NUMBERING = ("index", "episode_index", "task_index")
_SMALLEST_DEVIATION = 1e-4
"""A component that hardly moves is measured against this."""
_STALE = 0.02
"""Value of statistics of what is no feature (any more): a warning."""
_MERGED = 0.02
"""Standard deviations by which a quantile is off at most, where it may come from LeRobot's merge: a warning."""


@dataset_check(
    measures="statistics against those recomputed from all rows, in standard deviations",
    warn=0.01,
    fail=0.05,
)
def dataset_statistics(dataset: Dataset) -> Iterator[Found]:
    """meta/stats.json: minimum, maximum, mean, deviation, count and quantiles of every feature, and of nothing else.

    A quantile may also be the mean of the episodes' ones, as LeRobot has it. Its merge takes means of the datasets' own
    instead, and drops the sidecar: without one, a quantile that lies between the episodes' own is warned of, no more.
    """
    if not dataset.rows or dataset.info.is_old:
        return
    stats = read_statistics(dataset)
    for name in _numeric(dataset):
        episodes = [_vectors(dataset, name, rows[name]) for rows in dataset.rows]
        true = {
            **statistics_of(np.concatenate(episodes)),
            "count": np.array([float(sum(len(rows[name]) for rows in dataset.rows))]),
        }
        weights = [len(values) for values in episodes]
        own = [_quantile_ranges(values) for values in episodes]
        # (2, D) of each quantile: lowest and highest that it may be.
        averaged = {q: np.average([ranges[q] for ranges in own], axis=0, weights=weights) for q in QUANTILES}
        between = {
            q: np.stack([np.min([r[q][0] for r in own], axis=0), np.max([r[q][1] for r in own], axis=0)])
            for q in QUANTILES
        }
        ranges = (_quantile_ranges(np.concatenate(episodes)), averaged)
        yield _off(stats.get(name), true, ranges, {} if dataset.sidecar else between, detail=name)
    strays = [name for name in stats if name not in dataset.info.features]
    yield Measurement(value=_STALE if strays else 0.0, detail=f"{', '.join(strays[:3])}: no feature" if strays else "")


@dataset_check(
    measures="statistics of single episodes against those recomputed, in standard deviations",
    warn=0.01,
    fail=0.05,
)
def dataset_episode_statistics(dataset: Dataset) -> Iterator[Found]:
    """The columns stats/... of the episodes' table, from which LeRobot merges those of several datasets."""
    names = _numeric(dataset)
    stored = read_rows(dataset.path / "meta", [f"stats/{name}/{quantity}" for name in names for quantity in NAMES])
    for number, (row, rows) in enumerate(zip(stored, dataset.rows, strict=False)):
        for name in names:
            said = {quantity: row[f"stats/{name}/{quantity}"] for quantity in NAMES}
            values = _vectors(dataset, name, rows[name])
            true = {**statistics_of(values), "count": np.array([float(len(rows[name]))])}
            yield _off(said, true, (_quantile_ranges(values),), detail=f"episode {number}, {name}")


def episode_column(dataset: Dataset, name: str) -> list[Any]:
    """The values of a column of the episodes' table; ExportError when there is none."""
    return [row[name] for row in read_rows(dataset.path / "meta", [name])]


def read_statistics(dataset: Dataset) -> dict[str, Any]:
    """meta/stats.json; ExportError when it cannot be read."""
    path = dataset.path / STATS_PATH
    try:
        found = read_json(path)
        if not isinstance(found, dict) or not all(isinstance(entry, dict) for entry in found.values()):
            raise ValueError("it holds no object of objects")
    except (OSError, ValueError) as error:
        raise ExportError(f"The statistics cannot be read ({describe_error(error)}): {path}") from error
    return found


def numbers_of(value: Any) -> Array:
    """(N,) numbers of an entry in the statistics, however nested; (0,) for what is none."""
    try:
        return np.asarray(value, dtype=np.float64).reshape(-1)
    except (ValueError, TypeError, OverflowError):
        return np.zeros(0)


def statistics_of(values: Array) -> dict[str, Array]:
    """The ten numbers of the rows (T, D), by NumPy alone: each (D,), the count (1,)."""
    return {
        "min": values.min(axis=0),
        "max": values.max(axis=0),
        "mean": values.mean(axis=0),
        "std": values.std(axis=0),
        "count": np.array([float(len(values))]),
        **{name: np.quantile(values, share, axis=0) for name, share in QUANTILES.items()},
    }


def _quantile_ranges(values: Array) -> dict[str, Array]:
    """Quantile -> (2, D) lowest and highest value that it has by any definition: those of the neighbouring ranks.

    LeRobot reads them off a histogram, others interpolate; where samples are far apart, the difference is large.
    """
    ordered, last = np.sort(values, axis=0), len(values) - 1
    ranks = {name: share * last for name, share in QUANTILES.items()}
    return {
        name: ordered[[max(math.ceil(rank) - 1, 0), min(math.floor(rank) + 1, last)]] for name, rank in ranks.items()
    }


def _numeric(dataset: Dataset) -> list[str]:
    """Columns of numbers, less those that number the rows: LeRobot's delete, split and merge number rows anew and leave
    their statistics as they were, and nobody normalises by them.
    """
    features = dataset.info.features
    return [name for name, feature in features.items() if feature.is_numeric and name not in _NUMBERING]


def _vectors(dataset: Dataset, name: str, rows: Any) -> Array:
    """(N, D) what LeRobot has statistics of: the rows, of arrays of several dimensions their last one."""
    return np.asarray(rows, dtype=np.float64).reshape(-1, dataset.info.features[name].shape[-1])


def _off(
    said: Mapping[str, Any] | None,
    true: Mapping[str, Array],
    ranges: Sequence[Mapping[str, Array]],
    between: Mapping[str, Array] = MappingProxyType({}),
    *,
    detail: str,
) -> Found:
    """How far the worst quantity of a feature is off; a quantile from the nearest of its ranges (2, D), and by no more
    than `_MERGED` where it lies `between` two others.
    """
    if said is None:
        return Measurement(value=math.inf, detail=f"{detail} has no statistics")
    found = []
    scale = np.maximum(true["std"], _SMALLEST_DEVIATION)
    for quantity, value in true.items():
        stored = numbers_of(said.get(quantity, np.inf))
        off, merged = math.inf, ""
        if stored.shape == value.shape:
            distance = np.abs(stored - value)
            for low, high in (known[quantity] for known in ranges if quantity in known):
                distance = np.minimum(distance, np.maximum(np.maximum(low - stored, stored - high), 0.0))
            distance = distance if quantity == "count" else distance / scale
            lowest, highest = between.get(quantity, (np.inf, -np.inf))
            is_between = (lowest <= stored) & (stored <= highest) & (distance > _MERGED)
            off = float(np.where(is_between, _MERGED, distance).max())
            merged = ", between the episodes' own, as LeRobot's merge leaves it" if off == _MERGED else ""
        found.append(Measurement(value=off, detail=f"{quantity} of {detail}{merged}"))
    return worst(*found)
