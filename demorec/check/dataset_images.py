"""Do the images of a dataset have the colours that its statistics tell, and show what its sidecar describes."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from itertools import combinations
from typing import Any

import numpy as np

from demorec.check.base import Found, Measurement, dataset_check, sidecar_check
from demorec.check.dataset import Dataset
from demorec.check.dataset_statistics import episode_column, numbers_of, read_statistics
from demorec.check.drawn import judge_lag, judge_unlike
from demorec.check.films import Film
from demorec.core.geometry import Array

_DOUBTFUL, _CLEARLY = 0.012, 0.35
"""How far colours are off, of 1, that may be another's, and the share of that by which they are off those of that one.
Of single episodes they are off by up to 0.007, since LeRobot takes a sample of images; nearest to others' by 0.0015."""
_IN_ORDER = ("min", "q01", "q10", "q50", "q90", "q99", "max")
"""Statistics from the smallest to the largest."""


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


drawn_check = partial(
    sidecar_check,
    needs_images=True,
)


@drawn_check(
    measures="difference of an episode's first images from what its states and scene make of them, median of 255",
    warn=13.0,
    fail=16.0,
)
def dataset_images_as_drawn(dataset: Dataset) -> Iterator[Found]:
    """Each video shows its own episode by its own camera, drawn anew until the fingers close, for 3 s at most."""
    for number, camera, compared in dataset.compared:
        yield judge_unlike(compared, f"camera {camera}, episode {number}")


@drawn_check(
    measures="lag between an episode's first images and its states, frames",
    warn=0.73,
    fail=0.85,
)
def dataset_image_lag(dataset: Dataset) -> Iterator[Found]:
    """Image t shows state t, in each episode and camera, until the fingers close, for 3 s at most."""
    for number, camera, compared in dataset.compared:
        yield judge_lag(compared, f"camera {camera}, episode {number}", f"camera {camera} in episode {number}")
