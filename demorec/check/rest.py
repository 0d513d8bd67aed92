"""The longest time for which something stays the same while the robot moves."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from demorec.check.evidence import Flags, without_gaps
from demorec.core.geometry import Array

MIN_SPEED = 0.3
"""Share of the root mean square speed above which something counts as moving."""


class Rest(NamedTuple):
    """A run of steps in which nothing changes.

    Attributes:
        moving: Its moving frames.
        start: Its first step.
        outside: (N,) all other steps.
    """

    moving: int
    start: int
    outside: Flags


def longest_rest(same: Flags, moves: Flags, frames: NDArray[np.intp] | None = None) -> Rest:
    """The run of `same` steps with most moving frames; steps without motion do not end it.

    Args:
        same: (N,) steps without change.
        moves: (N,) steps in which the robot moves.
        frames: (N,) frames that each step takes; default 1.
    """
    weights = np.ones(len(same), dtype=np.intp) if frames is None else frames
    moving = np.concatenate([[0], np.cumsum(weights * (same & moves))])
    padded = np.concatenate([[False], same | ~moves, [False]])
    edges = np.flatnonzero(padded[1:] != padded[:-1]).reshape(-1, 2)
    count, begin, end = max(((int(moving[b] - moving[a]), int(a), int(b)) for a, b in edges), default=(0, 0, 0))
    outside = np.ones(len(same), dtype=np.bool_)
    outside[begin:end] = False
    return Rest(count, begin, outside)


def moves_of(values: Array) -> Flags:
    """(T - 1,) whether (T, D) values move from each frame to the next, each element in units of its usual step."""
    if len(values) < 2:
        return np.zeros(0, dtype=np.bool_)
    steps = np.nan_to_num(np.diff(without_gaps(values), axis=0))
    speed = np.linalg.norm(steps / np.maximum(np.sqrt((steps**2).mean(axis=0)), 1e-9), axis=1)
    return np.asarray(speed > MIN_SPEED * np.sqrt((speed**2).mean()))
