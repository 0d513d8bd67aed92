"""Checks of motion for any episode with what they need, whoever recorded it: numbers, limits, velocities, lag."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from demorec.check.base import ANY_EPISODE, Found, Measurement, NotMeasured, check, worst_frame
from demorec.check.dataset import Episodes
from demorec.check.evidence import MIN_FRAMES, MIN_RANGE, Flags, Motion, without_gaps
from demorec.core.geometry import Array

URDF = "a robot whose URDF is known (--urdf FILE)"
VELOCITIES = "velocities of the state's elements"
TARGETS = "actions that are targets of the state's elements"

WINDOW_S = 0.3
"""Time over which velocities are integrated: filters of drivers are 20 to 100 ms late, which cancels over longer."""
MIN_FPS = 20
"""Frames per second below which two velocities say little of the displacement between them."""
MIN_SHARE = 0.01
"""Share of the largest squared displacement below which noise decides the ratio of an element."""
MIN_EPISODE_SHARE = 0.25
"""Share of the usual squared displacement below which an episode is not judged by itself."""
MIN_WINDOWS = 20
"""Windows below which an episode is not judged by itself."""

MIN_LIVE_SHARE = 0.5
"""Share of the moving frames, outside its longest rest, in which a sensor changes that is not allowed to rest."""
MIN_SPEED = 0.3
"""Share of the root mean square speed above which something counts as moving."""

MAX_LAG_S = 0.35
"""How far a state may follow its action: hobby servos under teleoperation need 0.1 to 0.2 s."""
REACH_S = 1.0
"""Range of the lags that are tried."""
MIN_TARGET_CORRELATION = 0.5
"""Correlation with its own element above which an action is a target of the state: at least 0.97 in demonstrations of
Panda and iiwa, where increments and poses have at most 0.3."""
MIN_LAG_GAIN = 0.8
"""Error at the best lag, as a share of the errors at the ends of the range, above which the lag says nothing."""

motion_check = partial(check, group="physics", on=ANY_EPISODE)


@motion_check(measures="numbers that are NaN or infinite", needs="numbers")
def finite_numbers(subject: Episodes) -> Measurement:
    """Count the numbers that are NaN or infinite, in every column of every frame."""
    total, first = 0, Measurement(value=0)
    for name, table in subject.numbers():
        wrong = ~np.isfinite(table)
        if wrong.any():
            frame = int(wrong.reshape(len(table), -1).any(axis=1).argmax())
            first = first if total else Measurement(value=0, frame=frame, detail=name)
            total += int(wrong.sum())
    return Measurement(value=total, frame=first.frame, detail=first.detail)


@motion_check(
    measures="how far the state is beyond the limits of its joints",
    unit="rad, m",
    warn=0.01,
    fail=0.2,
    needs=URDF,
)
def joint_limits(subject: Episodes) -> Iterator[Found]:
    """Compare the state with the limits of the robot's URDF: catches degrees for radians, and offsets."""
    for motion in subject.motions:
        known = np.flatnonzero(np.isfinite(motion.lower) | np.isfinite(motion.upper))
        if not len(known):
            yield NotMeasured(why=f"it needs {URDF}")
            return
        for element in known.tolist():
            position = motion.state[:, element]
            beyond = np.maximum(np.maximum(motion.lower[element] - position, position - motion.upper[element]), 0.0)
            yield worst_frame(beyond, _where(motion.names[element], motion))


def _where(what: str, motion: Motion) -> str:
    return ", ".join(filter(None, (what, motion.where)))


