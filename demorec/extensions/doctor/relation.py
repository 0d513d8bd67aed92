"""Relation of state and action: target or increment, delay in frames, and matching elements."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from demorec.check.base import NotMeasuredError
from demorec.core.geometry import Array
from demorec.extensions.doctor.evidence import EpisodeEvidence, Evidence
from demorec.extensions.doctor.robust import finest, lagged_correlations
from demorec.extensions.doctor.units import moving_elements

MAX_LAG_S = 0.7
"""Range of tried lags, s, in both directions: a hobby servo under teleoperation needs 0.1 to 0.3 s."""
MIN_LAGS = 3
"""Minimum number of tried frames in each direction."""
MAX_UNEXPLAINED = 0.4
"""Maximum ratio of an element's variance left unexplained by its action, for the lag to be judged by it."""
MIN_MOTION = 0.2
"""Minimum motion of an element in an episode judged by it, as a ratio of its usual range."""
SUM_S = 0.2
"""Time over which increments are summed if single ones do not explain the motion, as noise of the controller or of
exploration may prevent."""


@dataclass(frozen=True, kw_only=True, eq=False)
class EpisodeLag:
    """Delay of an episode's state after its action.

    Attributes:
        lag: Delay in frames; fractions are interpolated.
        curve: (L,) mean logarithm of the unexplained variance at each lag, over the judged elements.
        element_lags: (J,) lag of each judged element.
    """

    lag: float
    curve: Array
    element_lags: Array


@dataclass(frozen=True, kw_only=True, eq=False)
class ActionRelation:
    """Relation of state and action in a set of episodes.

    Attributes:
        window: 0: the action is the position to reach. Else it is the change until the next frame, and its sums over
            this number of frames are compared with the state's changes.
        lags: (L,) tried lags, frames.
        elements, columns: (K,) elements of the arm in the state, and the matching ones in the action.
        episodes: Number of an episode -> its lag, for those that move enough.
    """

    window: int
    lags: NDArray[np.intp]
    elements: NDArray[np.intp]
    columns: NDArray[np.intp]
    episodes: Mapping[int, EpisodeLag]

    @property
    def kind(self) -> Literal["target", "increment"]:
        """Meaning of the action."""
        return "increment" if self.window else "target"

    @property
    def usual_lag(self) -> float:
        """Median over the episodes."""
        return float(np.median([episode.lag for episode in self.episodes.values()]))

    def compared(self, episode: EpisodeEvidence, lag: int) -> tuple[Array, Array]:
        """Return (N, K) of the state and (N, K) of the action that precedes it by the lag: positions, or changes."""
        state, action = _compared(*_paired(episode, self.elements, self.columns), self.window)
        return state[max(lag, 0) : len(state) + min(lag, 0)], action[max(-lag, 0) : len(action) - max(lag, 0)]


def relation_of(evidence: Evidence) -> ActionRelation:
    """Find how the state follows the action. Raises NotMeasuredError if neither relation applies."""
    episodes = [each for each, _ in evidence.need_state() if each.action is not None]
    if not evidence.roles.action or not episodes:
        raise NotMeasuredError("no column is known to be the action (name it: --action COLUMN)")
    moves = evidence.once(moving_elements)
    pairs = [
        (element, column)
        for element, column in enumerate(evidence.action_of)
        if column is not None and not evidence.is_gripper[element] and moves[element]
    ]
    if not pairs:
        raise NotMeasuredError("no element of the action has the name of a moving element of the state")
    elements, columns = (np.array(part, dtype=np.intp) for part in zip(*pairs, strict=True))
    reach = max(MIN_LAGS, round(MAX_LAG_S * evidence.fps))
    long = [each for each in episodes if each.length >= 3 * reach + 4]
    if not long:
        raise NotMeasuredError("the episodes are too short to determine whether state or action comes first")
    lags = np.arange(-reach, reach + 1)  # not before: a stated rate of 2**31 would fill the memory
    best: ActionRelation | None = None
    fit = MAX_UNEXPLAINED
    for window in (0, 1, round(SUM_S * evidence.fps)):
        if window > 1 and best is not None:
            break
        curves = {}
        for each in long:
            curves[each.number] = _curves(*_paired(each, elements, columns), window, lags, evidence.ranges[elements])
        unexplained = _usual_minimum(list(curves.values()))
        if unexplained < fit:
            fit = unexplained
            found = {number: _lag(curve, lags) for number, curve in curves.items()}
            best = ActionRelation(
                window=window,
                lags=lags,
                elements=elements,
                columns=columns,
                episodes={number: lag for number, lag in found.items() if lag is not None},
            )
    if best is None or not best.episodes:
        raise NotMeasuredError("the state follows the action neither as a target nor as an increment")
    return best


def _paired(episode: EpisodeEvidence, elements: NDArray[np.intp], columns: NDArray[np.intp]) -> tuple[Array, Array]:
    """Return (T, K) of the state and (T, K) of the action, paired elements only."""
    assert episode.state is not None
    assert episode.action is not None
    return episode.state[:, elements], episode.action[:, columns]


def _compared(state: Array, action: Array, window: int) -> tuple[Array, Array]:
    """Return the state and the action, or from each frame on the change of the state and the sum of its increments."""
    if window == 0:
        return state, action
    later = np.minimum(np.arange(len(state)) + window, len(state) - 1)
    sums = np.cumsum(action, axis=0) - action  # of the increments before each frame
    return state[later] - state, sums[later] - sums


def _curves(state: Array, action: Array, window: int, lags: NDArray[np.intp], usual_ranges: Array) -> Array:
    """Compute (L, K) ratio of each element's variance left unexplained by its action at each lag; NaN if it rests."""
    moved = (np.ptp(state, axis=0) >= MIN_MOTION * usual_ranges) & (np.ptp(action, axis=0) > 0)
    unexplained = 1 - lagged_correlations(*_compared(state, action, window), int(lags[0]), int(lags[-1])) ** 2
    return np.where(moved, np.maximum(unexplained, 1e-9), np.nan)


def _usual_minimum(curves: list[Array]) -> float:
    """Compute the median over episodes and moving elements of the minimum unexplained ratio."""
    lowest = np.concatenate([curve.min(axis=0) for curve in curves])
    known = lowest[np.isfinite(lowest)]
    return float(np.median(known)) if len(known) else 1.0


def _lag(curve: Array, lags: NDArray[np.intp]) -> EpisodeLag | None:
    judged = np.asarray(np.isfinite(curve).all(axis=0))
    judged[judged] &= curve[:, judged].min(axis=0) < MAX_UNEXPLAINED
    if not judged.any():
        return None
    logs = np.log(curve[:, judged])
    whole = logs.mean(axis=1)
    numbers = lags.tolist()
    each = np.array([finest(numbers, column) for column in logs.T])
    return EpisodeLag(lag=finest(numbers, whole), curve=whole, element_lags=each)
