"""Checks of a dataset's statistics, by which training normalises: of the whole dataset and of each episode."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from demorec.check.base import Found, Measurement, NotMeasured, dataset_check
from demorec.check.dataset import CheckedDataset
from demorec.core.geometry import Array
from demorec.datasets.lerobot.files import open_table, rows_in, tables_in
from demorec.datasets.lerobot.stats import NAMES, QUANTILES

_NUMBERING = ("index", "episode_index", "task_index")
"""Columns that LeRobot's delete, split and merge renumber without new statistics, except for the count."""
MIN_DEVIATION = 1e-4
"""Deviation by which an element that hardly moves is measured."""
MERGED_ERROR = 0.02
"""Reported error of a quantile between those of the episodes, as LeRobot's merge leaves it: a warning."""

Ranges = Mapping[str, Array]
"""Quantile -> (2, D) lowest and highest value that it may have."""


@dataset_check(
    measures="statistics against those recomputed from all rows, in standard deviations",
    warn=0.01,
    fail=0.05,
)
def dataset_statistics(dataset: CheckedDataset) -> Iterator[Found]:
    """Recompute minimum, maximum, mean, deviation, count and quantiles of every feature, and of each episode.

    A quantile may also be the mean of the episodes' quantiles, as LeRobot computes it. LeRobot's merge averages those
    of the datasets instead, and drops the sidecar: without one, a quantile between the episodes' own is a warning.
    """
    if dataset.info.is_old:
        return
    stats = dataset.folder.statistics
    features = dataset.info.features
    names = [name for name, feature in features.items() if feature.is_numeric and name not in _NUMBERING]
    num_rows = sum(place.length for place in dataset.folder.listed)
    if dataset.unreadable:
        yield NotMeasured(why=f"the whole dataset, since {len(dataset.unreadable)} of its episodes cannot be read")
    for name in names if not dataset.unreadable else ():
        episodes = [_vectors(dataset, name, rows[name]) for rows in dataset.rows.values()]
        ranges = [_quantile_ranges(values) for values in episodes]
        weights = [len(values) for values in episodes]
        averaged = {q: np.average([each[q] for each in ranges], axis=0, weights=weights) for q in QUANTILES}
        between = {} if dataset.sidecar else _hull(ranges)
        count = sum(len(rows[name]) for rows in dataset.rows.values())
        yield from _errors(stats.get(name), np.concatenate(episodes), count, name, averaged, between)
    for name in [name for name in features if name in stats and name not in names]:
        yield from _form_errors(stats[name], name, num_rows if name in _NUMBERING else None)
    columns = [f"stats/{name}/{quantity}" for name in names for quantity in NAMES]
    counts = _numbering_counts(dataset)
    columns += counts.values()
    for number, row in enumerate(rows_in(dataset.path, "meta/episodes", columns)):
        if (rows := dataset.rows.get(number)) is None:
            continue
        for name in names:
            stored = {quantity: row[f"stats/{name}/{quantity}"] for quantity in NAMES}
            values = _vectors(dataset, name, rows[name])
            yield from _errors(stored, values, len(rows[name]), f"{name}, episode {number}", {}, {})
        for name, column in counts.items():
            yield from _form_errors({"count": row[column]}, f"{name}, episode {number}", len(rows[name]))
    if unknown := [name for name in stats if name not in features]:
        yield Measurement(value=MERGED_ERROR, detail=f"{', '.join(unknown[:3])}: not a feature")


def _numbering_counts(dataset: CheckedDataset) -> dict[str, str]:
    """Name -> column of the episodes' counts of each numbering, where the dataset has it."""
    tables = tables_in(dataset.path, "meta/episodes")
    known = set(open_table(tables[0]).schema_arrow.names) if tables else set()
    columns = {name: f"stats/{name}/count" for name in _NUMBERING}
    return {name: column for name, column in columns.items() if column in known}


def _vectors(dataset: CheckedDataset, name: str, rows: Any) -> Array:
    """(N, D) rows; of arrays of several dimensions their last one, as LeRobot's statistics."""
    return np.asarray(rows, dtype=np.float64).reshape(-1, dataset.info.features[name].shape[-1])


def _quantile_ranges(values: Array) -> Ranges:
    """The values of the neighbouring ranks: LeRobot reads quantiles off a histogram, others interpolate."""
    ordered, last = np.sort(values, axis=0), len(values) - 1
    ranks = {name: share * last for name, share in QUANTILES.items()}
    return {
        name: ordered[[max(math.ceil(rank) - 1, 0), min(math.floor(rank) + 1, last)]] for name, rank in ranks.items()
    }


