"""Is each episode of a dataset like the others: how actions and states go together, how episodes begin and end.

Whoever recorded them: nothing has to be known of the robot.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import partial

import numpy as np

from demorec.check.base import STATE_ALONE, Found, Lacking, Measurement, NotMeasured, check
from demorec.check.dataset import Dataset, Rows
from demorec.check.evidence import Motion, is_gripper
from demorec.check.rows import finest_lag
from demorec.core.geometry import Array
from demorec.episode.features import ACTION, EE_POSE, STATE

_FEWEST_EPISODES, _FEWEST_FRAMES = 3, 30
_AHEAD_S = (0.0, 0.1, 0.3)
"""How far ahead the states are looked at that an action leads to, seconds; the first is one frame."""
_RIDGE = 1e-3
_CLEAR = 0.6
"""Correlation of an element of the action with what the states of other episodes make of it, from which it counts."""
_LIVELY = 0.5
"""Share of an action's usual deviation, as the states tell it, from which on an episode is judged."""
_TARGET = 0.65
"""Share of an action's variance that the states of the same frame tell, in the median of its elements, above which it
is a target: of targets 0.84 to 0.99, of increments 0.15 to 0.47."""
_REACH_S = 1.0
_LATEST_S = 0.35
"""How far behind its action a motion may be, seconds: as for states that follow targets."""

_END_S = 0.15
"""How long the first and last moments of an episode are, seconds."""
_MOST, _ALIKE, _OTHER, _RARE = 0.7, 0.1, 0.5, 0.05
"""Share of the episodes that are alike, how alike (in deviations of the opening, and shares of the mean speed), how far
one is off that is not, and the share of those that are not from which on it is another way to do it."""

likeness_check = partial(check, on=("dataset",), needs="actions of three episodes")


def _states(rows: Rows) -> Array:
    """(T, D) of what is known of the robot's place."""
    parts = [rows[name].reshape(len(rows[name]), -1) for name in (STATE, EE_POSE) if name in rows]
    return np.concatenate(parts, axis=1).astype(np.float64)


def _evidence(states: Array, fps: float) -> Array:
    """(T, N) states, and how far they go from each frame on."""
    ahead = [max(1, round(seconds * fps)) for seconds in _AHEAD_S]
    last = len(states) - 1
    steps = [states[np.minimum(np.arange(last + 1) + k, last)] - states for k in ahead]
    return np.concatenate([states, *steps], axis=1)


def _usable(dataset: Dataset) -> list[tuple[int, Array, Array]] | Found:
    """(episode, actions (T, K), evidence (T, N)), both less the dataset's means and in units of its deviations."""
    features = dataset.info.features
    if not {STATE, ACTION} <= features.keys() or not all(features[n].is_numeric for n in (STATE, ACTION)):
        return Lacking(need="actions of three episodes")
    long = [(number, rows) for number, rows in enumerate(dataset.rows) if len(rows[STATE]) >= _FEWEST_FRAMES]
    if len(long) < _FEWEST_EPISODES:
        return NotMeasured(why=f"fewer than {_FEWEST_EPISODES} episodes have {_FEWEST_FRAMES} frames")
    found = [
        (
            number,
            rows[ACTION].reshape(len(rows[ACTION]), -1).astype(np.float64),
            _evidence(_states(rows), dataset.info.fps),
        )
        for number, rows in long
    ]
    means, scales = [], []
    for part in (1, 2):
        together = np.concatenate([each[part] for each in found])
        means.append(together.mean(axis=0))
        scales.append(np.where(together.std(axis=0) > 1e-9, together.std(axis=0), np.inf))
    return [(n, (a - means[0]) / scales[0], (e - means[1]) / scales[1]) for n, a, e in found]


@likeness_check(
    group="alignment",
    measures="by how much less than usual an episode's action goes with its states, as a correlation",
    warn=0.4,
    fail=0.55,
)
def actions_go_with_states(dataset: Dataset) -> Iterator[Found]:
    """What an action does to the states is the same in each episode: catches zeros, actions of another episode or
    backwards, whatever kind of action it is.

    The action as a linear function of states and the ways that they go next, by all other episodes. Of grippers, this
    depends on what is held.
    """
    found = _usable(dataset)
    if not isinstance(found, list):
        yield found
        return
    names = dataset.info.features[ACTION].names or [""] * found[0][1].shape[1]
    is_arm = np.array([not is_gripper(name) for name in names])
    grams = [(e.T @ e, e.T @ a, len(a)) for _, a, e in found]
    square, product, count = (sum(part) for part in zip(*grams, strict=True))
    size = found[0][2].shape[1]
    common, sizes, moves = np.zeros((3, len(found), len(is_arm)))
    for row, ((_, action, evidence), (its_square, its_product, frames)) in enumerate(zip(found, grams, strict=True)):
        ridge = _RIDGE * (count - frames) * np.eye(size)
        expected = evidence @ np.linalg.solve(square - its_square + ridge, product - its_product)
        a, b = action - action.mean(axis=0), expected - expected.mean(axis=0)
        common[row] = (a * b).sum(axis=0)
        sizes[row] = np.sqrt((a**2).sum(axis=0) * (b**2).sum(axis=0))
        moves[row] = (b**2).mean(axis=0)
    clear = is_arm & (np.median(common / np.maximum(sizes, 1e-9), axis=0) > _CLEAR)
    if not clear.any():
        yield NotMeasured(why="the actions do not go with the states")
        return
    own = common[:, clear].sum(axis=1) / np.maximum(sizes[:, clear].sum(axis=1), 1e-9)
    lively = np.sqrt(moves[:, clear].sum(axis=1))
    lively = lively > _LIVELY * np.median(lively)  # of an arm that waits noise decides
    for (number, _, _), below in zip(found, (np.median(own) - own) * lively, strict=True):
        yield Measurement(value=max(float(below), 0.0), detail=f"episode {number}")


