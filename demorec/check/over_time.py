"""Do a camera's images show something, and go together over time and with what the robot does.

In recordings and datasets of anybody's.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import partial
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from demorec.check.base import IMAGES, Found, Lacking, Measurement, NotMeasured, image_check
from demorec.check.dataset import Recorded
from demorec.check.evidence import Flags
from demorec.check.films import STANDS, Film, difference, turned
from demorec.core.geometry import Array

_ALIEN_LEVELS, _ALIEN_TIMES = 2.5, 4.0
"""An image from elsewhere differs so much from both of its neighbours, and so many times more than they do."""
_CLEAR_LEVELS = 6.0
"""The same where nobody knows how the robot moved; and views that turned differ by as much."""
_BESIDE_CUT, _SLOW, _LEAST_SHOWN = 4, 0.3, 1.0
"""Images on either side that a change is compared with; what is added to the robot's speed, of its root mean square,
since other things move, too; and levels that the images beside are taken to change at least."""
_BESIDE = 4
"""Images before and after a jump whose medians are compared."""
_SAME_LEVELS, _LEAST_DETAIL = 0.7, 10.0
"""Views whose coarse parts differ by less in the mean, of 255, show the same, however sharp; detail of images that
hardly have any."""
_EXPLAINED, _NEVER_EXPLAINED, _STANDS_OUT = 2.8, 5.0, 2.0
"""Times what the camera shows of such a motion at most (in nine of ten moving frames) that no motion explains if it is
so many times the steps beside it, or at all. Wrist cameras that noise shakes at 10 frames a second show up to 3.7.
Where it stands out so, one of 2,976 clean films at 10 to 15 frames a second shows 2.3 times as much, the others less
than 2."""
_REACH_S = 0.7
"""How far apart in time motions of images and state are compared, seconds."""
_SHOWN = 0.35
"""The least usual correlation from which anything is concluded."""
_BACKWARDS, _BY_CHANCE = 0.5, 2.5
"""The least correlation with the state's course from its end on that is none by chance, and its least z in standard
errors: the best of all lags is taken."""
_LAG_WEIGHT = 1.5
"""Of how far a correlation is below that at another lag of the same episode, but for a quarter of its standard error:
chance moves both alike."""
_SMOOTH = 3
"""Frames over which courses are averaged."""
_FEWEST_EPISODES = 3
FEWEST_IMAGES = 20
_LEAST_UNREST, _LESS_STILL = 0.005, 2.5
"""Share of change below which a camera is as still as any, and times by which one that moves is less still at least."""
_OTHER_VIEW = 0.7
"""Share of the distance from their own views within which two images must be from exchanged ones."""
CHANGES = 1.5
"""Levels of 255 by which an image differs clearly from the one before."""

film_check = partial(image_check, on=("external", "dataset"), needs=IMAGES)


def _all(subject: Recorded, fewest: int = 0) -> Iterator[Film]:
    """Every film of so many images at least."""
    for films in subject.films.values():
        yield from (film for film in films if len(film.cells) >= fewest)


@film_check(
    measures="cameras whose images are of one colour, or show no distance, in more than half of them",
)
def images_show_something(subject: Recorded) -> Found:
    """No camera is covered, and none of depth sees nothing."""
    blank = [camera for camera, films in subject.films.items() if any(film.is_blank for film in films)]
    for camera, images in subject.distances():
        shares = [float(np.mean(np.isfinite(values) & (values > 0))) for values in images]
        if shares and float(np.median(shares)) == 0:
            blank.append(camera)
    if not subject.films and not blank:
        return None
    return Measurement(value=len(blank), detail=", ".join(f"camera {camera} shows nothing" for camera in blank))


@film_check(
    measures="images that are of one colour, or unlike both of their neighbours though the robot does not move so",
)
def stray_images(subject: Recorded) -> Iterator[Found]:
    """No image is empty (where most are, `images_show_something` says so), and none is from another moment or place."""
    wrong, count = [], 0
    for film in _all(subject):
        odd = _alien(film) if film.is_blank else _alien(film) | film.flat
        wrong += [(film, row) for row in np.flatnonzero(odd).tolist()]
        count += len(film.cells)
    if count:
        named = "; ".join(f"{film.where}, frame {film.frames[row]}" for film, row in wrong[:3])
        frame = int(wrong[0][0].frames[wrong[0][1]]) if wrong else None
        yield Measurement(value=len(wrong), frame=frame, detail=named or f"{count} images")


def _alien(film: Film) -> Flags:
    """(N,) images unlike both of their neighbours, which are like each other, where the state goes no such way."""
    alien = np.zeros(len(film.cells), dtype=np.bool_)
    if len(alien) < 3:
        return alien
    least = np.minimum(film.step[:-1], film.step[1:])
    levels = _CLEAR_LEVELS if film.speed is None else _ALIEN_LEVELS
    alien[1:-1] = (least > levels) & (least > _ALIEN_TIMES * difference(film.cells[2:], film.cells[:-2]))
    if not alien.any() or film.state is None or film.speed is None or not film.moves.any():
        return alien
    state = film.state / (film.state.std(axis=0) + 1e-3)
    shown = float(np.quantile(film.step[film.moves] / film.speed[film.moves], 0.9))
    there_and_back = np.linalg.norm(state[1:-1] - (state[2:] + state[:-2]) / 2, axis=1)
    explained = np.maximum(shown * there_and_back, 1e-9)
    beside = np.maximum(np.pad(film.step[:-2], (1, 0)), np.pad(film.step[2:], (0, 1)))
    alien[1:-1] &= least > explained * np.where(least > _STANDS_OUT * beside, _EXPLAINED, _NEVER_EXPLAINED)
    return alien


@film_check(
    measures="times what the images beside show of the robot's motion that a camera's images change in one frame",
    warn=5.0,
    fail=float("inf"),
)
def image_cuts(subject: Recorded) -> Iterator[Found]:
    """What a camera sees goes on from frame to frame: catches one that is hit, light that is switched, films that were
    put together. What falls away before it takes several frames."""
    for film in _all(subject, FEWEST_IMAGES):
        if film.is_blank:
            continue
        times = _times_beside(film)
        row = int(np.argmax(times))
        yield Measurement(value=float(times[row]), frame=int(film.frames[row + 1]), detail=film.where)


def _times_beside(film: Film) -> Array:
    """(N - 1,) times what the images beside it show of the robot's speed that each change shows; where the speed is
    not known, times what any other shows."""
    if film.speed is None:
        way, reach, least = np.ones_like(film.step), len(film.step), CHANGES
    else:
        way = film.speed + _SLOW * float(np.sqrt((film.speed**2).mean())) + 1e-9
        reach, least = _BESIDE_CUT, _LEAST_SHOWN
    # An image may be a frame older or newer than its state.
    widest = np.lib.stride_tricks.sliding_window_view(np.pad(way, 1, mode="edge"), 3).max(axis=1)
    shown, times = film.step / way, np.ones_like(film.step)
    for row in np.flatnonzero(film.step > least).tolist():
        around = np.concatenate([shown[max(row - reach, 0) : max(row - 1, 0)], shown[row + 2 : row + 1 + reach]])
        beside = shown[max(row - 1, 0) : row + 2].min()  # of a cut, one at least is as usual
        usual = max(float(around.max()), float(beside), least / widest[row])
        times[row] = film.step[row] / widest[row] / usual
    return times


@film_check(
    measures="how many times nearer images after a jump are to those before turned, mirrored, gray or BGR than as is",
    warn=3.0,
    fail=5.0,
)
def images_stay_upright(subject: Recorded) -> Iterator[Found]:
    """A camera's images do not turn round or change the order of their colours in the midst of an episode."""
    for film in _all(subject, 2 * _BESIDE):
        row = int(np.argmax(film.step[_BESIDE - 1 : -_BESIDE + 1])) + _BESIDE
        before, after = (np.median(film.cells[a:b], axis=0) for a, b in ((row - _BESIDE, row), (row, row + _BESIDE)))
        as_is, *otherwise = (float(np.abs(after - view).mean()) for view in (before, *turned(before)))
        times = as_is / max(min(otherwise), 1.0) if as_is > _CLEAR_LEVELS else 1.0
        yield Measurement(value=times, frame=int(film.frames[row]), detail=film.where)


