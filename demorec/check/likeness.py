"""Is each episode of a dataset like the others: how actions and states go together, how episodes begin and end.

Whoever recorded them: nothing has to be known of the robot.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from demorec.check.base import STATE_ALONE, Found, Lacking, Measurement, NotMeasured, check, counted
from demorec.check.cells import correlation
from demorec.check.dataset import Dataset
from demorec.check.evidence import MOVES, Flags, Motion, is_gripper, quaternion_places
from demorec.check.motion import FEWEST_TO_COMPARE
from demorec.check.rows import finest_lag
from demorec.core.geometry import Array
from demorec.episode.features import ACTION, EE_POSE, STATE

_FEWEST_EPISODES, _FEWEST_FRAMES = 3, 30
_AHEAD_S = (0.0, 0.1, 0.3)
"""How far ahead the states are looked at that an action leads to, seconds; the first is one frame."""
_RIDGE = 1e-3
_CLEAR = 0.6
"""Correlation of an element of the action with what the states of other episodes make of it, from which it counts."""
_LIVELY = 0.25
"""Share of an action's usual deviation, as the states tell it, from which on an episode is judged."""
_TARGET = 0.65
"""Share of an action's variance that the states of the same frame tell, in the median of its elements, above which it
is a target: of targets 0.84 to 0.99, of increments 0.15 to 0.47."""
CARTESIAN = re.compile(r"(^|[._])d?(x|y|z|[rq]?[xyzw]|roll|pitch|yaw)$")
"""Names of elements whose increments may be told in another frame than the pose."""
_SAME = 0.5
"""Correlation below which two courses are not of one thing."""
_REACH_S = 1.0
_LATEST_S = 0.35
"""How far behind its action a motion may be, seconds: as for states that follow targets."""

_END_S = 0.15
"""How long the first and last moments of an episode are, seconds."""
_LONG_S = 0.5
"""What counts of a second in which nothing changes: 0.2 s are usual then, and one is not."""
_MOST, _ALIKE, _OTHER, _RARE = 0.7, 0.1, 0.5, 0.05
"""Share of the episodes that are alike, how alike (in deviations of the opening, and shares of the mean speed), how far
one is off that is not, and the share of those that are not from which on it is another way to do it."""

_USUAL, _FAR, _FEW = 0.9, 2.5, 8.0
"""How many of the episodes are usual, how many times farther than those a view or an offset is off that is odd, and of
how many episodes it must be twice as many times: few tell less of what is usual. Of sets of 4 to 30 clean episodes,
drawn from 60 of each of three tasks, one in 10,000 has such a view."""
_OFFSET = 0.1
"""Distance of a joint from its targets that is usual at least, in its deviations."""

likeness_check = partial(check, group="alignment", on=("dataset",), needs="actions of three episodes")


@dataclass(frozen=True, kw_only=True, eq=False)
class _Scaled:
    """Actions and evidence of the episodes that are long enough, made anew whenever they are asked for: all of them
    together would need several times the room of the dataset.

    Attributes:
        numbers: The episodes.
        width: K elements of the action, before the N of the evidence.
        mean, deviation: (K + N,); the deviation of what stays the same is inf.
    """

    dataset: Dataset
    numbers: list[int]
    width: int
    mean: Array
    deviation: Array

    @property
    def num_states(self) -> int:
        """D: the first elements of the evidence, and as many ways of one frame after them."""
        return (len(self.mean) - self.width) // (1 + len(_AHEAD_S))

    def __iter__(self) -> Iterator[tuple[Array, Array]]:
        """(T, K) and (T, N) of each, less the dataset's means and in units of its deviations."""
        for table in _tables(self.dataset, self.numbers):
            scaled = (table - self.mean) / self.deviation
            yield scaled[:, : self.width], scaled[:, self.width :]


def _tables(dataset: Dataset, numbers: Sequence[int]) -> Iterator[Array]:
    """(T, K + N) of each episode: actions; what is known of the robot's place, and how far it goes from each frame."""
    ahead = [max(1, round(seconds * dataset.info.fps)) for seconds in _AHEAD_S]
    for number in numbers:
        named = [dataset.rows[number][name] for name in (ACTION, STATE, EE_POSE) if name in dataset.rows[number]]
        action, *parts = (values.reshape(len(values), -1).astype(np.float64) for values in named)
        states = np.concatenate(parts, axis=1)
        later = [np.minimum(np.arange(len(states)) + k, len(states) - 1) for k in ahead]
        yield np.concatenate([action, states, *(states[rows] - states for rows in later)], axis=1)


