"""Randomness as a function of (root seed, episode, attempt, purpose).

Each purpose has its own stream: one more draw for the appearance never moves a cube. An episode does not depend on its
worker or on earlier episodes.
"""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np

Purpose = Literal[
    "scene",
    "expert",
    "noise",
    "looks",
    "perception",
    "cameras",
    "physics",
    "sampling",
    "behaviour",
    "language",
    "takeover",
]
"""Purposes of random streams. Append only: the position in this list is part of each recorded seed."""

PURPOSES: tuple[Purpose, ...] = get_args(Purpose)


def generator(*, root_seed: int, episode_index: int, attempt: int, purpose: Purpose) -> np.random.Generator:
    """Return the stream for one purpose of one attempt at one episode, independent of all other streams.

    Uses NumPy's construction for parallel streams: SeedSequence with a spawn key
    (https://numpy.org/doc/stable/reference/random/parallel.html).
    """
    spawn_key = (episode_index, attempt, PURPOSES.index(purpose))
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(root_seed, spawn_key=spawn_key)))