@motion_check(
    measures="ratio of state differences to velocities, distance from 1",
    warn=0.1,
    fail=0.16,
    needs=VELOCITIES,
)
def velocity_matches_position(subject: Episodes) -> Iterator[Found]:
    """Compare states with integrated velocities: each element over all episodes, and all elements in each episode.

    Catches wrong rates, units and joints. An episode counts half: its ratio has more of the noise.
    """
    motions = [motion for motion in subject.motions if motion.velocity is not None and len(motion.state) > 1]
    if not motions:
        yield NotMeasured(why=f"it needs {VELOCITIES}")
        return
    if motions[0].fps < MIN_FPS:
        yield NotMeasured(why=f"fewer than {MIN_FPS} frames a second")
        return
    sums = np.array([_products(motion) for motion in motions])  # (E, 3, D)
    product, square, total = sums.sum(axis=0)
    for element in np.flatnonzero(total > MIN_SHARE * total.max(initial=0.0)).tolist():
        ratio = product[element] / max(square[element], 1e-12)
        yield Measurement(value=abs(ratio - 1), detail=f"{motions[0].names[element]}: ratio {ratio:.3f}")
    counts = np.array([len(motion.state) for motion in motions])
    usual = total.sum() / counts.sum()
    for motion, (product, square, total) in zip(motions, sums.sum(axis=2), strict=True):
        if len(motion.state) >= MIN_WINDOWS and total > MIN_EPISODE_SHARE * usual * len(motion.state):
            ratio = product / max(square, 1e-12)
            yield Measurement(value=abs(ratio - 1) / 2, detail=_where(f"ratio {ratio:.3f}", motion))


def _products(motion: Motion) -> Array:
    """(3, D) sums over windows: displacement times integrated velocity, the squares of both; 0 where not known.

    Grippers are left out: they start and stop within a few frames.
    """
    assert motion.velocity is not None
    velocity = without_gaps(motion.velocity)
    mean = (velocity[1:] + velocity[:-1]) / 2
    course = np.vstack([np.zeros(mean.shape[1]), np.cumsum(mean * motion.steps_s[:, None], axis=0)])
    window = min(max(1, round(WINDOW_S * motion.fps)), len(course) - 1)
    integrated = course[window:] - course[:-window]
    state = without_gaps(motion.state)
    moved = state[window:] - state[:-window]
    sums = np.array([(moved * integrated).sum(axis=0), (integrated**2).sum(axis=0), (moved**2).sum(axis=0)])
    known = np.isfinite(sums).all(axis=0) & ~motion.grippers
    return np.asarray(np.where(known, sums, 0.0))


@motion_check(
    measures="longest time for which a sensor repeats its value to the last bit while the robot moves",
    unit="s",
    warn=0.3,
    fail=1.0,
    needs="a state",
)
def frozen_sensors(subject: Episodes) -> Iterator[Found]:
    """Find sensors that stop changing while the robot moves, and elements of the state that ignore their action.

    A sensor may rest at zero, as a contact sensor does, or where it usually rests. One that never changes, in any
    episode, is a warning.
    """
    motions = subject.motions
    live = {name for motion in motions for name, table in motion.sensors.items() if (table != table[:1]).any()}
    for motion in motions:
        yield from _frozen_elements(motion)
        moves = moves_of(motion.state)
        for name, table in motion.sensors.items():
            same = (table[1:] == table[:-1]).all(axis=1) & table[1:].any(axis=1)
            rest = longest_rest(same, moves)
            changes = (table[1:] != table[:-1]).any(axis=1) & moves
            if changes[rest.outside].sum() >= MIN_LIVE_SHARE * moves[rest.outside].sum():
                seconds = rest.moving / motion.fps
                seconds = seconds if name in live else min(seconds, frozen_sensors.fail)
                frame = rest.start + 1 if rest.moving else None
                yield Measurement(value=seconds, frame=frame, detail=_where(name, motion))


def _frozen_elements(motion: Motion) -> Iterator[Found]:
    """The longest rest of each element of the state while its own action moves."""
    for element, name in enumerate(motion.names if motion.action is not None else ()):
        assert motion.action is not None
        action = motion.action[:, [element]]
        if np.isfinite(action).any() and np.ptp(without_gaps(action)) > MIN_RANGE:
            same = motion.state[1:, element] == motion.state[:-1, element]
            rest = longest_rest(same, moves_of(action))
            frame = rest.start + 1 if rest.moving else None
            yield Measurement(value=rest.moving / motion.fps, frame=frame, detail=_where(name, motion))


