"""Episodes with numbers of a different magnitude than those of the others, as caused by another unit."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from demorec.core.geometry import Array
from demorec.extensions.doctor.evidence import Evidence, Flags

MIN_OTHERS = 3
"""Minimum number of episodes to compare one with."""
MIN_UNIT_RATIO = 7.0
"""Minimum ratio of magnitudes of an episode in another unit: demonstrations of one task differ by a factor of two or
three, the nearest confusion of units is 11."""
MIN_AGREED = 0.6
"""Minimum ratio of the elements that agree on another unit: a gripper and resting joints may keep theirs."""
MIN_WHOLE = 0.9
"""The same of the three elements of one position: all of them."""
MIN_MOTION_TICKS = 10.0
"""Minimum motion in units of the element's smallest difference: a resting encoder flickers by a tick or two."""
BOUND_QUANTILES = (0.005, 0.995)
"""Quantiles that bound the whole set: a single wrong reading does not widen them."""


def other_units(evidence: Evidence) -> dict[int, dict[str, float]]:
    """Find episode -> "state" or "action" -> ratio of its magnitude to the others', for episodes in another unit."""
    found: dict[int, dict[str, float]] = {}
    for role in ("state", "action"):
        values = {e.number: v for e in evidence.episodes if (v := getattr(e, role)) is not None and len(v)}
        if len(values) > MIN_OTHERS:
            positions = _positions(evidence.elements) if role == "state" else []
            for number, ratio in _other_sizes(values, positions).items():
                found.setdefault(number, {})[role] = ratio
    return found


def state_bounds(evidence: Evidence) -> tuple[Array, Array]:
    """Compute the (D,) minimum and maximum of each element of the state, excluding episodes in another unit."""
    others = evidence.once(other_units)
    states = [state for episode, state in evidence.with_state() if episode.number not in others]
    if not states:
        return np.zeros(len(evidence.elements)), np.zeros(len(evidence.elements))
    lowest, highest = np.quantile(np.concatenate(states), BOUND_QUANTILES, axis=0)
    return lowest, highest


def element_ticks(evidence: Evidence) -> Array:
    """Compute the (D,) smallest difference between two frames of each element: at most its encoder's resolution."""
    none = np.zeros((0, len(evidence.elements)))
    steps = np.concatenate([none, *(np.abs(np.diff(state, axis=0)) for _, state in evidence.with_state())])
    smallest = np.where(steps > 0, steps, np.inf).min(axis=0, initial=np.inf)
    return np.where(np.isfinite(smallest), smallest, 0.0)


def moving_elements(evidence: Evidence) -> Flags:
    """Flag the (D,) positions that usually move, and do not merely flicker under a load while another arm works."""
    return np.asarray(evidence.is_position & (evidence.ranges > MIN_MOTION_TICKS * evidence.once(element_ticks)))


def _positions(names: Sequence[str]) -> list[list[int]]:
    """Find the elements of each position in space: three in a row that are called x, y and z."""
    words = [name.rpartition(".")[2].rpartition("_")[2].lower() for name in names]
    return [[i, i + 1, i + 2] for i in range(len(words) - 2) if words[i : i + 3] == ["x", "y", "z"]]


def _other_sizes(values: Mapping[int, Array], positions: Sequence[list[int]]) -> dict[int, float]:
    """Find episode -> ratio of its magnitude to that of the others, if most elements or a whole position agree."""
    sizes = {number: np.sqrt((each**2).mean(axis=0)) for number, each in values.items()}
    spans = {number: np.ptp(each, axis=0) for number, each in values.items()}
    usual_size, usual_span = (np.median(np.stack(list(part.values())), axis=0) for part in (sizes, spans))
    alive = np.flatnonzero((usual_size > 0) & (usual_span > 0))
    wholes = [(alive, MIN_AGREED), *((np.array(each), MIN_WHOLE) for each in positions if np.isin(each, alive).all())]
    found: dict[int, float] = {}
    for number in values:
        for elements, least in wholes:
            with np.errstate(divide="ignore"):
                by_size = np.log(sizes[number][elements] / usual_size[elements])
                by_span = np.log(spans[number][elements] / usual_span[elements])
            for sign in (1.0, -1.0):
                agreed = np.minimum(sign * by_size, sign * by_span) > math.log(MIN_UNIT_RATIO)
                if len(elements) and agreed.mean() > least and (sign > 0 or np.isfinite(by_span[agreed]).all()):
                    found.setdefault(number, float(np.exp(np.median(by_size[agreed]))))
    return found
