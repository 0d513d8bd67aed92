"""What is measured of one episode's motion: plain numbers, by which episodes of one task are compared with each other.

Elements count in units of the range that the dataset has of them, so that radians, degrees and per cent are alike.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from demorec.check.evidence import Flags, Motion
from demorec.check.rows import finest_lag, longest_run
from demorec.core.geometry import Array

_RISES, _FALLS = 0.65, 0.35
"""Share of its range above which a gripper's command counts as high, and below which as low again."""
_STILL = 0.08
"""Share of the episode's fast speed (its 90 % quantile) below which an arm stands."""
_ALIKE = 3.0
"""Times the range of a gripper's opening that its command may have to be in the same unit."""
_STEADY = 0.02
"""Share of its range by which a gripper that stands may move from frame to frame."""
_REACH_S, _HELD_S, _LOST_S = 0.5, 0.3, 0.15
"""Seconds: within which a lag is looked for, for which something was held before it is lost, in which it is lost."""
_SMOOTHED_S, _PROMINENT = 0.15, 0.15
"""Seconds over which speed is smoothed, and by how much of the fast speed a stroke rises above what is around it."""
_POINTS = 12
"""Of a course between two changes of the gripper, at equal distances along it."""
_EXTREME = 1e-3
"""Share of its range from its largest or least value at which an element counts as saturated."""


class Reading(NamedTuple):
    """A number, and the frames (the last one too) that it comes from."""

    value: float
    first: int
    last: int


class Scale(NamedTuple):
    """What elements of state and action range over in a dataset; rows are their least and their largest value.

    Attributes:
        state, action: (2, D) without the outermost tenth of the episodes, so that a broken one does not decide.
        outermost: (2, D) of the action, of all episodes.
    """

    state: Array
    action: Array
    outermost: Array


def scale_of(motions: Iterable[Motion]) -> Scale | None:
    """Of all episodes; None for none."""
    found = [
        [
            np.stack([values.min(axis=0), values.max(axis=0)])
            for values in (motion.state, motion.state if motion.action is None else motion.action)
        ]
        for motion in motions
    ]
    if not found:
        return None
    state, action = (np.stack(part) for part in zip(*found, strict=True))
    outermost = np.stack([action[:, 0].min(axis=0), action[:, 1].max(axis=0)])
    return Scale(_inner(state), _inner(action), outermost)


def _inner(ranges: Array) -> Array:
    return np.stack([np.quantile(ranges[:, 0], 0.1, axis=0), np.quantile(ranges[:, 1], 0.9, axis=0)])


def _width(ranges: Array, kept: Flags) -> Array:
    """(K,) of some elements; one that hardly moves, beside the others, does not count as much as they do."""
    width = np.asarray(ranges[1] - ranges[0])[kept]
    middle = float(np.median(width)) if len(width) else 0.0
    return np.asarray(np.maximum(width, max(0.2 * middle, 1e-9)))


@dataclass(frozen=True, kw_only=True, eq=False)
class Movement:
    """Of one episode.

    Attributes:
        readings: What is measured -> its number.
        grips: (first, last) frames of which a gripper is not as at the beginning.
        courses: (S, 12, K) where the arm is sent between the switches, at equal distances along the way, less the
            straight line.
        ends: (S + 1, K) where it is sent at the beginning, at the switches and at the end.
        costs: (S, 2) seconds and length of each of these stretches.
        fps: Frames per second.
        steps: (T - 1,) how far the arm goes from frame to frame.
        bounds: Frames at which the stretches of the course begin and end.
    """

    readings: Mapping[str, Reading]
    grips: tuple[tuple[int, int], ...]
    courses: Array
    ends: Array
    costs: Array
    fps: float
    steps: Array
    bounds: tuple[int, ...]