@film_check(
    measures="by how much less than usual an episode's images move when its state does, as a correlation",
    warn=0.54,
    fail=0.7,
)
def images_follow_state(subject: Recorded) -> Iterator[Found]:
    """Images move when the robot does: catches those of another episode, late, backwards or frozen ones.

    How much an image changes is correlated with the speed of the state. What counts is how far that is below the
    camera's usual correlation (of few episodes nobody knows it) and below that at another lag, or backwards, added. Of
    short episodes a correlation says less: it counts as higher by Fisher's standard error.
    """
    for camera, films in subject.films.items():
        known = [(film, film.state) for film in films if film.state is not None and len(film.cells) > 1]
        if not known:
            continue
        scale = np.concatenate([state for _, state in known]).std(axis=0) + 1e-3
        tables: list[tuple[Film, Array, float]] = []
        for film, state in known:
            reach = max(2, round(_REACH_S * film.fps))
            speed = np.linalg.norm(np.diff(state / scale, axis=0), axis=1)
            if len(speed) >= 4 * reach and (np.diff(film.frames) == 1).all():
                table, backwards = (_correlations(film.step, course, reach) for course in (speed, speed[::-1]))
                least = max(_BACKWARDS, math.tanh(_BY_CHANCE * _error(len(speed) - 2 * reach)))
                clearly = [backwards.max()] if backwards.max() > least else []
                tables.append((film, table, float(max([table.max(), *clearly]))))
        usual = float(np.median([_near(table) for _, table, _ in tables])) if tables else 0.0
        if len(tables) < _FEWEST_EPISODES:
            usual = max((best for _, _, best in tables), default=0.0)
        if usual < _SHOWN:
            yield NotMeasured(why=f"{camera} hardly shows when the robot moves")
            continue
        for film, table, best in tables:
            near, error = _near(table), _error(len(film.step) - (len(table) - 1))
            own = math.tanh(math.atanh(min(near, 0.999)) + error)
            below = max(usual - own, 0.0) if len(tables) >= _FEWEST_EPISODES else 0.0
            later = _LAG_WEIGHT * (float(table.max()) - near - error / 4)
            yield Measurement(value=max(below + max(best - own, 0.0), later), detail=film.where)