def _scaled(dataset: Dataset) -> _Scaled | Found:
    features = dataset.info.features
    if not {STATE, ACTION} <= features.keys() or not all(features[n].is_numeric for n in (STATE, ACTION)):
        return Lacking(need="actions of three episodes")
    long = [number for number, rows in enumerate(dataset.rows) if len(rows[STATE]) >= _FEWEST_FRAMES]
    if len(long) < _FEWEST_EPISODES:
        return NotMeasured(why=f"fewer than {_FEWEST_EPISODES} episodes have {_FEWEST_FRAMES} frames")
    count, width = sum(len(dataset.rows[number][STATE]) for number in long), math.prod(features[ACTION].shape)
    mean = np.asarray(sum(table.sum(axis=0) for table in _tables(dataset, long)) / count)
    square = np.asarray(sum(((table - mean) ** 2).sum(axis=0) for table in _tables(dataset, long)) / count)
    deviation = np.where(square > 1e-18, np.sqrt(square), np.inf)
    return _Scaled(dataset=dataset, numbers=long, width=width, mean=mean, deviation=deviation)


@likeness_check(
    measures="by how much less than usual an episode's action goes with its states, as a correlation",
    warn=0.4,
    fail=0.55,
)
def actions_go_with_states(dataset: Dataset) -> Iterator[Found]:
    """What an action does to the states is the same in each episode: catches zeros, actions of another episode or
    backwards, whatever kind of action it is.

    The action as a linear function of states and the ways that they go next, by all other episodes. Of grippers, this
    depends on what is held, and of quaternions on their sign.
    """
    found = _scaled(dataset)
    if not isinstance(found, _Scaled):
        yield found
        return
    size, width, names = len(found.mean) - found.width, found.width, dataset.info.features[ACTION].names or ()
    turns = {place + part for place in quaternion_places(names) for part in range(4)}
    is_linear = np.array([not is_gripper(name) and i not in turns for i, name in enumerate(names)], dtype=np.bool_)
    is_linear = is_linear if len(names) == width else np.ones(width, dtype=np.bool_)
    square, product = np.zeros((size, size)), np.zeros((size, width))
    for action, evidence in found:
        square += evidence.T @ evidence
        product += evidence.T @ action
    common, sizes, moves = np.zeros((3, len(found.numbers), width))
    for row, (action, evidence) in enumerate(found):
        others = square - evidence.T @ evidence
        ridge = _RIDGE * max(float(np.trace(others)) / size, 1e-9) * np.eye(size)
        expected = evidence @ np.linalg.solve(others + ridge, product - evidence.T @ action)
        a, b = action - action.mean(axis=0), expected - expected.mean(axis=0)
        common[row] = (a * b).sum(axis=0)
        sizes[row] = np.sqrt((a**2).sum(axis=0) * (b**2).sum(axis=0))
        moves[row] = (b**2).mean(axis=0)
    clear = is_linear & (np.median(common / np.maximum(sizes, 1e-9), axis=0) > _CLEAR)
    if not clear.any():
        yield NotMeasured(why="the actions do not go with the states")
        return
    own = common[:, clear].sum(axis=1) / np.maximum(sizes[:, clear].sum(axis=1), 1e-9)
    lively = np.sqrt(moves[:, clear].sum(axis=1))
    lively = lively > _LIVELY * np.median(lively)  # of an arm that waits noise decides
    for number, below in zip(found.numbers, (np.median(own) - own) * lively, strict=True):
        yield Measurement(value=max(float(below), 0.0), detail=f"episode {number}")


