"""Are a dataset's statistics, by which training normalises, those of its data: of all together and of each episode."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations
from types import MappingProxyType
from typing import Any

import numpy as np

from demorec.check.base import Found, Measurement, dataset_check, worst
from demorec.check.dataset import Dataset
from demorec.check.films import Film
from demorec.core.errors import ExportError, describe_error
from demorec.core.geometry import Array
from demorec.datasets.lerobot.files import read_json, rows_in
from demorec.datasets.lerobot.layout import STATS_PATH
from demorec.datasets.lerobot.stats import NAMES, QUANTILES

_NUMBERING = ("index", "episode_index", "task_index")
_SMALLEST_DEVIATION = 1e-4
"""A component that hardly moves is measured against this."""
_STALE = 0.02
"""Value of statistics of what is no feature (any more): a warning."""
_MERGED = 0.02
"""Standard deviations by which a quantile is off at most, where it may come from LeRobot's merge: a warning."""
_DOUBTFUL, _CLEARLY = 0.012, 0.35
"""How far colours are off, of 1, that may be another's, and the share of that by which they are off those of that one.
Of single episodes they are off by up to 0.007, since LeRobot takes a sample of images; nearest to others' by 0.0015."""
_IN_ORDER = ("min", "q01", "q10", "q50", "q90", "q99", "max")
"""Statistics from the smallest to the largest."""


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
        count, weights = sum(len(rows[name]) for rows in dataset.rows), [len(values) for values in episodes]
        each = [_quantile_ranges(values) for values in episodes]
        own = {q: np.stack([ranges[q] for ranges in each]) for q in QUANTILES}  # (E, 2, D)
        averaged = {q: np.average(ranges, axis=0, weights=weights) for q, ranges in own.items()}
        between = {q: np.stack([ranges[:, 0].min(axis=0), ranges[:, 1].max(axis=0)]) for q, ranges in own.items()}
        merged = {} if dataset.sidecar else between
        yield _off(stats.get(name), np.concatenate(episodes), count, name, averaged, merged)
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
    columns = [f"stats/{name}/{quantity}" for name in names for quantity in NAMES]
    stored = list(rows_in(dataset.path, "meta/episodes", columns))
    for number, (row, rows) in enumerate(zip(stored, dataset.rows, strict=False)):
        for name in names:
            said = {quantity: row[f"stats/{name}/{quantity}"] for quantity in NAMES}
            yield _off(said, _vectors(dataset, name, rows[name]), len(rows[name]), f"episode {number}, {name}")


def episode_column(dataset: Dataset, name: str) -> list[Any]:
    """The values of a column of the episodes' table; ExportError when there is none."""
    return [row[name] for row in rows_in(dataset.path, "meta/episodes", [name])]


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
    values: Array,
    count: int,
    detail: str,
    averaged: Mapping[str, Array] = MappingProxyType({}),
    between: Mapping[str, Array] = MappingProxyType({}),
) -> Found:
    """How far the worst quantity of a feature is off, by its rows (T, D) of so many frames; a quantile from the nearer
    one of its ranges, also the `averaged` one, and by no more than `_MERGED` where it lies `between` two others.
    """
    if said is None:
        return Measurement(value=math.inf, detail=f"{detail} has no statistics")
    true = {name: getattr(values, name)(axis=0) for name in ("min", "max", "mean", "std")}
    true |= {"count": np.array([float(count)])}
    true |= {name: np.quantile(values, share, axis=0) for name, share in QUANTILES.items()}
    found, ranges = [], _quantile_ranges(values)
    scale = np.maximum(true["std"], _SMALLEST_DEVIATION)
    for quantity, value in true.items():
        stored = numbers_of(said.get(quantity, np.inf))
        off, merged = math.inf, ""
        if stored.shape == value.shape:
            distance = np.abs(stored - value)
            for low, high in (known[quantity] for known in (ranges, averaged) if quantity in known):
                distance = np.minimum(distance, np.maximum(np.maximum(low - stored, stored - high), 0.0))
            distance = distance if quantity == "count" else distance / scale
            lowest, highest = between.get(quantity, (np.inf, -np.inf))
            is_between = (lowest <= stored) & (stored <= highest) & (distance > _MERGED)
            off = float(np.where(is_between, _MERGED, distance).max())
            merged = ", between the episodes' own, as LeRobot's merge leaves it" if off == _MERGED else ""
        found.append(Measurement(value=off, detail=f"{quantity} of {detail}{merged}"))
    return worst(*found)


