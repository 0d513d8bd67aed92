"""A number from 0 to 1 for each episode of a dataset, with its reasons, and the file that keeps these.

Each quantity of an episode is compared with those of the others of its task; how far it is off, in units of the usual
spread, takes its part off the score. Nothing is taken off for what most do. The spread counts as at least the one of
`_LAWS`, below which differences do not matter; see docs/datasets.md for where these numbers come from.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np

from demorec.check.rows import longest_run
from demorec.check.scoring import neighbours
from demorec.check.scoring.measured import Measured, Reason, dataset_scale, measure
from demorec.check.scoring.movement import Movement, Reading
from demorec.check.scoring.sight import Sight
from demorec.core.errors import ConfigError, describe_error
from demorec.core.files import MAX_JSON_BYTES, read_json_limited
from demorec.core.geometry import Array
from demorec.core.processes import in_turn
from demorec.core.replacing import ReplaceableKind, check_replaceable, written_whole

SOUND = 0.8
"""Score from which a demonstration is sound: of the sound ones of `benchmarks/curation.py` 92 in 100 or more."""
_HALF, _STEEPNESS = 7.0, 4
"""Usual spreads at which about two thirds are taken off, and how sudden that is."""
_SHOWN = 0.05
"""What is taken off at least for a reason to be given."""
_CHUNK = 8
"""Episodes that a process measures at once."""
_TWIN = 0.9
"""Share of the rows that two episodes have in common, so that one is a copy of the other."""
_FROZEN, _FROZEN_LEVELS = 0.1, 0.5
"""Share of the usual change of the image, and mean levels, below which it stands still while the arm moves."""
_SAME_PART, _SAME_LEVELS = 3.0, 0.05
"""Levels, of the part that changes most or in the mean, below which half of the steps of a still image are. An image
that is encoded again changes in no part by more than 2 (x264 and AV1 at 224x224 and 640x480); the view of a hand that
carries a cube over an empty table does."""


_LAWS: Mapping[str, tuple[Literal["more", "less", "both"], float, str]] = {
    "pause": ("more", 0.1, "stands still for {value:.1f} s amid the motion, usual are {usual:.1f} s"),  # 0.5, 1.0
    "idle": ("more", 0.2, "stands still for {value:.1f} s in all, usual are {usual:.1f} s"),  # 1.0, 2.0
    "duration": ("both", 0.1, "takes {ratio:.2f} times as long as usual"),  # 0.9, 1.2
    "time": ("more", 0.12, "takes {value:.1f} s longer than others between such places"),  # 1.1, 2.2
    "strokes": ("more", 0.4, "moves in {value:.0f} strokes, usual are {usual:.0f}"),  # 0.0, 0.7
    "path": ("more", 0.1, "goes {value:.0%} of the range farther than others between such places"),  # 4.2, 12.3
    "course": ("more", 0.08, "strays by {value:.0%} of the range from the way of others"),  # 2.4, 8.0
    "end": ("more", 0.03, "ends {value:.0%} of the range from where others end, usual are {usual:.0%}"),  # 2.0, 3.8
    "end speed": ("more", 0.1, "ends at {value:.0%} of its fast speed, usual are {usual:.0%}"),  # 1.9, 3.2
    "state noise": ("more", 0.2, "the state shakes {ratio:.1f} times as much as usual"),  # 0.8, 1.3
    "jump": ("more", 0.2, "the state jumps, {ratio:.1f} times as far as usual"),  # 1.4, 2.2
    "action noise": ("more", 0.2, "the action shakes {ratio:.1f} times as much as usual"),  # 1.6, 2.7
    "lag": ("both", 0.2, "the state follows the action by {value:+.1f} frames, usual are {usual:+.1f}"),  # 0.8, 1.4
    "limit": ("more", 0.03, "the action is at the end of its range in {value:.0%} of the frames"),  # 2.1, 3.4
    "switches": ("both", 0.12, "the gripper is switched {value:.0f} times, usual are {usual:.0f}"),  # 0.0, 0.0
    "slip": ("more", 0.02, "the gripper closes by {value:.0%} of its range without being told to"),  # 0.1, 0.1
    "grip": ("less", 0.05, "the gripper closes on nothing"),  # 1.8, 2.2
    "held": ("more", 0.04, "the hand does not hold what others hold, as {camera} shows it"),  # 0.0, 0.0
    "frozen": ("more", 0.12, "{camera} shows the same for {value:.1f} s while the arm moves"),  # 0.0, 4.2
    "brightness": ("both", 6.0, "{camera} has a brightness of {value:.0f}, usual are {usual:.0f}"),  # 1.4, 3.6
    "sharpness": ("less", 0.1, "{camera} is {ratio:.2f} times as sharp as usual"),  # 0.8, 1.9
    "blank": ("more", 0.01, "{camera} shows nothing in {value:.0%} of the images"),  # 0.0, 0.0
}  # fmt: skip
"""Quantity -> what of it is odd (more than usual, less, or both), the least unit in which that is measured, and the
reason, with {value}, {usual} and, of logarithms, their {ratio}. Behind each: how far off, in spreads, 95 in 100 of the
sound episodes are at most, and the farthest one, by `benchmarks/curation.py --only pick_place/panda/1
pick_shapes/panda/1 --episodes 50`, which set the spreads (72 sound episodes, in both formats); of "held": 280 sound
ones of ten tasks."""


@dataclass(frozen=True, kw_only=True)
class EpisodeScore:
    """Of one episode; reasons begin with the heaviest."""

    episode_index: int
    num_frames: int
    score: float
    reasons: tuple[Reason, ...]


def score_dataset(
    root: Path,
    *,
    images: bool = True,
    workers: int = 1,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[EpisodeScore]:
    """Score all episodes of a LeRobot dataset, in order.

    Args:
        root: Its folder.
        images: Whether to look at images; a few of each episode are decoded.
        workers: Processes.
        progress: Called with the episodes that are measured, and all.

    Raises:
        ExportError: It cannot be read.
    """
    from demorec.datasets.lerobot.episodes import LeRobotDataset

    count = len(LeRobotDataset(root))
    chunks = [range(begin, min(begin + _CHUNK, count)) for begin in range(0, count, _CHUNK)]
    found: list[Measured] = []
    for part in in_turn(partial(measure, root, dataset_scale(root), images), chunks, workers, ahead=2):
        found += part
        progress(len(found), count)
    return scores(found)


def scores(episodes: Sequence[Measured]) -> list[EpisodeScore]:
    """The scores of measured episodes."""
    everything = dict(enumerate(episodes))
    reasons = [list(episode.flaws) for episode in episodes]
    for numbers in neighbours.groups([episode.task for episode in episodes]):
        group = {number: episodes[number] for number in numbers}
        for name, camera, readings in _quantities(group):
            for number, reason in _judged(name, readings, camera):
                reasons[number].append(reason)
        for number, reason in _ends(group):
            reasons[number].append(reason)
    for number, reason in (*_otherwise(everything), *_other_things(everything), *_twins(everything)):
        reasons[number].append(reason)
    return [
        EpisodeScore(
            episode_index=episode.episode_index,
            num_frames=episode.length,
            score=math.prod(reason.factor for reason in own),
            reasons=tuple(sorted((r for r in own if r.factor < 1 - _SHOWN), key=lambda reason: reason.factor)),
        )
        for episode, own in zip(episodes, reasons, strict=True)
    ]


Episodes = Mapping[int, Measured]
"""Number -> episode: all, or those that are compared with each other."""
Readings = Mapping[int, Reading]
"""Of the episodes that have one, by their numbers."""


def _factor(spreads: float) -> float:
    """What is left of the score for something so many usual spreads off."""
    return math.exp(-((max(spreads, 0.0) / _HALF) ** _STEEPNESS))


def _judged(name: str, readings: Readings, camera: str, most: Array | float = math.inf) -> Iterator[tuple[int, Reason]]:
    """(number, reason) of each that is read; none is taken for more than `most` usual spreads off."""
    side, spread, words = _LAWS[name]
    values = np.array([reading.value for reading in readings.values()])
    off = neighbours.deviation(values, spread)
    off = np.minimum({"more": off, "less": -off, "both": np.abs(off)}[side], most)
    usual = float(np.nanmedian(values)) if np.isfinite(values).any() else 0.0
    for (number, (value, first, last)), spreads in zip(readings.items(), off.tolist(), strict=True):
        text = words.format(value=value, usual=usual, ratio=math.exp(min(value - usual, 50.0)), camera=camera)
        yield number, Reason(kind=name, factor=_factor(spreads), text=text, first=first, last=last)


def _quantities(group: Episodes) -> Iterator[tuple[str, str, Readings]]:
    """(quantity, camera or "", its readings) of a group."""
    moved = {number: each.movement for number, each in group.items() if each.movement is not None}
    for name in _LAWS:
        if found := {number: each.readings[name] for number, each in moved.items() if name in each.readings}:
            yield name, "", found
    for count in dict.fromkeys(len(each.courses) for each in moved.values()):
        alike = {number: each for number, each in moved.items() if len(each.courses) == count}
        if len(alike) >= neighbours.FEWEST:
            yield from _courses(alike)
    for camera in dict.fromkeys(camera for episode in group.values() for camera in episode.sights):
        seen = {number: episode.sights[camera] for number, episode in group.items() if camera in episode.sights}
        for name in ("brightness", "sharpness", "blank"):
            whole = {n: Reading(each.quantities[name], 0, group[n].length - 1) for n, each in seen.items()}
            yield name, camera, whole
        yield "frozen", camera, _frozen({n: (each, moved[n]) for n, each in seen.items() if n in moved})


def _ends(group: Episodes) -> Iterator[tuple[int, Reason]]:
    """Of episodes that end both elsewhere than others and elsewhere as seen from the gripper's last switch.

    A hand that let go turned another way, or in another place, ends elsewhere; where it let go it ends as usual.
    """
    known = {number: each.movement.ends for number, each in group.items() if each.movement is not None}
    if len(known) < neighbours.FEWEST:
        return
    last = np.array([ends[-2:] for ends in known.values()])
    away = dict(zip(known, neighbours.nearest_distance(last[:, 1]).tolist(), strict=True))
    readings = {n: Reading(value, group[n].length - 1, group[n].length - 1) for n, value in away.items()}
    ways = neighbours.nearest_distance(last[:, 1] - last[:, 0])
    yield from _judged("end", readings, "", neighbours.deviation(ways, _LAWS["end"][1]))


def _courses(moved: Mapping[int, Movement]) -> Iterator[tuple[str, str, Readings]]:
    """Of the episodes that have as many stretches between switches of the gripper: the odd stretch of each."""
    ends = np.array([each.ends for each in moved.values()])
    costs = neighbours.cost_residuals(ends, np.array([each.costs for each in moved.values()]))
    for name, residuals in (
        ("course", neighbours.course_residuals(ends, np.array([each.courses for each in moved.values()]))),
        ("time", costs[:, :, 0]),
        ("path", costs[:, :, 1]),
    ):
        worst = dict(zip(moved, residuals.argmax(axis=1).tolist(), strict=True))
        values = dict(zip(moved, residuals.max(axis=1).tolist(), strict=True))
        yield name, "", {n: Reading(values[n], *moved[n].bounds[worst[n] : worst[n] + 2]) for n in moved}


def _frozen(known: Mapping[int, tuple[Sight, Movement]]) -> Readings:
    """For how many seconds an image stands still though the arm moves as fast as it changes images elsewhere."""
    if not known:
        return {}
    # How far the arm goes from one of the frames to the next.
    ways = {n: np.diff(np.concatenate([[0.0], np.cumsum(m.steps)])[seen.frames]) for n, (seen, m) in known.items()}
    changes, moved = (np.concatenate(part) for part in ([s.changes for s, _ in known.values()], list(ways.values())))
    fast = moved > np.median(moved)
    rate = float(np.median(changes[fast] / moved[fast])) if fast.any() else 0.0
    least = 0.3 * float(np.median(moved))
    found = {}
    for number, (seen, movement) in known.items():
        way = ways[number]
        length, start = longest_run((way > least) & (seen.changes < np.minimum(_FROZEN * rate * way, _FROZEN_LEVELS)))
        run = slice(start, start + length)
        if length and np.median(seen.most_changes[run]) >= _SAME_PART and np.median(seen.changes[run]) >= _SAME_LEVELS:
            length = 0
        first, last = int(seen.frames[start]), int(seen.frames[start + length])
        found[number] = Reading((last - first) / movement.fps, first, last)
    return found


def _otherwise(episodes: Episodes) -> Iterator[tuple[int, Reason]]:
    """Episodes that show what another instruction of the dataset asks for."""
    cameras = sorted({camera for episode in episodes.values() for camera in episode.sights})
    seen = {n: episode for n, episode in episodes.items() if cameras and sorted(episode.sights) == cameras}
    if len(seen) < neighbours.FEWEST:
        return
    looks = np.array([np.concatenate([each.sights[camera].look for camera in cameras]) for each in seen.values()])
    off, words = neighbours.contradicted_words([each.task for each in seen.values()], looks)
    for (number, each), spreads, word in zip(seen.items(), off.tolist(), words, strict=True):
        text = f"its images contradict the instruction as to {word!r}"
        factor = _factor(spreads)
        yield number, Reason(kind="instruction", factor=factor, text=text, first=0, last=each.length - 1)


def _other_things(episodes: Episodes) -> Iterator[tuple[int, Reason]]:
    """Episodes whose hand lacks the colours of what others hold."""
    grips = {number: each.movement.grips for number, each in episodes.items() if each.movement is not None}
    for camera in dict.fromkeys(camera for episode in episodes.values() for camera in episode.sights):
        seen = {n: episode for n, episode in episodes.items() if camera in episode.sights and grips.get(n)}
        if len(seen) < neighbours.FEWEST:
            continue
        held = np.stack([each.sights[camera].held for each in seen.values()])
        lack = dict(zip(seen, neighbours.lacking(held, [each.task for each in seen.values()]).tolist(), strict=True))
        known = {n: value for n, value in lack.items() if not math.isnan(value)}
        readings = {n: Reading(value, grips[n][0][0], grips[n][-1][1]) for n, value in known.items()}
        yield from _judged("held", readings, camera)


def _twins(episodes: Episodes) -> Iterator[tuple[int, Reason]]:
    """Episodes most of whose rows are those of an earlier one."""
    holders: dict[int, list[int]] = {}
    for number, episode in episodes.items():
        common = Counter(other for value in episode.sketch.tolist() for other in holders.get(value, ()))
        for value in episode.sketch.tolist():
            holders.setdefault(value, []).append(number)
        twin, count = max(common.items(), key=lambda item: item[1], default=(-1, 0))
        if count and count >= _TWIN * len(episode.sketch):
            text = f"is a copy of episode {episodes[twin].episode_index}"
            yield number, Reason(kind="copy", factor=0.0, text=text, first=0, last=episode.length - 1)


_KIND = "scores of demorec"


def _is_scores(path: Path) -> bool:
    try:
        found = read_json_limited(path, MAX_JSON_BYTES)
    except (OSError, ValueError):
        return False
    return isinstance(found, dict) and found.get("kind") == _KIND


SCORES = ReplaceableKind(name="a file of scores (JSON)", recognises=_is_scores)


def to_json(found: Sequence[EpisodeScore]) -> dict[str, Any]:
    """What `--json` prints and the file holds."""
    return {"kind": _KIND, "episodes": [asdict(episode) for episode in found]}


def check_target(path: Path, *, source: Path, overwrite: bool) -> None:
    """Raise ConfigError where scores cannot be kept: something else is there, or something and no `overwrite`."""
    check_replaceable(path, SCORES, overwrite=overwrite, sources=[source])
    if not path.absolute().parent.is_dir():
        raise ConfigError(f"--out: there is no folder {path.parent}.")


def write_scores(path: Path, found: Sequence[EpisodeScore]) -> None:
    """Keep scores in a file that `check_target` allows."""
    with written_whole(path, SCORES) as part:
        part.write_text(json.dumps(to_json(found), indent=1) + "\n")


def read_scores(path: Path, num_frames: Mapping[int, int]) -> dict[int, float]:
    """episode_index -> score; ConfigError for a file that cannot be read, or is of a dataset with other episodes.

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
