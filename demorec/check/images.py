"""Checks of images for any episode: they decode, and change when the robot moves."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from demorec.check.base import ANY_EPISODE, Found, Measurement, NotMeasured, check, counted
from demorec.check.dataset import Episodes
from demorec.check.evidence import without_gaps
from demorec.check.motion import longest_rest, moves_of

MAX_SAME_STEP = 0.1
"""Mean change of an image's parts, of 255, up to which it shows the same; a frozen image changes so when encoded again,
the noise of a camera changes more."""
MAX_BLIND_SHARE = 0.2
"""Share of the other moving frames without change above which a camera does not see the robot move."""


@check(
    group="images",
    on=ANY_EPISODE,
    measures="cameras whose images do not all decode",
    needs="images",
    needs_images=True,
)
def images_decode(subject: Episodes) -> Measurement | None:
    """Decode every image: colours, distances and labels of recordings, all videos of a dataset."""
    wrong = list(subject.undecoded())
    if not wrong and not subject.films:
        return None
    return counted([f"{camera}: {problem}" for camera, problem in wrong], f"{len(subject.films)} cameras")


@check(
    group="images",
    on=ANY_EPISODE,
    measures="longest time for which a camera repeats an image while the robot moves",
    unit="s",
    warn=0.5,
    fail=1.0,
    needs="images and a state",
    needs_images=True,
)
def frozen_images(subject: Episodes) -> Iterator[Found]:
    """Find streams that hang: images that stay the same while the robot moves.

    Cameras that show the same in many other moving frames do not see the robot, and are not judged.
    """
    motions = {motion.where: motion for motion in subject.motions}
    for camera, (films, _) in subject.films.items():
        found: list[Found] = []
        blind = others = 0
        for film in films:
            motion = motions.get(film.episode)
            if motion is None or len(film.cells) < 2:
                continue
            same, moves = film.steps <= MAX_SAME_STEP, moves_of(without_gaps(motion.state)[film.frames])
            rest = longest_rest(same, moves, np.diff(film.frames))
            frame = int(film.frames[rest.start]) + 1 if rest.moving else None
            found.append(Measurement(value=rest.moving / film.fps, frame=frame, detail=film.where))
            blind += int((same & moves)[rest.outside].sum())
            others += int(moves[rest.outside].sum())
        if not found:
            yield NotMeasured(why="it needs images and a state")
        elif blind > MAX_BLIND_SHARE * others:
            yield NotMeasured(why=f"{camera} hardly sees the robot move")
        else:
            yield from found
