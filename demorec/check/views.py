"""Does a camera show the same place in all episodes of a dataset: whoever recorded them, nothing has to be known."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import partial

import numpy as np

from demorec.check.base import Found, Measurement, NotMeasured, image_check
from demorec.check.coverage import TWIN_DISTANCE, twins
from demorec.check.dataset import Dataset
from demorec.check.evidence import FEWEST
from demorec.check.films import Film, turned
from demorec.check.likeness import far_off
from demorec.check.motion import FEWEST_TO_COMPARE
from demorec.core.geometry import Array

_ALIKE_PARTS = 0.95
"""Share of an image's parts that are compared: the others may show an object that lies elsewhere."""
_LEVELS, _EDGE_LEVELS = 1.5, 0.5
"""By how much a view is off at least that is usual, and by how much where there are edges, of 255."""
_SHARPNESS, _LEAST_DETAIL = 0.15, 2.0
"""By how much the logarithm of a view's sharpness is off at least that is usual (of 30 clean sets by up to 1.0 where
the usual is 0.4, of a lens out of focus by 1.3); mean square of 255 that is added to detail and contrast, as noise."""
_EDGES_OF_SESSION = 0.65
"""What counts of how many times edges change from one episode on: of 870 drawn sets of 12 clean ones 4.3 at most."""
_FEWEST_TO_TURN = 3
_GRAY_LEVELS, _COLOURED_LEVELS = 5.0, 5.0
"""Of 255, difference of red, green and blue in any part of gray images at most, and in the mean of coloured ones at
least: a camera may begin above a gray table."""
_BLACK, _BARS = 6, 0.05
"""Levels of 255 below which a part is black in all of an episode's images, and the share of such parts in bars."""
_ONE_FILM = 1.15
"""Root mean square levels by which a film and its copy, encoded again, differ at most: by 1.0 with 96 pixels, and films
of 900 clean episodes by 1.26 and more."""
_FEWEST_OF_SESSION, _SESSION = 5, 0.05
"""Episodes of a session at least, and share of all."""

_NEIGHBOURS = 9
"""Episodes after one whose median its view is compared with."""

views_check = partial(image_check, on=("dataset",), fail=math.inf)


def _difference(one: Array, other: Array) -> Array:
    """(...,) levels by which most parts of views (..., rows, columns, 3) differ."""
    parts = np.abs(one - other).mean(axis=-1)
    parts = np.sort(parts.reshape(*parts.shape[:-2], -1), axis=-1)
    return np.asarray(parts[..., : max(round(_ALIKE_PARTS * parts.shape[-1]), 1)].mean(axis=-1))


def _usual(views: Array, number: int) -> Array:
    """(rows, columns, 3) what the episodes after one show: the median of nine at most."""
    others = (number + 1 + np.arange(min(len(views) - 1, _NEIGHBOURS))) % len(views)
    return np.asarray(np.median(views[others], axis=0))


def _edges_off(view: Array, usual: Array) -> float:
    """Levels by which half of the edges that are usual are off, in whatever light: an object that lies elsewhere has
    few of them."""
    view = (view + 1) * np.median((usual + 1) / (view + 1), axis=(0, 1)) - 1
    edges = np.linalg.norm(np.gradient(usual, axis=(0, 1)), axis=0).mean(axis=-1).reshape(-1) + 0.05
    off = np.abs(view - usual).mean(axis=-1).reshape(-1)
    order = np.argsort(off)
    heavier = np.cumsum(edges[order])
    return float(off[order[np.searchsorted(heavier, heavier[-1] / 2)]])


def _show_edges(films: Sequence[Film]) -> bool:
    """Whether they are of a camera that stands, as far as films of some length tell, and have parts side by side."""
    stand = sum(len(film.cells) >= FEWEST and film.stands for film in films)
    return 2 * stand > len(films) and min(films[0].cells.shape[1:3]) > 1


