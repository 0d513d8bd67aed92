"""Which frames of a dataset the expert acted in, for a policy that shall learn from these alone."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

INTERVENTION = "intervention"
"""Column of LeRobot's DAgger: true where the expert acts in an episode that a policy began."""
STRETCH_COLUMNS = ("index", "episode_index", INTERVENTION)


class Stretches:
    """The stretches of frames in which the expert acts; an episode without corrections is one stretch.

    Args:
        index: (N,) of each row of the table in the whole dataset.
        episode_index: (N,) its episode.
        intervention: (N,) whether the expert acts in it, having taken over from a policy.

    Attributes:
        shown: (N,) row that is given for each row: itself where the expert acts; the rows of the policy are spread
            evenly over those of the expert.
        first, end: (N,) index of the first frame of a row's stretch, and the one after its last.
    """

    def __init__(self, *, index: NDArray[Any], episode_index: NDArray[Any], intervention: NDArray[Any]) -> None:
        acts = intervention.reshape(-1).astype(bool)
        episode = episode_index.reshape(-1)
        index = index.reshape(-1)
        is_expert = acts | ~np.isin(episode, episode[acts])
        expert, others = np.flatnonzero(is_expert), np.flatnonzero(~is_expert)
        self.shown = np.arange(len(acts))
        self.shown[others] = expert[np.arange(len(others)) * len(expert) // max(1, len(others))]
        begins = np.diff(episode, prepend=-1) != 0
        begins[1:] |= is_expert[1:] != is_expert[:-1]
        starts = np.flatnonzero(begins)
        number = np.cumsum(begins) - 1
        ends = np.append(starts[1:], len(acts))
        self.first, self.end = index[starts][number], (index[ends - 1] + 1)[number]
