"""A check of any dataset."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from demorec.api import Evidence, Fault, check


@check(
    family="set",
    needs="state",
    measures="episodes that begin with a pause",
    unit="frames",
    why="A policy learns to wait.",
    do="demorec dataset trim {path} --out NEW",
)
def late_start(evidence: Evidence) -> Iterator[Fault]:
    """Find episodes whose first five frames have one and the same state."""
    for episode, state in evidence.need_state(5):
        if np.array_equal(state[:5], np.repeat(state[:1], 5, axis=0)):
            yield Fault(severity="look", episode=episode.number, message="the first five frames are equal")