def _correlations(steps: Array, speed: Array, reach: int) -> Array:
    """(2 reach + 1,) of the roots of two courses (T,), smoothed over three frames, with `steps` so much later."""
    a, b = (np.convolve(np.sqrt(values), np.ones(_SMOOTH) / _SMOOTH, mode="same") for values in (steps, speed))
    b = b[reach : len(b) - reach] - b[reach : len(b) - reach].mean()
    found = np.zeros(2 * reach + 1)
    for lag in range(2 * reach + 1):
        c = a[lag : lag + len(b)] - a[lag : lag + len(b)].mean()
        found[lag] = (c * b).sum() / max(float(np.sqrt((c * c).sum() * (b * b).sum())), 1e-9)
    return found


def _error(count: int) -> float:
    """Standard error of the z (inverse hyperbolic tangent) of a correlation of two smoothed courses (Fisher, 1921)."""
    return 1.0 / math.sqrt(max(count / _SMOOTH - 3.0, 1.0))


def _near(table: Array) -> float:
    """The best correlation within a frame of no lag."""
    middle = len(table) // 2
    return float(table[middle - 1 : middle + 2].max())


@film_check(
    measures="by how much the brightness of what stands still drifts within an episode, share",
    warn=0.06,
    fail=float("inf"),
)
def steady_exposure(subject: Recorded) -> Iterator[Found]:
    """What stands still before a fixed camera keeps its colours: catches drifting exposure, white balance."""
    for film in _all(subject, FEWEST_IMAGES):
        gains = film.gains
        if isinstance(gains, NotMeasured):
            yield gains
        else:
            yield Measurement(value=float(np.ptp(gains, axis=1).max()), detail=film.where)


