"""Does a camera give a new image for each frame: in recordings and datasets of anybody's."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from demorec.check.base import Found, Measurement, NotMeasured
from demorec.check.dataset import Recorded
from demorec.check.evidence import Flags
from demorec.check.films import MOVING, Film, difference
from demorec.check.over_time import CHANGES, FEWEST_IMAGES, film_check

_NEARLY, _NEARLY_COUNTS, _CATCHES_UP = 0.05, 0.25, 2.0
"""Share of the usual change at a speed below which an image is nearly the same; what counts of such a time: of clean
films the longest is 1.1 s, of 1.5 s of one image, encoded again, 1.5 s; and times the later changes by which the first
new image of a camera that hung differs: a wrist above a plain floor sees nothing for 1.8 s, then a little more each."""
_FEWEST_OF_SIDE = 10
"""Changing images among every second one of an episode."""
_STALE, _CLEARLY = 0.2, 3.5
"""An image repeats the one before that changes by less than this share of what the images on both sides change, where
these change by `CHANGES`, or clearly by so many levels. A repeated image that is encoded again changes by 0.6.
Predicted images of x264 at crf 23, or of AV1, every second one, may lack a motion of up to three levels where images
are small."""
_COPIES, _SLOWEST_FPS = 3, 10.0
"""Images on either side of one that repeats the one before, at most, of which some change: a camera may have a quarter
of the frames' rate, but hardly less than ten images a second."""
_FEWEST_CHANGING, _FEWEST_REPEATS = 25, 5
"""Images among changing ones, of all episodes together, and repeats among them, from which on their share tells."""


@film_check(
    measures="longest time for which a camera gives one and the same image while the robot moves",
    unit="s",
    warn=0.33,
    fail=1.0,
)
def frozen_images(subject: Recorded) -> Iterator[Found]:
    """A camera that sees the robot move shows it: catches a stream that hangs.

    A camera that shows the same in more than a fifth of the other moving frames does not see the robot, and tells
    nothing. An image that was encoded again changes a little: one that changes by a twentieth of what the robot's
    speed makes of it counts a quarter, since robots also move where a camera hardly sees it. A camera that did not hang
    shows little by little what it sees next.
    """
    for camera, films in subject.films.items():
        known = [(film, film.state) for film in films if film.state is not None and len(film.cells) > 1]
        known = [pair for pair in known if not pair[0].is_blank]  # left to `images_show_something`
        steps = [np.linalg.norm(np.diff(state, axis=0), axis=1) for _, state in known]
        if not known:
            continue
        limit = MOVING * float(np.sqrt((np.concatenate(steps) ** 2).mean()))
        found, hidden, others = [], 0, 0
        shown = [film.step[step > limit] / step[step > limit] for (film, _), step in zip(known, steps, strict=True)]
        usual = float(np.median(np.concatenate(shown))) if any(map(len, shown)) else 0.0
        for (film, _), step in zip(known, steps, strict=True):
            same, moves = (film.cells[1:] == film.cells[:-1]).all(axis=(1, 2, 3)), step > limit
            frames, begin, end = _longest(film, same, moves)
            nearly, other, _ = _longest(film, film.step <= _NEARLY * usual * step, moves)
            frame, first = max((frames, begin), (_NEARLY_COUNTS * nearly, other))
            found.append(Measurement(value=frame / film.fps, frame=int(film.frames[first]) + 1, detail=film.where))
            run = np.zeros(len(same), dtype=np.bool_)
            run[begin:end] = True
            hidden, others = hidden + int((same & moves & ~run).sum()), others + int((moves & ~run).sum())
        if hidden > 0.2 * others:
            yield NotMeasured(why=f"{camera} hardly sees the robot move")
        else:
            yield from found