@dataset_check(
    measures="colours in the statistics against decoded images, of 1",
    warn=0.04,
    fail=0.08,
    needs_images=True,
)
def dataset_image_statistics(dataset: Dataset) -> Iterator[Found]:
    """Mean and deviation of each camera's colours, of all episodes and in each of them, are those of its images; its
    other statistics are colours of 0 to 1 in their order, as many as of other features."""
    if dataset.info.is_old:
        return
    stats, of_cameras = read_statistics(dataset), {}
    for key, films in dataset.films.items():
        if not films:
            continue
        told, weights = stats.get(key, {}), [len(film.cells) for film in films]
        own = [_colours(film) for film in films]
        of_all = _pooled(own, weights)
        yield _off_colour(told.get("mean"), of_all[:3], key)
        yield _off_colour(told.get("std"), of_all[3:], f"deviation of {key}")
        yield _disordered(told, stats, key)
        columns = [episode_column(dataset, f"stats/{key}/{quantity}") for quantity in ("mean", "std")]
        for quantity, part, stated in zip(("mean", "std"), (slice(3), slice(3, 6)), columns, strict=True):
            for number, (said, colours) in enumerate(zip(stated, own, strict=False)):
                yield _off_colour(said, colours[part], f"{quantity} of {key}, episode {number}")
        stated = [np.concatenate([numbers_of(said) for said in pair]) for pair in zip(*columns, strict=True)]
        yield _exchanged(stated, own, [f"{key}, episode {number}" for number in range(len(own))])
        said = np.concatenate([numbers_of(told.get("mean")), numbers_of(told.get("std"))])
        known = len(stated) == len(own) and all(one.shape == of_all.shape and (abs(one) <= 1).all() for one in stated)
        of_cameras[key] = said, of_all, _pooled(stated, weights) if known else of_all
    # LeRobot merges the episodes' own, which are nearer to what it says of all than images that were encoded.
    for true in (1, 2):
        yield _exchanged([c[0] for c in of_cameras.values()], [c[true] for c in of_cameras.values()], list(of_cameras))


def _colours(film: Film) -> Array:
    """(6,) mean and deviation of three colours of all pixels, of 1."""
    assert film.deviation is not None
    return np.concatenate([film.cells.mean(axis=(0, 1, 2), dtype=np.float64) / 255, film.deviation])


def _pooled(parts: Sequence[Array], weights: Sequence[int]) -> Array:
    """(6,) mean and deviation of three colours of all, by those of each part."""
    means, deviations = np.array(parts)[:, :3], np.array(parts)[:, 3:]
    mean = np.average(means, axis=0, weights=weights)
    squares = np.average(deviations**2 + means**2, axis=0, weights=weights)
    return np.concatenate([mean, np.sqrt(np.maximum(squares - mean**2, 0.0))])


def _off_colour(said: Any, true: Array, detail: str) -> Measurement:
    stated = numbers_of(said)
    if stated.shape != (3,) or not np.isfinite(stated).all():
        return Measurement(value=math.inf, detail=detail)
    off = np.nan_to_num(np.abs(stated - true))  # NaN: too few images were seen
    return Measurement(value=float(off.max()), detail=detail)


def _exchanged(said: Sequence[Array], true: Sequence[Array], names: Sequence[str]) -> Measurement:
    """Whether the colours that are said of one are those of another, and the other way round; 1 for such a pair."""
    doubtful = []
    for told, own, name in zip(said, true, names, strict=False):
        if len(told) == len(own) and np.isfinite(told).all() and (off := _mean_off(told, own)) > _DOUBTFUL:
            doubtful.append((told, own, off, name))
    for one, other in combinations(doubtful, 2):
        if _mean_off(one[0], other[1]) + _mean_off(other[0], one[1]) < _CLEARLY * (one[2] + other[2]):
            return Measurement(value=1.0, detail=f"exchanged: {one[3]} and {other[3]}")
    return Measurement(value=0.0, detail="")


def _mean_off(told: Array, true: Array) -> float:
    """Mean difference; what is NaN in `true` is not known."""
    return float(np.nanmean(np.abs(np.subtract(told, true))))


def _disordered(told: Mapping[str, Any], stats: Mapping[str, Any], key: str) -> Measurement | None:
    """How far statistics of a camera are beyond those that they must not exceed."""
    names = [name for name in _IN_ORDER if any(name in entry for entry in stats.values())]
    if lacking := [name for name in names if name not in told]:
        return Measurement(value=math.inf, detail=f"{key} has no {', '.join(lacking)}")
    rows = [numbers_of(told[name]) for name in names]
    if any(row.shape != (3,) or not np.isfinite(row).all() for row in rows):
        return Measurement(value=math.inf, detail=f"{', '.join(names)} of {key}")
    steps = np.diff([np.zeros(3), *rows, np.ones(3)], axis=0)
    return Measurement(value=max(float(-steps.min()), 0.0), detail=f"order of {', '.join(names)} of {key}")