def _sharpness(film: Film) -> float:
    """Logarithm of the detail of an episode's first images by the contrast of the parts of its view, which blur and
    noise leave as it is."""
    detail = float(np.median(film.detail[: max(len(film.detail) // 5, 1)]))
    steps = (np.diff(film.first_view.mean(axis=-1), axis=axis) for axis in (0, 1))
    contrast = sum(float((step**2).mean()) for step in steps if step.size)
    return math.log((detail + _LEAST_DETAIL) / (contrast + _LEAST_DETAIL))


def _instructions(dataset: Dataset) -> Array:
    """(N,) number of the first one of each episode."""
    return np.array([int(rows["task_index"].reshape(-1)[0]) for rows in dataset.rows])


@views_check(
    measures="episodes in which a camera begins with another view than in the others",
    needs="images of four episodes",
)
def views_alike(dataset: Dataset) -> Iterator[Found]:
    """A camera begins each episode with about the same view, as sharp, if nearly all do: catches one that was moved,
    turned or zoomed, that lost focus, or whose colours were changed. Where scenes vary much, or episodes are few, only
    much is seen. Of cameras that stand, edges are also compared by themselves: they show turns and zooms that leave
    most of the image as it is.

    An episode that alone has its instruction may show something else.
    """
    tasks = _instructions(dataset)
    for camera, films in dataset.films.items():
        if len(films) < FEWEST_TO_COMPARE:
            yield NotMeasured(why=f"fewer than {FEWEST_TO_COMPARE} episodes")
            continue
        if len(np.unique(tasks)) == len(tasks):
            yield NotMeasured(why="each episode has an instruction of its own")
            continue
        views = np.stack([film.first_view for film in films])
        odd = far_off(_difference(views, np.median(views, axis=0)), _LEVELS)
        sharpness = np.array([_sharpness(film) for film in films])
        odd |= far_off(np.abs(sharpness - np.median(sharpness)), _SHARPNESS)
        if _show_edges(films):
            edges = [_edges_off(view, _usual(views, number)) for number, view in enumerate(views)]
            odd |= far_off(np.array(edges), _EDGE_LEVELS)
        strange = np.flatnonzero(odd & np.isin(tasks, tasks[~odd])).tolist()
        named = ", ".join(map(str, strange[:5]))
        yield Measurement(value=len(strange), detail=f"{camera}, episode {named}" if strange else camera)


@views_check(
    measures="how many times nearer an episode's view is to the others' mirrored, turned, gray or BGR than as they are",
    warn=3.0,
    needs="images of three episodes",
)
def views_upright(dataset: Dataset) -> Iterator[Found]:
    """No episode has images that are mirrored, turned, gray or in another order of colours, where others are not.

    What looks alike both ways is not found: most scenes seen from the front, mirrored. Images without any colour are
    found where scenes vary, too, and so are bars of black.
    """
    for films in dataset.films.values():
        count = len(films)
        if count < _FEWEST_TO_TURN:
            yield NotMeasured(why=f"fewer than {_FEWEST_TO_TURN} episodes")
            continue
        views = np.stack([film.first_view for film in films])
        bars = np.array([(film.cells.max(axis=(0, -1)) < _BLACK).mean() for film in films])
        for number, (film, view) in enumerate(zip(films, views, strict=True)):
            usual = _usual(views, number)
            otherwise = min(float(_difference(view, other)) for other in turned(usual))
            times = float(_difference(view, usual)) / max(otherwise, _LEVELS)
            is_gray = bool(np.ptp(film.cells, axis=-1).max() < _GRAY_LEVELS)
            if is_gray and np.ptp(usual, axis=-1).mean() > _COLOURED_LEVELS:
                times = math.inf
            if bars[number] > _BARS and np.median(bars) == 0:
                times = math.inf
            yield Measurement(value=times, detail=film.where)


@views_check(
    measures="episodes that have a camera's film of another episode",
    needs="images of two episodes",
)
def films_differ(dataset: Dataset) -> Iterator[Found]:
    """No two episodes show the same: catches a film that was assigned twice. At a quarter, a half and three quarters of
    the usual length."""
    for films in dataset.films.values():
        places = [round(share * float(np.median([len(film.cells) for film in films]))) for share in (0.25, 0.5, 0.75)]
        long = [film for film in films if len(film.cells) > max(places[-1], FEWEST // 2)]
        shown = [(film.where, film.cells[places].astype(np.float64)) for film in long]
        shown = [(where, cells) for where, cells in shown if cells.var(axis=0).mean() > _ONE_FILM**2]
        if len(shown) < 2:
            yield NotMeasured(why="fewer than two episodes are long enough, and change")
            continue
        rows = [cells.reshape(-1) * (TWIN_DISTANCE / _ONE_FILM) for _, cells in shown]
        yield twins(rows, [where for where, _ in shown], "films")


@views_check(
    measures="by how many times what is usual among episodes a camera's view changes from one of them on",
    warn=3.5,
    needs="images of ten episodes",
)
def views_stay(dataset: Dataset) -> Iterator[Found]:
    """A camera shows the same place before and after each episode: catches one that was moved between two sessions.

    Of what the episodes before and after show in the mean, where both have an instruction in common; of cameras that
    stand also by edges alone.
    """
    tasks = _instructions(dataset)
    last = {task: number for number, task in enumerate(tasks.tolist())}
    for camera, films in dataset.films.items():
        least = max(_FEWEST_OF_SESSION, math.ceil(_SESSION * len(films)))
        if len(films) < 2 * least:
            yield NotMeasured(why=f"fewer than {2 * least} episodes")
            continue
        # Until where an instruction is heard that was heard before: beyond it nothing is in common.
        heard = np.maximum.accumulate([last[task] for task in tasks.tolist()])
        splits = [first for first in range(least, len(films) - least + 1) if heard[first - 1] >= first]
        if not splits:
            yield NotMeasured(why="no instruction is given before and after")
            continue
        views = np.stack([film.first_view for film in films])
        sums = np.cumsum(views, axis=0)
        of_all, of_edges = (_difference, _LEVELS, 1.0), (_edges_off, _EDGE_LEVELS, _EDGES_OF_SESSION)
        for off, usual, counts in (of_all, of_edges) if _show_edges(films) else (of_all,):
            changes = [
                float(off((sums[-1] - sums[first - 1]) / (len(films) - first), sums[first - 1] / first))
                for first in splits
            ]
            change, first = max(zip(changes, splits, strict=True))
            sides = (views[:first], views[first:])
            each = [float(off(view, side.mean(axis=0))) for side in sides for view in side]
            times = counts * change / max(float(np.median(each)), usual)
            yield Measurement(value=times, detail=f"{camera}, from episode {first} on")