@likeness_check(
    group="alignment",
    measures="frames by which the states' motion is too early for actions that are none of their targets, or too late",
    warn=2.5,
    fail=4.5,
)
def motion_follows_action(dataset: Dataset) -> Found:
    """Increments, deltas of a pose and velocities make the state move in the same frame and soon after: catches those
    that were recorded late, early, or filtered. Targets are left to `state_follows_action`.

    By the lag at which an action is best told as a linear function of the ways that the states go in one frame.
    """
    found = _usable(dataset)
    if not isinstance(found, list):
        return found
    if np.median(_told_by_states(found)) > _TARGET:
        return NotMeasured(why="the action is a target of the state")
    fps = dataset.info.fps
    reach = max(2, round(_REACH_S * fps))
    lags = range(-reach, reach + 1)
    steps = [np.diff(_states(dataset.rows[number]), axis=0) for number, _, _ in found]
    scale = np.concatenate(steps).std(axis=0)
    width = found[0][1].shape[1]
    square, all_of = np.zeros((len(scale), len(scale))), np.zeros(width)
    products = np.zeros((len(lags), len(scale), width))
    for (_, action, _), step in zip(found, steps, strict=True):
        if len(step) <= 3 * reach:
            continue
        core = slice(reach, len(step) - reach)
        way = step[core] / np.maximum(scale, 1e-9)
        square += way.T @ way
        all_of += (action[core] ** 2).sum(axis=0)
        products += [way.T @ np.roll(action[:-1], lag, axis=0)[core] for lag in lags]
    if not all_of.any():
        return NotMeasured(why="the episodes are too short to tell which of state and action is first")
    inverse = np.linalg.inv(square + _RIDGE * max(float(np.trace(square)) / len(square), 1e-9) * np.eye(len(square)))
    told = np.einsum("lnk,nm,lmk->lk", products, inverse, products) / np.maximum(all_of, 1e-9)
    clear = np.flatnonzero(told.max(axis=0) > _CLEAR**2)
    if not len(clear):
        return NotMeasured(why="the actions do not go with the states' motion")
    lag = float(np.median([finest_lag(lags, (-told[:, element]).tolist()) for element in clear]))
    return Measurement(value=max(-lag, lag - _LATEST_S * fps, 0.0), detail=f"the states follow by {lag:+.2f} frames")


def _told_by_states(found: list[tuple[int, Array, Array]]) -> Array:
    """(K,) share of each action's variance that is a linear function of the states in the same frame."""
    size = found[0][2].shape[1] // (1 + len(_AHEAD_S))
    actions, states = np.concatenate([a for _, a, _ in found]), np.concatenate([e[:, :size] for _, _, e in found])
    square, product = states.T @ states + _RIDGE * len(states) * np.eye(size), states.T @ actions
    told = (product * np.linalg.solve(square, product)).sum(axis=0)
    return np.asarray(told / np.maximum((actions**2).sum(axis=0), 1e-9))


@check(
    group="alignment",
    on=("dataset",),
    needs=STATE_ALONE,
    measures="episodes that alone begin or end in the middle of a motion, or with another opening of the gripper",
    warn=0,
    fail=math.inf,
)
def whole_episodes(dataset: Dataset) -> Found:
    """An episode begins and ends as the others do, if these are alike: catches recordings that were cut off, halves
    of episodes, and two in one."""
    motions = [motion for motion in dataset.motions.all if len(motion.state) >= _FEWEST_FRAMES]
    if len(motions) < _FEWEST_EPISODES:
        return NotMeasured(why=f"fewer than {_FEWEST_EPISODES} episodes have {_FEWEST_FRAMES} frames")
    spread = np.concatenate([motion.state for motion in motions]).std(axis=0) + 1e-3
    gripper, wrong = motions[0].gripper, list[str]()
    for word, row in (("begins", 0), ("ends", -1)):
        speeds = np.array([_speed_at(motion, row, spread) for motion in motions])
        told = {"in the middle of a motion": speeds}
        if gripper is not None:
            opening = np.array([motion.state[row, gripper] / spread[gripper] for motion in motions])
            told["with another opening"] = np.abs(opening - np.median(opening))
        for words, off in told.items():
            alike = np.quantile(off, _MOST, method="lower") < _ALIKE
            strange = np.flatnonzero((off > _OTHER) & alike)
            if len(strange) <= max(1, _RARE * len(motions)):
                wrong += [f"{motions[number].where} {word} {words}, unlike the others" for number in strange]
    return Measurement(value=len(wrong), detail="; ".join(wrong[:3]))


def _speed_at(motion: Motion, row: int, spread: Array) -> float:
    """At the first row or the last one, as a share of its mean."""
    speed = np.linalg.norm(np.diff(motion.state / spread, axis=0), axis=1)
    few = max(1, round(_END_S * motion.fps))
    return float(speed[row * few :][:few].mean() / max(float(np.sqrt((speed**2).mean())), 1e-9))
