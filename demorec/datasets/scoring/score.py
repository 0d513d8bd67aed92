"""Score each episode of a dataset by how far its quantities are from those of the other episodes of its instruction.

The distance counts in usual spreads: a robust standard deviation over these episodes, at least the least spread of
`_QUANTITIES`, below which differences do not matter. What most episodes do takes nothing off.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from demorec.core.errors import ConfigError, describe_error
from demorec.core.files import MAX_JSON_BYTES, read_json_limited
from demorec.core.replacing import ReplaceableKind
from demorec.datasets.lerobot.folder import LeRobotFolder
from demorec.datasets.scoring.measure import QuantityReading, measure_dataset

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
