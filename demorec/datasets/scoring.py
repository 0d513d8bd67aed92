"""Score each episode of a dataset by how far its quantities are from those of the other episodes of its instruction.

The distance counts in usual spreads: a robust standard deviation over these episodes, at least the least spread of
`_QUANTITIES`, below which differences do not matter. What most episodes do takes nothing off.

Elements of state and action count in units of their range in the dataset, so that radians, degrees and per cent are
alike.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from demorec.core.errors import ConfigError, ExportError, describe_error
from demorec.core.files import MAX_JSON_BYTES, read_json_limited
from demorec.core.geometry import Array
from demorec.core.replacing import ReplaceableKind
from demorec.datasets.lerobot.episode_table import EpisodePlace
from demorec.datasets.lerobot.folder import LeRobotFolder

MIN_SOUND = 0.8
"""Score from which a demonstration is sound."""
MIN_EPISODES = 12
"""Episodes of one instruction that are compared among themselves; fewer are compared with all of the dataset."""
_HALF = 7.0
"""Usual spreads at which about two thirds are taken off."""
_STEEPNESS = 4
_MIN_LOSS = 0.05
"""Loss of score from which a reason is given."""
_KIND = "scores of demorec"
"""Kind of the file that keeps the scores."""
_NORMAL = 1.4826
"""Standard deviation of a normal distribution in units of its median absolute deviation."""

_QUANTITIES: Mapping[str, tuple[float, str]] = {
    "pause": (0.1, "stands still for {value:.1f} s amid the motion, usual are {usual:.1f} s"),
    "path": (0.1, "goes a detour of {value:.0%} of the range, usual are {usual:.0%}"),
    "noise": (0.2, "the action shakes {ratio:.1f} times as much as usual"),
    "duration": (0.1, "takes {ratio:.2f} times as long as usual"),
    "lag": (0.3, "the state follows the action by {value:+.0f} frames, usual are {usual:+.0f}"),
    "switches": (0.12, "the gripper is switched {value:.0f} times, usual are {usual:.0f}"),
}
"""Quantity -> its least spread, and the reason in words; {ratio} is that of logarithms."""
_TWO_SIDED = ("duration", "lag", "switches")
"""Quantities of which less than usual is odd as well."""

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


class Reason(NamedTuple):
    """One loss of score: the factor that is left, in words, the first and the last frame."""

    kind: str
    factor: float
    text: str
    first: int
    last: int


@dataclass(frozen=True, kw_only=True)
class EpisodeScore:
    """Score of one episode; reasons begin with the heaviest."""

    episode_index: int
    num_frames: int
    score: float
    reasons: tuple[Reason, ...]


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


def score_dataset(folder: LeRobotFolder) -> list[EpisodeScore]:
    """Score all episodes of a LeRobot dataset, in order; errors as `measure_dataset`."""
    episodes = measure_dataset(folder)
    reasons: list[list[Reason]] = [
        [Reason("flaw", 0.0, each.flaw, 0, each.place.length - 1)] if each.flaw else [] for each in episodes
    ]
    for group in _groups(["; ".join(episode.place.tasks) for episode in episodes]):
        for name in _QUANTITIES:
            known = {number: episodes[number].readings[name] for number in group if name in episodes[number].readings}
            for number, reason in _judged(name, known) if known else ():
                reasons[number].append(reason)
    return [
        EpisodeScore(
            episode_index=episode.place.episode_index,
            num_frames=episode.place.length,
            score=math.prod(reason.factor for reason in own),
            reasons=tuple(sorted((r for r in own if r.factor < 1 - _MIN_LOSS), key=lambda reason: reason.factor)),
        )
        for episode, own in zip(episodes, reasons, strict=True)
    ]


def _groups(tasks: Sequence[str]) -> Iterable[list[int]]:
    """Return the numbers of the episodes that are compared with each other."""
    counts = Counter(tasks)
    found: dict[str, list[int]] = {}
    for number, task in enumerate(tasks):
        found.setdefault(task if counts[task] >= MIN_EPISODES else "", []).append(number)
    return found.values()


def _judged(name: str, readings: Mapping[int, QuantityReading]) -> Iterator[tuple[int, Reason]]:
    """Yield (number, reason) of each reading."""
    floor, words = _QUANTITIES[name]
    values = np.array([reading.value for reading in readings.values()])
    usual = float(np.median(values))
    spread = max(_NORMAL * float(np.median(np.abs(values - usual))), floor)
    for number, (value, first, last) in readings.items():
        off = (value - usual) / spread
        spreads = abs(off) if name in _TWO_SIDED else max(off, 0.0)
        text = words.format(value=value, usual=usual, ratio=math.exp(min(value - usual, 50.0)))
        yield number, Reason(name, math.exp(-((spreads / _HALF) ** _STEEPNESS)), text, first, last)


def _is_scores(path: Path) -> bool:
    try:
        found = read_json_limited(path, MAX_JSON_BYTES)
    except (OSError, ValueError):
        return False
    return isinstance(found, dict) and found.get("kind") == _KIND


SCORES = ReplaceableKind(name="a file of scores (JSON)", recognises=_is_scores)


def to_json(scores: Sequence[EpisodeScore]) -> dict[str, Any]:
    """Return what `--json` prints and the file holds."""
    episodes = [asdict(episode) | {"reasons": [reason._asdict() for reason in episode.reasons]} for episode in scores]
    return {"kind": _KIND, "episodes": episodes}


def write_scores(path: Path, scores: Sequence[EpisodeScore]) -> None:
    """Write a file of scores. Raises OSError if it cannot be written."""
    path.write_text(json.dumps(to_json(scores), indent=1) + "\n")


def read_scores(path: Path, num_frames: Mapping[int, int]) -> dict[int, float]:
    """Return episode_index -> score. Raises ConfigError if the file cannot be read or is of other episodes.

    Args:
        path: The file.
        num_frames: episode_index -> frames of the dataset's episodes.
    """
    try:
        rows = read_json_limited(path, MAX_JSON_BYTES)["episodes"]
        found = {int(row["episode_index"]): (int(row["num_frames"]), float(row["score"])) for row in rows}
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise ConfigError(
            f"This is no file of demorec dataset score --out ({describe_error(error)}): {path}"
        ) from error
    if {index: frames for index, (frames, _) in found.items()} != dict(num_frames):
        raise ConfigError(f"The scores are those of a dataset with other episodes; score this one anew: {path}")
    return {index: score for index, (_, score) in found.items()}


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
