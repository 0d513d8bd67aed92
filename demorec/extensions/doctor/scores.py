"""Scores of episodes by the distance of their quantities from those of other episodes with the same instruction.

The distance is in usual spreads: a robust standard deviation over these episodes, at least the minimum spread of
`_QUANTITIES`, below which differences do not matter. Most episodes lose nothing. Elements of state and action are
scaled by their range in the set, so that radians, degrees and per cent are equivalent.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from demorec.check.base import NotMeasuredError
from demorec.core.geometry import Array
from demorec.extensions.doctor.evidence import Evidence
from demorec.extensions.doctor.relation import relation_of
from demorec.extensions.doctor.robust import NORMAL
from demorec.extensions.doctor.units import MIN_OTHERS, moving_elements, other_units

MIN_EPISODES = 12
"""Minimum number of episodes with one instruction to compare them with each other; fewer are compared with the whole
set."""
_HALF = 7.0
"""Number of usual spreads that costs about two thirds of the score."""
_STEEPNESS = 4
_MIN_LOSS = 0.05
"""Minimum loss of score for a reason to be given."""
_QUANTITIES: Mapping[str, tuple[float, str]] = {
    "pause": (0.1, "pauses for {value:.1f} s during the motion (usually {usual:.1f} s)"),
    "path": (0.1, "takes a detour of {value:.0%} of the range (usually {usual:.0%})"),
    "noise": (0.2, "the action shakes {ratio:.1f} times as much as usual"),
    "duration": (0.1, "takes {ratio:.2f} times as long as usual"),
    "lag": (0.3, "the state follows the action by {value:+.0f} frames (usually {usual:+.0f})"),
    "switches": (0.12, "the gripper is switched {value:.0f} times (usually {usual:.0f})"),
}
"""Quantity -> its minimum spread, and the reason in words; {ratio} is that of logarithms."""
_TWO_SIDED = ("duration", "lag", "switches")
"""Quantities for which less than usual is unusual as well."""
_MIN_FRAMES = 8
_LEVELS = ((0.35, 0.65), (0.25, 0.55), (0.45, 0.75))
"""Maximum of a gripper's low command and minimum of its high one, as ratios of its range. A number of switches must be
unusual at all of them: objects of other sizes hold the gripper at any opening."""
_STILL_RATIO = 0.08
"""Maximum speed of an arm at rest, relative to the episode's fast speed (its 90 % quantile)."""
_STEADY = 0.02
"""Maximum motion of a gripper at rest, as a ratio of its range."""


class Reason(NamedTuple):
    """One loss of score: the remaining factor, the reason in words, the first and the last frame."""

    kind: str
    factor: float
    spreads: float
    text: str
    first: int
    last: int


@dataclass(frozen=True, kw_only=True)
class EpisodeScore:
    """Score of one episode; the largest loss comes first."""

    episode: int
    score: float
    reasons: tuple[Reason, ...]


class QuantityReading(NamedTuple):
    """A number, its first and last frame, and the number measured in other ways."""

    value: float
    first: int
    last: int
    others: tuple[float, ...] = ()


class ArmMotion(NamedTuple):
    """State and action (T, D) of the same elements; without an action the state replaces it."""

    state: Array
    action: Array


def score_episodes(evidence: Evidence) -> dict[int, EpisodeScore]:
    """Compute episode number -> its score: 1 if nothing is unusual; 0 if unreadable, too short or in another unit."""
    flaws = dict.fromkeys(evidence.unreadable, "cannot be read")
    flaws |= {e.number: f"has {e.length} frames" for e in evidence.episodes if e.length < _MIN_FRAMES}
    flaws |= dict.fromkeys(evidence.once(other_units), "has another unit than the other episodes")
    readings = measure(evidence)
    reasons: dict[int, list[Reason]] = {each.number: [] for each in evidence.episodes}
    for number, flaw in flaws.items():
        reasons[number] = [Reason("flaw", 0.0, math.inf, flaw, 0, 0)]
    tasks = {episode.number: episode.instruction for episode in evidence.episodes if episode.number in readings}
    for group in _groups(tasks):
        for name in _QUANTITIES:
            known = {number: readings[number][name] for number in group if name in readings[number]}
            for number, reason in _judged(name, known) if len(known) > MIN_OTHERS else ():
                reasons[number].append(reason)
    return {
        number: EpisodeScore(
            episode=number,
            score=math.prod(reason.factor for reason in own),
            reasons=tuple(sorted((r for r in own if r.factor < 1 - _MIN_LOSS), key=lambda reason: reason.factor)),
        )
        for number, own in sorted(reasons.items())
    }