def movement(motion: Motion, scale: Scale) -> Movement:
    """Measure an episode of eight frames or more."""
    opens = motion.grippers
    arm = ~opens if not opens.all() else opens
    state = motion.state[:, arm] / _width(scale.state, arm)
    steps = np.linalg.norm(np.diff(state, axis=0), axis=1)
    action = motion.action if motion.action is not None and np.isfinite(motion.action).all() else None
    hands = [_hand(motion, scale, int(element)) for element in np.flatnonzero(opens)]
    last = len(state) - 1
    switches = np.unique([frame + 1 for _, command in hands for frame in np.flatnonzero(np.diff(_levels(command)))])
    bounds = (0, *(int(frame) for frame in switches if frame < last), last)
    readings = dict(_of_state(state, steps, motion.fps, hands))
    readings["switches"] = Reading(len(switches), 0, last)
    guide = state
    if action is not None:
        scaled = action[:, arm] / _width(scale.action, arm)
        lag, is_target = _lag(state, scaled, motion.fps)
        guide = scaled if is_target else state
        readings |= {"action noise": _roughness(scaled), "limit": _saturation(motion, action, scale, arm)}
        readings |= {"lag": Reading(lag, 0, last)} if lag is not None else {}
    readings["strokes"] = Reading(_strokes(guide, motion.fps), 0, last)
    for opening, command in hands:
        for name, reading in _of_hand(opening, command, motion.fps):
            known = readings.setdefault(name, reading)
            if (reading.value > known.value) == (name == "slip"):  # of two hands the one that holds less, or loses more
                readings[name] = reading
    stretches = [guide[a : b + 1] for a, b in pairwise(bounds)]
    lengths = [np.linalg.norm(np.diff(way, axis=0), axis=1).sum() for way in stretches]
    return Movement(
        readings=readings,
        grips=tuple(grip for _, command in hands for grip in _grips(command)),
        courses=np.stack([_course(way) for way in stretches]),
        ends=guide[list(bounds)],
        costs=np.column_stack([np.diff(bounds) / motion.fps, lengths]),
        fps=motion.fps,
        steps=steps,
        bounds=bounds,
    )


def _strokes(guide: Array, fps: float) -> int:
    """How often the arm gets faster and slower again: the movements that a motion is made of."""
    from scipy.signal import find_peaks  # takes a while to load

    speed = np.linalg.norm(np.diff(guide, axis=0), axis=1)
    width = max(1, round(_SMOOTHED_S * fps))
    smooth = np.convolve(speed, np.ones(width) / width, mode="same")
    peaks, _ = find_peaks(np.concatenate([[0.0], smooth, [0.0]]), prominence=_PROMINENT * np.quantile(smooth, 0.9))
    return len(peaks)


def _hand(motion: Motion, scale: Scale, element: int) -> tuple[Array, Array]:
    """(T,) opening and command of a gripper in units of their ranges; the opening for both where none is commanded."""
    opens, target = scale.state[:, element], scale.action[:, element]

    def of(values: Array, ranges: Array) -> Array:
        return np.asarray((values[:, element] - ranges[0]) / max(ranges[1] - ranges[0], 1e-9))

    if motion.action is None or not np.isfinite(motion.action[:, element]).all():
        return of(motion.state, opens), of(motion.state, opens)
    narrow, wide = sorted((opens[1] - opens[0], target[1] - target[0]))
    if wide < _ALIKE * narrow and max(opens[0], target[0]) < min(opens[1], target[1]):  # in the same unit
        opens = target = np.array([min(opens[0], target[0]), max(opens[1], target[1])])
    return of(motion.state, opens), of(motion.action, target)


def _levels(command: Array) -> Flags:
    """(T,) whether a gripper's command is high; between the two levels it stays as it was."""
    known = np.where(command > _RISES, 1, np.where(command < _FALLS, 0, -1))
    known[0] = command[0] > 0.5 if known[0] < 0 else known[0]
    last = np.maximum.accumulate(np.where(known >= 0, np.arange(len(known)), 0))
    return np.asarray(known[last] == 1)