@likeness_check(
    measures="frames by which the states' motion is too early for actions that are none of their targets, or too late",
    warn=2.5,
    fail=4.5,
)
def motion_follows_action(dataset: Dataset) -> Found:
    """Increments, deltas of a pose and velocities make the state move in the same frame and soon after: catches those
    that were recorded late, early, or filtered. Targets are left to `state_follows_action`.

    By the lag at which an action is best told as a linear function of the ways that the states go in one frame. A joint
    that goes the other way than its action is infinitely late.
    """
    found = _scaled(dataset)
    if not isinstance(found, _Scaled):
        return found
    if np.median(_told_by_states(found)) > _TARGET:
        return NotMeasured(why="the action is a target of the state")
    fps = dataset.info.fps
    reach = max(2, round(_REACH_S * fps))
    lags = range(-reach, reach + 1)
    size, width = found.num_states, found.width
    square, products, all_of = np.zeros((size, size)), np.zeros((len(lags), size, width)), np.zeros(width)
    for action, evidence in found:
        if len(action) <= 3 * reach + 1:
            continue
        core = slice(reach, len(action) - 1 - reach)
        way = evidence[:-1, size : 2 * size][core]
        square += way.T @ way
        all_of += (action[:-1][core] ** 2).sum(axis=0)
        products += [way.T @ np.roll(action[:-1], lag, axis=0)[core] for lag in lags]
    if not all_of.any():
        return NotMeasured(why="the episodes are too short to tell which of state and action is first")
    inverse = np.linalg.inv(square + _RIDGE * max(float(np.trace(square)) / len(square), 1e-9) * np.eye(len(square)))
    told = np.einsum("lnk,nm,lmk->lk", products, inverse, products) / np.maximum(all_of, 1e-9)
    clear = np.flatnonzero(told.max(axis=0) > _CLEAR**2)
    if not len(clear):
        return NotMeasured(why="the actions do not go with the states' motion")
    lag = float(np.median([finest_lag(lags, (-told[:, element]).tolist()) for element in clear]))
    soon = slice(reach, reach + max(2, round(_LATEST_S * fps)))
    for joint, state in same_joints(dataset):
        size_of = math.sqrt(max(float(square[state, state] * all_of[joint]), 1e-9))
        goes = products[soon, state, joint] / size_of
        if goes.min() < -_CLEAR and goes.max() < _CLEAR / 2:  # noise that is taken back goes both ways
            return Measurement(value=math.inf, detail=f"{_names(dataset, ACTION)[joint]} moves it the other way")
    return Measurement(value=max(-lag, lag - _LATEST_S * fps, 0.0), detail=f"the states follow by {lag:+.2f} frames")


def _names(dataset: Dataset, feature: str) -> Sequence[str]:
    """Of the elements of a feature; none where it is not there, or names something else."""
    described = dataset.info.features.get(feature)
    names = () if described is None else described.names or ()
    return names if described is not None and described.shape == (len(names),) else ()


def same_joints(dataset: Dataset) -> Iterator[tuple[int, int]]:
    """Elements of action and state that are called after the same joint."""
    joints = [name.rpartition(".")[0] or name for name in _names(dataset, STATE)]
    for number, name in enumerate(_names(dataset, ACTION)):
        joint = name.rpartition(".")[0] or name
        if joints.count(joint) == 1 and not is_gripper(name) and not CARTESIAN.search(name):
            yield number, joints.index(joint)


@likeness_check(
    measures="episodes in which a joint is farther from its targets than in the others",
    fail=math.inf,
)
def offsets_alike(dataset: Dataset) -> Found:
    """A joint is as far from its targets as it always is, in the mean of an episode: catches an arm or a leader that
    slips, or was calibrated anew."""
    if not dataset.motions.targets:
        return NotMeasured(why="the action is no target of the state")
    motions = [m for m in dataset.motions.all if m.action is not None and len(m.state) >= _FEWEST_FRAMES]
    if len(motions) < FEWEST_TO_COMPARE:
        return NotMeasured(why=f"fewer than {FEWEST_TO_COMPARE} episodes have {_FEWEST_FRAMES} frames")
    spread = np.concatenate([motion.state for motion in motions]).std(axis=0)
    means = np.array([np.mean(m.action - m.state, axis=0) for m in motions if m.action is not None])
    wrong = []
    for element in np.flatnonzero(dataset.motions.moving & np.isfinite(means).all(axis=0)).tolist():
        if element != motions[0].gripper:  # what it holds decides
            off = np.abs(means[:, element] - np.median(means[:, element])) / spread[element]
            name = motions[0].names[element]
            wrong += [f"{name}, {motions[row].where}" for row in np.flatnonzero(far_off(off, _OFFSET))]
    return counted(wrong)


@likeness_check(
    measures="joints whose action is called a position, as their state is, where no action is a target of the state",
    fail=math.inf,
)
def targets_as_named(dataset: Dataset) -> Found:
    """What state and action call joint.pos is a position in both: catches increments and speeds of that name."""
    named = [name for name in _names(dataset, ACTION) if name.endswith(".pos") and name in _names(dataset, STATE)]
    if not named or not dataset.motions.moving.any():
        return NotMeasured(why="no joint that moves is called a position (.pos) in state and action")
    wrong = [] if dataset.motions.targets else named
    return Measurement(value=len(wrong), detail=", ".join(wrong[:3]))


