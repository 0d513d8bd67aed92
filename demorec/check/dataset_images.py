"""Do the images of a dataset have the colours that its statistics tell, and show what its sidecar describes."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np

from demorec.check.base import Found, Measurement, dataset_check, sidecar_check
from demorec.check.dataset import Dataset
from demorec.check.dataset_statistics import episode_column, numbers_of, read_statistics
from demorec.check.drawn import judge_lag, judge_unlike
from demorec.core.geometry import Array


@dataset_check(
    measures="mean colour in the statistics against decoded images, of 1",
    warn=0.04,
    fail=0.08,
    needs_images=True,
)
def dataset_image_statistics(dataset: Dataset) -> Iterator[Found]:
    """The mean colours of each camera, over all episodes and in each of them, are those of all its images."""
    if dataset.info.is_old:
        return
    stats = read_statistics(dataset)
    for key in dataset.colour_keys:
        images = dataset.images(key)
        if not images:
            continue
        mean = np.average([p.mean for p in images], axis=0, weights=[p.count for p in images])
        yield _off_colour(stats.get(key, {}).get("mean"), mean, key)
        stated = episode_column(dataset, f"stats/{key}/mean")
        for number, (said, p) in enumerate(zip(stated, images, strict=False)):
            yield _off_colour(said, p.mean, f"{key}, episode {number}")


def _off_colour(said: Any, mean: Array, detail: str) -> Measurement:
    stated = numbers_of(said)
    value = float(np.abs(stated - mean).max()) if stated.shape == (3,) else math.inf
    return Measurement(value=value, detail=detail)


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
    warn=0.4,
    fail=0.7,
)
def dataset_image_lag(dataset: Dataset) -> Iterator[Found]:
    """Image t shows state t, in each episode and camera, until the fingers close, for 3 s at most."""
    for number, camera, compared in dataset.compared:
        yield judge_lag(compared, f"camera {camera}, episode {number}", f"camera {camera} in episode {number}")