def _grips(command: Array) -> list[tuple[int, int]]:
    levels = _levels(command)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], levels != levels[0], [False]]).astype(int)))
    return [(int(a), int(b) - 1) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def _of_state(
    state: Array, steps: Array, fps: float, hands: Sequence[tuple[Array, Array]]
) -> Iterator[tuple[str, Reading]]:
    last = len(state) - 1
    fast = max(float(np.quantile(steps, 0.9)), 1e-9)
    still = steps < _STILL * fast
    for opening, _ in hands:
        still &= np.abs(np.diff(opening)) < _STEADY
    moving = np.flatnonzero(~still)
    head, tail = (int(moving[0]), int(moving[-1]) + 1) if len(moving) else (0, last)
    inner = still.copy()
    inner[:head] = inner[tail:] = False
    length, start = longest_run(inner)
    yield "pause", Reading(length / fps, start, start + length)
    yield "idle", Reading(float(still.sum()) / fps, 0, last)
    yield "duration", Reading(float(np.log(len(state) / fps)), 0, last)
    tenth = max(2, round(0.2 * fps))
    yield "end speed", Reading(float(steps[-tenth:].mean()) / fast, max(last - tenth, 0), last)
    yield "state noise", _roughness(state)
    off = np.abs(state[1:-1] - (state[2:] + state[:-2]) / 2).max(axis=1)
    worst = int(np.argmax(off)) + 1
    yield "jump", Reading(float(np.log(off.max() + 1e-3)), worst - 1, worst + 1)


def _roughness(values: Array) -> Reading:
    """Third differences, which a smooth motion has hardly any of and white noise has most."""
    third = np.linalg.norm(np.diff(values, 3, axis=0), axis=1)
    return Reading(float(np.log(np.quantile(third, 0.75) + 1e-4)), 0, len(values) - 1)


def _lag(state: Array, action: Array, fps: float) -> tuple[float | None, bool]:
    """Frames by which the state follows the action, None where it does not; whether the action is a target of it."""
    reach = max(2, round(_REACH_S * fps))
    if len(state) < 4 * reach:
        return None, False
    for is_target in (True, False):  # else increments or speeds
        values = state if is_target else np.diff(state, axis=0, prepend=state[:1]) * fps
        core, lags = values[reach:-reach], range(-reach, reach + 1)
        errors = [float((core - action[reach - lag : len(action) - reach - lag]).var(axis=0).sum()) for lag in lags]
        if min(errors) < 0.5 * float(core.var(axis=0).sum()):
            return finest_lag(lags, np.sqrt(errors).tolist()), is_target
    return None, False


def _saturation(motion: Motion, action: Array, scale: Scale, arm: Flags) -> Reading:
    """Share of the frames in which the action of a joint is at the end of its range."""
    width = np.maximum(scale.outermost[1] - scale.outermost[0], 1e-9)
    low, high = np.maximum(scale.outermost[0], motion.lower), np.minimum(scale.outermost[1], motion.upper)
    at_end = (action < low + _EXTREME * width) | (action > high - _EXTREME * width)
    at_end &= np.ptp(action, axis=0) > _EXTREME * width  # an axis that is never used is at no end
    frames = np.flatnonzero(at_end[:, arm].any(axis=1))
    first, last = (int(frames[0]), int(frames[-1])) if len(frames) else (0, 0)
    return Reading(len(frames) / len(action), first, last)


def _of_hand(opening: Array, command: Array, fps: float) -> Iterator[tuple[str, Reading]]:
    held, lost = max(2, round(_HELD_S * fps)), max(1, round(_LOST_S * fps))
    worst = Reading(0.0, 0, 0)
    for frame in range(held, len(opening) - lost):
        before, after = slice(frame - held, frame + 1), slice(frame - held, frame + lost + 1)
        if np.ptp(opening[before]) > _STEADY:
            continue
        toward = np.sign(command[frame] - opening[frame]) * (opening[frame + lost] - opening[frame])
        value = float(toward - np.ptp(command[after]))
        if value > worst.value:
            worst = Reading(value, frame, frame + lost)
    yield "slip", worst
    gap = np.abs(opening - command)
    if grips := [Reading(float(np.median(gap[first : last + 1])), first, last) for first, last in _grips(command)]:
        yield "grip", max(grips)


def _course(way: NDArray[np.float64]) -> Array:
    """(12, K) of a way (T, K) at equal distances along it, less the straight line between its ends."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(way, axis=0), axis=1) + 1e-9)])
    shares = np.linspace(0, 1, _POINTS)
    points = np.stack([np.interp(shares * along[-1], along, column) for column in way.T], axis=1)
    return np.asarray(points - (way[0] + shares[:, None] * (way[-1] - way[0])))
