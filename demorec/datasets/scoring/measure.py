"""Quantities of each episode of a LeRobot dataset: how the arm and the grippers move.

Elements of state and action count in units of their range in the dataset, so that radians, degrees and per cent are
alike.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from demorec.core.errors import ExportError
from demorec.core.geometry import Array
from demorec.datasets.lerobot.episode_table import EpisodePlace
from demorec.datasets.lerobot.folder import LeRobotFolder

_MIN_FRAMES = 8
_HIGH = 0.65
"""Share of its range above which a gripper's command counts as high."""
_LOW = 0.35
"""Share of its range below which a gripper's command counts as low again."""
_STILL_RATIO = 0.08
"""Share of the episode's fast speed (its 90 % quantile) below which an arm stands still."""
_STEADY = 0.02
"""Share of its range by which a gripper that stands still may move."""
_MAX_LAG_S = 0.5


class QuantityReading(NamedTuple):
    """A number, and the first and last frame that it comes from."""

    value: float
    first: int
    last: int


class ArmMotion(NamedTuple):
    """State and action (T, D) of the same elements; without an action the state stands for it."""

    state: NDArray[Any]
    action: NDArray[Any]


class MeasuredEpisode(NamedTuple):
    """One episode: its place, why it cannot be measured ("" if it can), and quantity -> its number."""

    place: EpisodePlace
    flaw: str
    readings: Mapping[str, QuantityReading]


def measure_dataset(dataset: LeRobotFolder) -> list[MeasuredEpisode]:
    """Measure all episodes of a dataset, in order.

    Raises:
        ConfigError: A named feature is missing.
        ExportError: It has no state, or its tables cannot be read.
    """
    roles = dataset.roles
    if not roles.state:
        raise ExportError(f"No state was found to score episodes by, name it by --state FEATURE: {dataset.root}")
    columns = [place for place in roles.in_state(roles.action) if place is not None] if roles.action else []
    has_action = len(columns) == len(roles.elements(roles.state))
    is_gripper = roles.grippers()
    stream = dataset.rows(list(dict.fromkeys((*roles.state, *roles.action))))
    flaws: list[str] = []
    motions: list[ArmMotion | None] = []
    for place in dataset.places:
        rows = stream.numbers(place)
        flaws.append(_flaw(rows, place.length))
        if flaws[-1]:
            motions.append(None)
            continue
        state = _joined(roles.state, rows)
        motions.append(ArmMotion(state, _joined(roles.action, rows)[:, columns] if has_action else state))
    known = [motion for motion in motions if motion is not None]
    ranges = ArmMotion(_range([motion.state for motion in known]), _range([motion.action for motion in known]))
    fps = float(dataset.info.fps)
    readings = [{} if motion is None else _readings(motion, ranges, is_gripper, fps) for motion in motions]
    return [MeasuredEpisode(*parts) for parts in zip(dataset.places, flaws, readings, strict=True)]


def _joined(parts: Sequence[str], rows: Mapping[str, NDArray[Any]]) -> NDArray[np.float32]:
    """(T, D) of features one behind the other."""
    return np.hstack([rows[part] for part in parts]).astype(np.float32)


def _flaw(rows: Mapping[str, NDArray[Any]], length: int) -> str:
    if length < _MIN_FRAMES:
        return f"has {length} frames"
    for name, values in rows.items():
        is_whole = np.isfinite(values).all(axis=1)
        if not is_whole.all():
            return f"lacks numbers of {name}, first in frame {int(np.argmin(is_whole))}"
    return ""


def _range(values: Sequence[NDArray[Any]]) -> Array:
    """Return the least and the largest value (2, D) of all episodes without the outermost tenth of them."""
    if not values:
        return np.zeros((2, 0))
    low = np.quantile([part.min(axis=0) for part in values], 0.1, axis=0)
    high = np.quantile([part.max(axis=0) for part in values], 0.9, axis=0)
    return np.stack([low, high])


def _shares(values: NDArray[Any], ranges: Array) -> Array:
    """Return values (T, K) in units of their ranges (2, K); an element that hardly moves counts less than others."""
    width = ranges[1] - ranges[0]
    floor = max(0.2 * float(np.median(width)), 1e-9) if len(width) else 1.0
    return np.asarray((values - ranges[0]) / np.maximum(width, floor), dtype=np.float64)


def _readings(
    motion: ArmMotion, ranges: ArmMotion, is_gripper: NDArray[np.bool_], fps: float
) -> dict[str, QuantityReading]:
    state = _shares(motion.state[:, ~is_gripper], ranges.state[:, ~is_gripper])
    action = _shares(motion.action[:, ~is_gripper], ranges.action[:, ~is_gripper])
    openings = _shares(motion.state[:, is_gripper], ranges.state[:, is_gripper])
    commands = _shares(motion.action[:, is_gripper], ranges.action[:, is_gripper])
    switches = sorted({frame for command in commands.T for frame in _switches(command)})
    last = len(state) - 1
    readings = {
        "pause": _pause(state, openings, fps),
        "duration": QuantityReading(float(np.log(len(state) / fps)), 0, last),
        "switches": QuantityReading(len(switches), 0, last),
        "path": _detour(state, [0, *(frame for frame in switches if frame < last), last]),
        "noise": _roughness(action),
    }
    lag = None if motion.action is motion.state else _lag(state, action, fps)
    return readings if lag is None else readings | {"lag": QuantityReading(lag, 0, last)}


def _pause(state: Array, openings: Array, fps: float) -> QuantityReading:
    """Return the longest time for which arm (T, K) and grippers (T, G) stand still amid the motion."""
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
    """Return how much longer the path is than straight lines between the bounds, and the stretch with most of it."""
    excess = []
    for first, last in pairwise(bounds):
        path = float(np.linalg.norm(np.diff(state[first : last + 1], axis=0), axis=1).sum())
        excess.append(path - float(np.linalg.norm(state[last] - state[first])))
    worst = int(np.argmax(excess))
    return QuantityReading(sum(excess), bounds[worst], bounds[worst + 1])


def _roughness(values: Array) -> QuantityReading:
    """Return the logarithm of the third differences: smooth motion has hardly any, white noise has most."""
    third = np.linalg.norm(np.diff(values, 3, axis=0), axis=1)
    return QuantityReading(float(np.log(np.quantile(third, 0.75) + 1e-4)), 0, len(values) - 1)


def _lag(state: Array, action: Array, fps: float) -> float | None:
    """Return by how many frames the state follows the action, a target or an increment; None if it does not."""
    reach = max(2, round(_MAX_LAG_S * fps))
    if len(state) < 4 * reach:
        return None
    lags = range(-reach, reach + 1)
    for values in (state, np.diff(state, axis=0, prepend=state[:1]) * fps):
        core = values[reach:-reach]
        errors = [float((core - action[reach - lag : len(action) - reach - lag]).var(axis=0).sum()) for lag in lags]
        if min(errors) < 0.5 * float(core.var(axis=0).sum()):
            return float(lags[int(np.argmin(errors))])
    return None


def _switches(command: Array) -> list[int]:
    """Return the frames from which a gripper's command (T,) is at the other of two levels, low and high."""
    level = np.where(command > _HIGH, 1, np.where(command < _LOW, 0, -1))
    if level[0] < 0:
        level[0] = int(command[0] > 0.5)
    latest = np.maximum.accumulate(np.where(level >= 0, np.arange(len(level)), 0))  # between the levels it stays
    return [int(frame) + 1 for frame in np.flatnonzero(np.diff(level[latest]))]