def _hull(ranges: Sequence[Ranges]) -> Ranges:
    """The lowest and highest of several ranges."""
    stacked = {quantile: np.stack([each[quantile] for each in ranges]) for quantile in QUANTILES if ranges}
    return {q: np.stack([each[:, 0].min(axis=0), each[:, 1].max(axis=0)]) for q, each in stacked.items()}


def _errors(
    stored: Mapping[str, Any] | None, values: Array, count: int, name: str, averaged: Ranges, between: Ranges
) -> Iterator[Measurement]:
    """The error of each quantity of a feature with rows (N, D), in standard deviations."""
    if stored is None:
        yield Measurement(value=math.inf, detail=f"{name} has no statistics")
        return
    true = {quantity: getattr(values, quantity)(axis=0) for quantity in ("min", "max", "mean", "std")}
    true |= {"count": np.array([float(count)])}
    true |= {quantile: np.quantile(values, share, axis=0) for quantile, share in QUANTILES.items()}
    ranges = _quantile_ranges(values)
    scale = np.maximum(true["std"], MIN_DEVIATION)
    for quantity, expected in true.items():
        found = numbers_of(stored.get(quantity))
        if found.shape != expected.shape:
            yield Measurement(value=math.inf, detail=f"{quantity} of {name}")
            continue
        error = np.abs(found - expected)
        for low, high in (known[quantity] for known in (ranges, averaged) if quantity in known):
            error = np.minimum(error, np.maximum(np.maximum(low - found, found - high), 0.0))
        error = error if quantity == "count" else error / scale
        if quantity in between:
            low, high = between[quantity]
            error = np.where((low <= found) & (found <= high), np.minimum(error, MERGED_ERROR), error)
        yield Measurement(value=float(error.max()), detail=f"{quantity} of {name}")


def _form_errors(stored: Mapping[str, Any], name: str, count: int | None) -> Iterator[Measurement]:
    """What is not a finite number among the statistics of images or numberings, and an error of their count.

    Args:
        stored: Quantity -> its numbers.
        name: Of the feature.
        count: Rows; None for images, of which some are sampled.
    """
    for quantity in NAMES:
        if quantity in stored:
            found = numbers_of(stored[quantity])
            is_finite = bool(len(found) and np.isfinite(found).all())
            yield Measurement(value=0.0 if is_finite else math.inf, detail=f"{quantity} of {name}")
    if count is not None and "count" in stored:
        yield Measurement(
            value=float(np.abs(numbers_of(stored["count"]) - count).max(initial=0)), detail=f"count of {name}"
        )


def numbers_of(value: Any) -> Array:
    """(N,) numbers of an entry in the statistics, however nested; (0,) for anything else, text of numbers included."""
    try:
        found = np.asarray(value)
    except (ValueError, OverflowError):
        return np.zeros(0)
    return found.reshape(-1).astype(np.float64) if found.dtype.kind in "biuf" else np.zeros(0)


@dataset_check(
    measures="mean colours in the statistics against decoded images, of 1",
    warn=0.04,
    fail=0.08,
    needs="images",
    needs_images=True,
)
def dataset_image_statistics(dataset: CheckedDataset) -> Iterator[Found]:
    """Recompute the mean colour of each camera, of the whole dataset and of each episode."""
    if dataset.info.is_old:
        return
    stats = dataset.folder.statistics
    for key, (films, _) in dataset.films.items():
        if not films or dataset.info.features[key].is_depth:
            continue
        mean = np.average([film.mean for film in films], axis=0, weights=[len(film.cells) for film in films])
        yield _colour_error(stats.get(key, {}).get("mean"), mean, key)
        column = f"stats/{key}/mean"
        filmed = {film.episode: film for film in films}
        for number, row in enumerate(rows_in(dataset.path, "meta/episodes", [column])):
            if (film := filmed.get(f"episode {number}")) is not None:
                yield _colour_error(row[column], film.mean, film.where)


def _colour_error(stored: Any, true: Array, detail: str) -> Measurement:
    found = numbers_of(stored)
    error = float(np.abs(found - true).max()) if found.shape == true.shape else math.inf
    return Measurement(value=error, detail=detail)
