"""Randomness as a function of (root seed, episode, attempt, purpose).

Each purpose has a stream of its own, so that drawing one number more for the looks never moves a cube, and an
episode does not depend on which worker makes it or what was made before.
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
"""What a stream is used for. Append only: the position in this list is part of every recorded seed."""

PURPOSES: tuple[Purpose, ...] = get_args(Purpose)


def generator(*, root_seed: int, episode_index: int, attempt: int, purpose: Purpose) -> np.random.Generator:
    """Return the stream for one purpose of one attempt at one episode (independent of all others).

    The construction is NumPy's for parallel streams: SeedSequence with a spawn key
    (https://numpy.org/doc/stable/reference/random/parallel.html).
    """
    spawn_key = (episode_index, attempt, PURPOSES.index(purpose))
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(root_seed, spawn_key=spawn_key)))