def _groups(tasks: Mapping[int, str]) -> Iterable[list[int]]:
    """Return the numbers of the episodes that are compared with each other."""
    counts = Counter(tasks.values())
    found: dict[str, list[int]] = {}
    for number, task in tasks.items():
        found.setdefault(task if counts[task] >= MIN_EPISODES else "", []).append(number)
    return found.values()


def _judged(name: str, readings: Mapping[int, QuantityReading]) -> Iterator[tuple[int, Reason]]:
    """Yield (number, reason) of each reading."""
    floor, words = _QUANTITIES[name]
    values = np.array([(reading.value, *reading.others) for reading in readings.values()])
    centres = np.median(values, axis=0)
    usual_spreads = np.maximum(NORMAL * np.median(np.abs(values - centres), axis=0), floor)
    distances = (values - centres) / usual_spreads
    distances = np.abs(distances) if name in _TWO_SIDED else np.maximum(distances, 0.0)
    usual = float(centres[0])
    for (number, reading), spreads in zip(readings.items(), distances.min(axis=1).tolist(), strict=True):
        value, first, last, _ = reading
        text = words.format(value=value, usual=usual, ratio=math.exp(min(value - usual, 50.0)))
        yield number, Reason(name, math.exp(-((spreads / _HALF) ** _STEEPNESS)), spreads, text, first, last)


def measure(evidence: Evidence) -> dict[int, dict[str, QuantityReading]]:
    """Compute episode number -> quantity -> its number; empty without a state.

    Episodes that are too short, or in another unit, are left out: they would change what is usual.
    """
    columns = [column for column in evidence.action_of if column is not None]
    has_action = len(columns) == len(evidence.elements) > 0
    motions: dict[int, ArmMotion] = {}
    for episode, state in evidence.with_state(_MIN_FRAMES):
        if episode.number in evidence.once(other_units):
            continue
        acted = state if episode.action is None or not has_action else episode.action[:, columns]
        motions[episode.number] = ArmMotion(state, acted)
    known = list(motions.values())
    ranges = ArmMotion(_range([motion.state for motion in known]), _range([motion.action for motion in known]))
    arm = ~evidence.is_gripper & evidence.once(moving_elements) if known else ~evidence.is_gripper
    found = {n: _readings(motion, ranges, arm, evidence.is_gripper, evidence.fps) for n, motion in motions.items()}
    for number, lag in _lags(evidence).items():
        if number in found:
            found[number]["lag"] = QuantityReading(lag, 0, len(motions[number].state) - 1)
    return found


def _lags(evidence: Evidence) -> dict[int, float]:
    """Find episode number -> frames by which the state follows the action; empty if it does not."""
    try:
        return {number: episode.lag for number, episode in evidence.once(relation_of).episodes.items()}
    except NotMeasuredError:
        return {}


def _range(values: Sequence[Array]) -> Array:
    """Return the minimum and maximum value (2, D) of all episodes, excluding the outermost tenth of them."""
    if not values:
        return np.zeros((2, 0))
    low = np.quantile([part.min(axis=0) for part in values], 0.1, axis=0, method="higher")
    high = np.quantile([part.max(axis=0) for part in values], 0.9, axis=0, method="lower")
    return np.stack([low, high])


