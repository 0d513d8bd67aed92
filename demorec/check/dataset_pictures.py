"""Does every picture of a dataset show something, from there and then, in the colours that its statistics tell."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from demorec.check.base import Found, Measurement, NotMeasured, check, worst
from demorec.check.dataset import Dataset
from demorec.check.dataset_statistics import episode_column, numbers_of, read_statistics
from demorec.geometry import Array


@check(
    group="dataset",
    scope="dataset",
    measures="pictures that are of one colour, or unlike both of their neighbours",
    warn=0,
    needs_pictures=True,
    reads=(
        "observation.images.{camera}",
        "observation.images.{camera}_depth",
    ),
)
def dataset_pictures(dataset: Dataset) -> Measurement | None:
    """Every picture decodes, none is empty, and none is from another moment or place than those around it."""
    wrong = [
        (key, number, frame)
        for key in dataset.colour_keys
        for number, pictures in enumerate(dataset.pictures(key))
        for frame in sorted({*pictures.flat, *pictures.alien})
    ]
    count = sum(pictures.count for key in dataset.colour_keys for pictures in dataset.pictures(key))
    if not count:
        return None
    named = "; ".join(f"{key}, episode {number}, frame {frame}" for key, number, frame in wrong[:3])
    return Measurement(value=len(wrong), frame=wrong[0][2] if wrong else None, detail=named or f"{count} pictures")


@check(
    group="dataset",
    scope="dataset",
    measures="mean colour in the statistics against decoded pictures, of 1",
    warn=0.04,
    fail=0.08,
    needs_pictures=True,
    reads=(
        "meta/stats.json",
        "meta/episodes",
        "observation.images.{camera}",
    ),
)
def dataset_picture_statistics(dataset: Dataset) -> Measurement | None:
    """The mean colours of each camera, over all episodes and in each of them, are those of all its pictures."""
    stats, found = read_statistics(dataset), []
    for key in dataset.colour_keys:
        pictures = dataset.pictures(key)
        if not pictures:
            continue
        mean = np.average([p.mean for p in pictures], axis=0, weights=[p.count for p in pictures])
        found.append(_off_colour(stats.get(key, {}).get("mean"), mean, key))
        told = episode_column(dataset, f"stats/{key}/mean")
        found += [
            _off_colour(said, p.mean, f"{key}, episode {number}")
            for number, (said, p) in enumerate(zip(told, pictures, strict=False))
        ]
    return worst(*found)


def _off_colour(said: Any, mean: Array, detail: str) -> Measurement:
    told = numbers_of(said)
    value = float(np.abs(told - mean).max()) if told.shape == (3,) else math.inf
    return Measurement(value=value, detail=detail)


@check(
    group="dataset",
    scope="dataset",
    measures="difference of an episode's first pictures from what its states and scene make of them, median of 255",
    warn=13.0,
    fail=16.0,
    needs_pictures=True,
    reads=(
        "observation.images.{camera}",
        "observation.state",
        "demorec/",
    ),
)
def dataset_pictures_as_drawn(dataset: Dataset) -> Found:
    """Each video shows its own episode by its own camera, drawn anew until the fingers close, for 3 s at most."""
    found: list[Found] = []
    for each, compared in zip(dataset.described(), dataset.compared, strict=True):
        number = each.number
        if isinstance(compared, NotMeasured):
            found.append(compared)
            continue
        for camera, pictures in compared.items():
            detail = f"camera {camera}, episode {number}"
            found.append(Measurement(value=float(np.median(pictures.unlike)), detail=detail))
    return worst(*found)


@check(
    group="dataset",
    scope="dataset",
    measures="lag between an episode's first pictures and its states, frames",
    warn=0.4,
    fail=0.7,
    needs_pictures=True,
    reads=(
        "observation.images.{camera}",
        "observation.state",
        "demorec/",
    ),
)
def dataset_picture_lag(dataset: Dataset) -> Found:
    """Picture t shows state t, in each episode and camera, until the fingers close, for 3 s at most."""
    found: list[Found] = []
    for each, compared in zip(dataset.described(), dataset.compared, strict=True):
        number = each.number
        if isinstance(compared, NotMeasured):
            found.append(compared)
            continue
        for camera, pictures in compared.items():
            if pictures.lag is None:
                found.append(NotMeasured(why=f"too little moves before camera {camera} in episode {number}"))
                continue
            detail = f"camera {camera}, episode {number}: {pictures.lag:+.2f} frames late"
            found.append(Measurement(value=abs(pictures.lag), detail=detail))
    return worst(*found)