@likeness_check(
    needs="an element that two observations have",
    measures="elements of one name that go their own ways in two observations",
    fail=math.inf,
)
def same_by_name(dataset: Dataset) -> Found:
    """What two observations call by one name (tcp.x) goes the same way in both, in any unit: catches one that is of
    another episode, very late, or frozen. Names without a thing (x) may mean several."""
    places: dict[str, list[tuple[str, int]]] = {}
    for feature, described in dataset.info.features.items():
        if feature.startswith("observation.") and described.is_numeric:
            for number, name in enumerate(_names(dataset, feature)):
                places.setdefault(name, []).append((feature, number))
    twice = {name: found[:2] for name, found in places.items() if "." in name and len(found) > 1}
    if not twice:
        return Lacking(need="an element that two observations have")
    wrong = []
    for name, ((one, i), (other, k)) in twice.items():
        a, b = (np.concatenate([rows[f][:, n] for rows in dataset.rows]) for f, n in ((one, i), (other, k)))
        if max(np.ptp(a), np.ptp(b)) > MOVES and abs(correlation(a, b)) < _SAME:
            wrong.append(f"{name} of {one} and {other}")
    return counted(wrong)


def _told_by_states(found: _Scaled) -> Array:
    """(K,) share of each action's variance that is a linear function of the states in the same frame."""
    size, width, count = found.num_states, found.width, 0
    square, product, total = np.zeros((size, size)), np.zeros((size, width)), np.zeros(width)
    for action, evidence in found:
        states = evidence[:, :size]
        square += states.T @ states
        product += states.T @ action
        total += (action**2).sum(axis=0)
        count += len(action)
    told = (product * np.linalg.solve(square + _RIDGE * count * np.eye(size), product)).sum(axis=0)
    return np.asarray(told / np.maximum(total, 1e-9))


@likeness_check(
    needs=STATE_ALONE,
    measures="episodes that alone begin or end in the middle of a motion, with another opening, or standing still",
    fail=math.inf,
)
def whole_episodes(dataset: Dataset) -> Found:
    """An episode begins and ends as the others do, if these are alike, and some of its own instruction among them:
    catches recordings that were cut off, halves of episodes, two in one, and ends that were filled up."""
    long = [
        (motion, int(rows["task_index"].reshape(-1)[0]))
        for motion, rows in zip(dataset.motions.all, dataset.rows, strict=False)
        if len(motion.state) >= _FEWEST_FRAMES
    ]
    if len(long) < _FEWEST_EPISODES:
        return NotMeasured(why=f"fewer than {_FEWEST_EPISODES} episodes have {_FEWEST_FRAMES} frames")
    motions, tasks = [motion for motion, _ in long], np.array([task for _, task in long])
    spread = np.concatenate([motion.state for motion in motions]).std(axis=0) + 1e-3
    gripper, wrong = motions[0].gripper, list[str]()
    for word, row in (("begins", 0), ("ends", -1)):
        speeds = np.array([_speed_at(motion, row, spread) for motion in motions])
        told = {"in the middle of a motion": speeds}
        told["with one and the same row for long"] = _LONG_S * np.array([_stays_at(motion, row) for motion in motions])
        if gripper is not None:
            opening = np.array([motion.state[row, gripper] / spread[gripper] for motion in motions])
            told["with another opening"] = np.abs(opening - np.median(opening))
        for words, off in told.items():
            alike = np.quantile(off, _MOST, method="lower") < _ALIKE
            strange = np.flatnonzero((off > _OTHER) & alike & np.isin(tasks, tasks[off <= _OTHER]))
            if len(strange) <= max(1, _RARE * len(motions)):
                wrong += [f"{motions[number].where} {word} {words}, unlike the others" for number in strange]
    return counted(wrong)


def _speed_at(motion: Motion, row: int, spread: Array) -> float:
    """Of the arm at the first row or the last one, as a share of its mean."""
    arm = (motion.state / spread)[:, ~motion.grippers]
    speed = np.linalg.norm(np.diff(arm, axis=0), axis=1)
    few = max(1, round(_END_S * motion.fps))
    return float(speed[row * few :][:few].mean() / max(float(np.sqrt((speed**2).mean())), 1e-9))


def _stays_at(motion: Motion, row: int) -> float:
    """How long, seconds, state and action are those of the first row, or the last one, to the last bit."""
    rows = motion.state if motion.action is None else np.column_stack([motion.state, motion.action])
    differ = ((rows != rows[row]) & ~np.isnan(rows)).any(axis=1)[:: 1 if row == 0 else -1]
    return (int(np.argmax(differ)) if differ.any() else len(rows)) / motion.fps


def far_off(off: Array, least: float) -> Flags:
    """Which of N are much farther off than most, when `least` is usual at least."""
    times = _FAR * (1 + _FEW / len(off))
    return np.asarray(off > times * max(float(np.quantile(off, _USUAL, method="lower")), least))