@check(
    group="alignment",
    on=ANY_EPISODE,
    measures="frames by which the state is too early for its action, or too late",
    warn=0.75,
    fail=0.95,
    needs=TARGETS,
)
def action_lag(subject: Episodes) -> Found:
    """Measure how far the state follows the action: by about a frame or more, and at most a third of a second.

    Catches actions that were recorded late or early, or that are the state itself, from which a policy learns to stand
    still. The lag of an element is where state and action differ least; the median of all elements counts.
    """
    motions = subject.motions
    moving = _moving(motions)
    targets = _targets(motions, moving) if moving.any() else []
    if not targets:
        return NotMeasured(why=f"there are no {TARGETS} (by names and correlation)")
    fps = motions[0].fps
    reach = max(2, round(REACH_S * fps))
    lags = range(-reach, reach + 1)
    long = [(state, action) for state, action in targets if len(state) > 3 * reach]
    if not long:
        return NotMeasured(why="the episodes are too short to tell whether state or action is first")
    squares = np.zeros((len(lags), long[0][0].shape[1]))
    for state, action in long:
        core = slice(reach, len(state) - reach)
        # The variance: an offset, and weight, keep state and action apart whatever the lag.
        squares += [len(state) * (state[core] - np.roll(action, lag, axis=0)[core]).var(axis=0) for lag in lags]
    error = np.sqrt(squares)
    is_arm = ~motions[0].grippers[moving]  # a gripper is slower, and stops at what it holds
    judged = np.flatnonzero((error.min(axis=0) < MIN_LAG_GAIN * np.minimum(error[0], error[-1])) & is_arm)
    if not len(judged):
        return NotMeasured(why="state and action of the arm move too little to tell which of them is first")
    lag = float(np.median([_finest_lag(lags, error[:, element].tolist()) for element in judged]))
    return Measurement(value=max(1 - lag, lag - MAX_LAG_S * fps, 0.0), detail=f"the state follows by {lag:+.2f} frames")


def _range(values: Array) -> Array:
    """(D,) range of each column of (T, D); 0 for one without numbers."""
    return np.asarray(np.ptp(np.nan_to_num(without_gaps(values)), axis=0))


def _moving(motions: Sequence[Motion]) -> Flags:
    """(D,) elements that have an action, and of which state and action change in some episode."""
    moves = [
        (_range(motion.state) > MIN_RANGE) & (_range(motion.action) > MIN_RANGE)
        for motion in motions
        if motion.action is not None
    ]
    return np.asarray(np.any(moves, axis=0)) if moves else np.zeros(0, dtype=np.bool_)


def _targets(motions: Sequence[Motion], kept: Flags) -> list[tuple[Array, Array]]:
    """(T, K) states and actions of each episode, of the K elements that are `kept`.

    They are without gaps, less their means, and in units of the state's deviation. Empty where the action is not a
    target of the state.
    """
    found = []
    for motion in motions:
        if motion.action is not None and len(motion.state) >= MIN_FRAMES:
            state = without_gaps(motion.state[:, kept])
            action = without_gaps(motion.action[:, kept])
            deviation = np.maximum(state.std(axis=0), MIN_RANGE)
            found.append(((state - state.mean(axis=0)) / deviation, (action - action.mean(axis=0)) / deviation))
    if not found:
        return []
    states = np.concatenate([state for state, _ in found])
    actions = np.concatenate([action for _, action in found])
    sizes = np.sqrt((states**2).sum(axis=0) * (actions**2).sum(axis=0))
    correlations = (states * actions).sum(axis=0) / np.maximum(sizes, 1e-12)
    return found if float(np.median(correlations)) > MIN_TARGET_CORRELATION else []


def _finest_lag(lags: Sequence[int], errors: Sequence[float]) -> float:
    """The lag of the least error: the best of whole lags, and a parabola through it and its neighbours."""
    best = int(np.argmin(errors))
    if best in (0, len(errors) - 1):
        return float(lags[best])
    low, middle, high = errors[best - 1 : best + 2]
    bend = low - 2 * middle + high
    return lags[best] + (0.5 * (low - high) / bend if bend > 0 else 0.0)


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