def _coarse(cells: NDArray[np.uint8]) -> NDArray[np.float32]:
    """(N, h, w, 3) means of 4 x 4 parts, which blur leaves as they are."""
    count, rows, columns = len(cells), cells.shape[1] // 4, cells.shape[2] // 4
    whole = cells[:, : 4 * rows, : 4 * columns].reshape(count, rows, 4, columns, 4, 3)
    return np.asarray(whole.mean(axis=(2, 4)), dtype=np.float32)


@film_check(
    measures="times as much detail that a fixed camera's images have before or after they become blurred or noisy",
    warn=2.4,
    fail=float("inf"),
)
def steady_sharpness(subject: Recorded) -> Iterator[Found]:
    """What stands still before a fixed camera stays as sharp: catches lost focus, drops on the lens, noise."""
    for film in _all(subject, FEWEST_IMAGES):
        if isinstance(film.gains, NotMeasured):
            yield film.gains
            continue
        starts = len(film.cells) - _BESIDE + 1
        parts = _coarse(film.cells)
        views = np.stack([parts[n : n + starts] for n in range(_BESIDE)]).mean(axis=0)
        detail = np.lib.stride_tricks.sliding_window_view(film.detail, _BESIDE).mean(axis=1)
        before, after = detail[:-_BESIDE], detail[_BESIDE:]
        times = np.maximum(before, after) / np.maximum(np.minimum(before, after), _LEAST_DETAIL)
        times[difference(views[_BESIDE:], views[:-_BESIDE]) > _SAME_LEVELS] = 1.0
        row = int(np.argmax(times))
        yield Measurement(value=float(times[row]), frame=int(film.frames[row + _BESIDE]), detail=film.where)


@film_check(
    measures="images that look like another camera's, while that one's look like this one's",
    needs="two cameras",
)
def exchanged_cameras(subject: Recorded) -> Iterator[Found]:
    """Each camera shows its own view: catches two that change places, within an episode or from one to another.

    A view is the median of the first fifth of an episode's images, of all episodes together. Cameras that move leave
    theirs: what counts is how far the images of both, taken together, are from either order of the two; and whether the
    one that always moves stands still while the one that always stands moves.
    """
    pairs = list(combinations(subject.films, 2))
    if not pairs:
        yield Lacking(need="two cameras")
    for one, other in pairs:
        films = list(zip(subject.films[one], subject.films[other], strict=False))
        films = [(a, b) for a, b in films if len(a.cells) >= FEWEST_IMAGES <= len(b.cells)]
        if not films or films[0][0].cells.shape[1:] != films[0][1].cells.shape[1:]:
            continue
        views = [np.median([film.first_view for film in side], axis=0) for side in zip(*films, strict=True)]
        stand = np.array([(a.stands, b.stands) for a, b in films])
        unrest = np.log(np.fmax([(a.unrest, b.unrest) for a, b in films], _LEAST_UNREST))
        usual = np.median(unrest, axis=0)
        off = np.abs(unrest[:, :, None] - usual)  # of each camera from both cameras' usual one
        nearer = (off[:, 0, 1] < off[:, 0, 0]) & (off[:, 1, 0] < off[:, 1, 1])
        is_known = abs(usual[0] - usual[1]) > math.log(_LESS_STILL)
        moved = (stand == (usual <= math.log(STANDS))[::-1]).all(axis=1) & (stand[:, 0] != stand[:, 1]) & nearer
        for (a, b), is_moved in zip(films, moved & is_known, strict=True):
            count = min(len(a.cells), len(b.cells))
            one_cells, other_cells = a.cells[:count], b.cells[:count]
            as_named = difference(one_cells, views[0][None]) + difference(other_cells, views[1][None])
            exchanged = difference(one_cells, views[1][None]) + difference(other_cells, views[0][None])
            wrong = (exchanged < _OTHER_VIEW * as_named) | is_moved
            frame = int(a.frames[int(np.argmax(wrong))]) if wrong.any() else None
            yield Measurement(value=int(wrong.sum()), frame=frame, detail=f"{a.where} and {other}")