def _longest(film: Film, same: Flags, moves: Flags) -> tuple[int, int, int]:
    """For how many frames the robot moves in the longest time of the same image, and where in the film that is.

    Where nothing moves, the same image again says nothing, and ends no such time.
    """
    edges = np.flatnonzero(np.diff(np.concatenate([[False], same | ~moves, [False]]).astype(np.int8)))
    count = np.concatenate([[0], np.cumsum(np.diff(film.frames) * (same & moves))])
    times = [(int(count[end] - count[begin]), int(begin), int(end)) for begin, end in edges.reshape(-1, 2)]
    hung = (time for time in sorted(times, reverse=True) if time[0] and _catches_up(film, moves, time[1], time[2]))
    return next(hung, (0, 0, 0))


def _catches_up(film: Film, moves: Flags, begin: int, end: int) -> bool:
    """Whether the image after some that are the same shows at once what happened meanwhile; or the film is over."""
    last = max(np.flatnonzero(moves[begin:end]), default=0)
    later = film.step[end + 2 : end + 5]  # the encoder may tell a little of the new image before
    return not len(later) or float(film.step[begin + last + 1 : end + 2].max()) > _CATCHES_UP * float(np.median(later))


@film_check(
    measures="share of a camera's images that repeat the one before while those around them change",
    warn=0.05,
    fail=float("inf"),
)
def stale_images(subject: Recorded) -> Iterator[Found]:
    """A camera gives a new image for each frame: catches one that is slower than the frames, and images that were lost
    and replaced.
    """
    for camera, films in subject.films.items():
        long = [film for film in films if len(film.cells) >= FEWEST_IMAGES]
        places, changing = _repeats(long, CHANGES)
        odd = sum(place % 2 for place in places)
        on_one_side = min(odd, len(places) - odd) <= len(places) / 8
        if on_one_side and _FEWEST_REPEATS <= len(places) < changing / 3:
            clear, clearly = _repeats(long, _CLEARLY)
            if len(clear) < _FEWEST_REPEATS or len(clear) * changing < len(places) * clearly / 2:  # the encoder's
                places, changing = clear, clearly
        if changing < _FEWEST_CHANGING:
            yield NotMeasured(why=f"{camera} hardly changes")
            continue
        share = len(places) / changing if len(places) >= _FEWEST_REPEATS else 0.0
        yield Measurement(value=share, detail=f"{camera}, {len(places)} of {changing} images")


def _repeats(films: Sequence[Film], least: float) -> tuple[list[int], int]:
    """Numbers of the images that repeat the one before, and how many change where those around them do."""
    places, changing = list[int](), 0
    for film in films:
        reach = min(max(round(film.fps / _SLOWEST_FPS), 1), _COPIES)
        beside = np.lib.stride_tricks.sliding_window_view(film.step, 2 * reach + 1)
        around = np.minimum(beside[:, :reach].max(axis=1), beside[:, -reach:].max(axis=1))
        moves = np.lib.stride_tricks.sliding_window_view(film.moves, 2 * reach + 1).all(axis=1)
        changes = (around > least) & moves
        places += np.flatnonzero(changes & (film.step[reach:-reach] < _STALE * around)).tolist()
        changing += int(changes.sum())
    return places, changing


@film_check(
    measures="by what share every second image is nearer to the mean of its neighbours than the others are",
    warn=0.46,
    fail=float("inf"),
)
def interpolated_images(subject: Recorded) -> Iterator[Found]:
    """No image is a mixture of the two around it: catches a video that was brought to twice its rate.

    In the median of the episodes. Predicted images of a video whose every second one is a keyframe are nearer, too, by
    a quarter.
    """
    for camera, films in subject.films.items():
        nearer = []
        for film in (film for film in films if len(film.cells) >= FEWEST_IMAGES):
            off = difference(film.cells[1:-1], (film.cells[2:].astype(np.float32) + film.cells[:-2]) / 2)
            changes = (film.step[1:] > CHANGES / 2) & film.moves[1:]
            sides = [off[first::2][changes[first::2]] for first in (0, 1)]
            if min(map(len, sides)) >= _FEWEST_OF_SIDE:
                means = [float(side.mean()) for side in sides]
                nearer.append(1.0 - min(means) / max(*means, 1e-9))
        if nearer:
            yield Measurement(value=float(np.median(nearer)), detail=camera)
        else:
            yield NotMeasured(why=f"{camera} hardly changes")
