"""Does every picture of a dataset show something, from there and then, in the colours that its statistics tell."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np

from demorec.check.base import Found, Measurement, NotMeasured, dataset_check, sidecar_check
from demorec.check.dataset import Dataset
from demorec.check.dataset_statistics import episode_column, numbers_of, read_statistics
from demorec.check.drawn import judge_lag, judge_unlike
from demorec.check.rows import longest_run
from demorec.core.geometry import Array
from demorec.episode.features import STATE

_REACH_S = 0.7
"""How far apart in time motions of images and state are compared, seconds."""
_SHOWN = 0.35
"""The least usual correlation from which anything is told."""
_FEWEST_EPISODES = 3


@dataset_check(
    measures="pictures that are of one colour, or unlike both of their neighbours",
    needs_pictures=True,
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


@dataset_check(
    measures="longest time for which a camera gives one and the same image while the robot moves",
    unit="s",
    warn=0.25,
    fail=1.0,
    needs_pictures=True,
)
def dataset_frozen(dataset: Dataset) -> Iterator[Found]:
    """A camera that sees the robot move shows it: catches a stream that hangs.

    A camera that shows the same in more than a fifth of the other moving frames does not see the robot, and tells
    nothing.
    """
    if STATE not in dataset.info.features:
        return
    for key in dataset.colour_keys:
        repeats = [
            (pictures.cells[1:] == pictures.cells[:-1]).all(axis=(1, 2, 3)) for pictures in dataset.pictures(key)
        ]
        steps = [np.linalg.norm(np.diff(rows[STATE].astype(np.float64), axis=0), axis=1) for rows in dataset.rows]
        if not repeats or not len(everything := np.concatenate(steps)):
            continue
        limit = 0.3 * float(np.sqrt((everything**2).mean()))
        moving = [step > limit for step in steps]
        found, hidden, others = [], 0, 0
        for number, (same, moves) in enumerate(zip(repeats, moving, strict=True)):
            # Where nothing moves, the same image again says nothing, and ends no run.
            length, start = longest_run(same | ~moves)
            run = np.zeros(len(same), dtype=np.bool_)
            run[start : start + length] = True
            seconds = int((same & moves & run).sum()) / dataset.info.fps
            found.append(Measurement(value=seconds, frame=start + 1, detail=f"{key}, episode {number}"))
            hidden, others = hidden + int((same & moves & ~run).sum()), others + int((moves & ~run).sum())
        if hidden > 0.2 * others:
            yield NotMeasured(why=f"{key} hardly sees the robot move")
        else:
            yield from found


@dataset_check(
    measures="by how much less than usual an episode's images move when its state does, as a correlation",
    warn=0.35,
    fail=0.45,
    needs_pictures=True,
)
def images_follow_state(dataset: Dataset) -> Iterator[Found]:
    """Images move when the robot does: catches those of another episode, late, backwards or frozen ones.

    How much an image changes is correlated with the speed of the state. What counts is how far that is below the
    camera's usual correlation and below that at another lag, added.
    """
    if STATE not in dataset.info.features or len(dataset.rows) < _FEWEST_EPISODES:
        return
    states = [rows[STATE].astype(np.float64) for rows in dataset.rows]
    scale = np.concatenate(states).std(axis=0) + 1e-3
    reach = max(2, round(_REACH_S * dataset.info.fps))
    for key in dataset.colour_keys:
        tables: list[tuple[int, Array]] = []
        for number, (state, pictures) in enumerate(zip(states, dataset.pictures(key), strict=True)):
            steps = np.abs(np.diff(pictures.cells.astype(np.float32), axis=0)).mean(axis=(1, 2, 3), dtype=np.float64)
            speed = np.linalg.norm(np.diff(state / scale, axis=0), axis=1)
            if len(speed) >= 4 * reach:
                tables.append((number, _correlations(steps, speed, reach)))
        usual = float(np.median([_near(table) for _, table in tables])) if tables else 0.0
        if len(tables) < _FEWEST_EPISODES or usual < _SHOWN:
            yield NotMeasured(why=f"{key} hardly shows when the robot moves")
            continue
        for number, table in tables:
            off = max(usual - _near(table), 0.0) + float(table.max()) - _near(table)
            yield Measurement(value=off, detail=f"{key}, episode {number}")


def _correlations(steps: Array, speed: Array, reach: int) -> Array:
    """(2 reach + 1,) of the roots of two courses (T,), smoothed over three frames, with `steps` so much later."""
    a, b = (np.convolve(np.sqrt(values), np.ones(3) / 3, mode="same") for values in (steps, speed))
    b = b[reach : len(b) - reach] - b[reach : len(b) - reach].mean()
    found = np.zeros(2 * reach + 1)
    for lag in range(2 * reach + 1):
        c = a[lag : lag + len(b)] - a[lag : lag + len(b)].mean()
        found[lag] = (c * b).sum() / max(float(np.sqrt((c * c).sum() * (b * b).sum())), 1e-9)
    return found


def _near(table: Array) -> float:
    """The best correlation within a frame of no lag."""
    middle = len(table) // 2
    return float(table[middle - 1 : middle + 2].max())


@dataset_check(
    measures="mean colour in the statistics against decoded pictures, of 1",
    warn=0.04,
    fail=0.08,
    needs_pictures=True,
)
def dataset_picture_statistics(dataset: Dataset) -> Iterator[Found]:
    """The mean colours of each camera, over all episodes and in each of them, are those of all its pictures."""
    if dataset.info.is_old:
        return
    stats = read_statistics(dataset)
    for key in dataset.colour_keys:
        pictures = dataset.pictures(key)
        if not pictures:
            continue
        mean = np.average([p.mean for p in pictures], axis=0, weights=[p.count for p in pictures])
        yield _off_colour(stats.get(key, {}).get("mean"), mean, key)
        told = episode_column(dataset, f"stats/{key}/mean")
        for number, (said, p) in enumerate(zip(told, pictures, strict=False)):
            yield _off_colour(said, p.mean, f"{key}, episode {number}")


def _off_colour(said: Any, mean: Array, detail: str) -> Measurement:
    told = numbers_of(said)
    value = float(np.abs(told - mean).max()) if told.shape == (3,) else math.inf
    return Measurement(value=value, detail=detail)


drawn_check = partial(
    sidecar_check,
    needs_pictures=True,
)


@drawn_check(
    measures="difference of an episode's first pictures from what its states and scene make of them, median of 255",
    warn=13.0,
    fail=16.0,
)
def dataset_pictures_as_drawn(dataset: Dataset) -> Iterator[Found]:
    """Each video shows its own episode by its own camera, drawn anew until the fingers close, for 3 s at most."""
    for number, camera, compared in dataset.compared:
        yield judge_unlike(compared, f"camera {camera}, episode {number}")


@drawn_check(
    measures="lag between an episode's first pictures and its states, frames",
    warn=0.4,
    fail=0.7,
)
def dataset_picture_lag(dataset: Dataset) -> Iterator[Found]:
    """Picture t shows state t, in each episode and camera, until the fingers close, for 3 s at most."""
    for number, camera, compared in dataset.compared:
        yield judge_lag(compared, f"camera {camera}, episode {number}", f"camera {camera} in episode {number}")
