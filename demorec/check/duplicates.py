"""Episodes that are copies of others."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from demorec.check.base import Found, Measurement, NotMeasured, check
from demorec.check.dataset import CheckedDataset
from demorec.check.run import CheckedRun
from demorec.core.geometry import Array

MAX_DISTANCE = 1e-4
"""Root mean square difference of two motions, rad or m, up to which one is a copy: float32 rounds to less."""


@check(
    group="run",
    on=("run", "external run", "dataset"),
    measures="episodes that have the motion of an earlier one",
    needs="two episodes",
)
def duplicates(subject: CheckedRun | CheckedDataset) -> Found:
    """Compare the states of all episodes at 32 moments each."""
    motions = subject.courses()
    if len(motions) < 2:
        return NotMeasured(why="it needs two episodes")
    if subject.has_equal_starts:
        return NotMeasured(why="--fixed asks for one layout, every episode of which starts alike")
    copies = _copies(list(motions.values()))
    detail = f"{len(motions)} different motions"
    if copies:
        names = list(motions)
        later, earlier = min(copies.items())
        detail = f"{names[later]} is like {names[earlier]}"
    return Measurement(value=len(copies), detail=detail)


def _copies(motions: Sequence[Array]) -> dict[int, int]:
    """Episode -> the first one that it is a copy of."""
    found: dict[int, int] = {}
    # The means of copies differ by less than their distance: only neighbours in that order are compared.
    order = sorted((float(motion.mean()), number) for number, motion in enumerate(motions) if np.isfinite(motion).all())
    for place, (mean, number) in enumerate(order):
        for other_mean, other in order[place + 1 :]:
            if other_mean - mean > MAX_DISTANCE:
                break
            one, two = motions[number], motions[other]
            if len(one) == len(two) and np.linalg.norm(one - two) <= MAX_DISTANCE * math.sqrt(len(one)):
                later, earlier = max(number, other), min(number, other)
                found[later] = min(earlier, found.get(later, earlier))
    return found