def _shares(values: Array, ranges: Array) -> Array:
    """Return values (T, K) in units of their ranges (2, K); an element that hardly moves has less weight."""
    width = ranges[1] - ranges[0]
    floor = max(0.2 * float(np.median(width)), 1e-9) if len(width) else 1.0
    return np.asarray((values - ranges[0]) / np.maximum(width, floor), dtype=np.float64)


def _readings(
    motion: ArmMotion, ranges: ArmMotion, arm: NDArray[np.bool_], is_gripper: NDArray[np.bool_], fps: float
) -> dict[str, QuantityReading]:
    state = _shares(motion.state[:, arm], ranges.state[:, arm])
    action = _shares(motion.action[:, arm], ranges.action[:, arm])
    openings = _shares(motion.state[:, is_gripper], ranges.state[:, is_gripper])
    commands = _shares(motion.action[:, is_gripper], ranges.action[:, is_gripper])
    switches = [sorted({frame for command in commands.T for frame in _switches(command, *pair)}) for pair in _LEVELS]
    counts = [len(frames) for frames in switches]
    last = len(state) - 1
    bounds = [(0, *(frame for frame in frames if frame < last), last) for frames in switches]
    by_bounds = {each: _detour(state, each) for each in dict.fromkeys(bounds)}  # the levels usually agree
    detours = [by_bounds[each] for each in bounds]
    return {
        "pause": _pause(state, openings, fps),
        "duration": QuantityReading(float(np.log(len(state) / fps)), 0, last),
        "switches": QuantityReading(counts[0], 0, last, tuple(counts[1:])),
        "path": detours[0]._replace(others=tuple(detour.value for detour in detours[1:])),
        "noise": _roughness(action),
    }


def _pause(state: Array, openings: Array, fps: float) -> QuantityReading:
    """Return the longest time for which arm (T, K) and grippers (T, G) rest between motions."""
    steps = np.linalg.norm(np.diff(state, axis=0), axis=1)
    is_still = steps < _STILL_RATIO * max(float(np.quantile(steps, 0.9)), 1e-9)
    is_still &= (np.abs(np.diff(openings, axis=0)) < _STEADY).all(axis=1)
    moving = np.flatnonzero(~is_still)
    if len(moving) < 2:
        return QuantityReading(0.0, 0, len(state) - 1)
    gaps = np.diff(moving) - 1
    longest = int(np.argmax(gaps))
    return QuantityReading(float(gaps[longest]) / fps, int(moving[longest]) + 1, int(moving[longest + 1]))


def _detour(state: Array, bounds: Sequence[int]) -> QuantityReading:
    """Return the excess of the path over straight lines between the bounds, and the segment with most of it."""
    excess = []
    for first, last in pairwise(bounds):
        path = float(np.linalg.norm(np.diff(state[first : last + 1], axis=0), axis=1).sum())
        excess.append(path - float(np.linalg.norm(state[last] - state[first])))
    worst = int(np.argmax(excess))
    return QuantityReading(sum(excess), bounds[worst], bounds[worst + 1])


def _roughness(values: Array) -> QuantityReading:
    """Return the logarithm of the third differences: small for smooth motion, maximal for white noise."""
    third = np.linalg.norm(np.diff(values, 3, axis=0), axis=1)
    return QuantityReading(float(np.log(np.quantile(third, 0.75) + 1e-4)), 0, len(values) - 1)


def _switches(command: Array, low: float, high: float) -> list[int]:
    """Return the frames from which a gripper's command (T,) is at the other of two levels, low and high."""
    level = np.where(command > high, 1, np.where(command < low, 0, -1))
    if level[0] < 0:
        level[0] = int(command[0] > (low + high) / 2)
    latest = np.maximum.accumulate(np.where(level >= 0, np.arange(len(level)), 0))  # between the levels it stays
    return [int(frame) + 1 for frame in np.flatnonzero(np.diff(level[latest]))]
