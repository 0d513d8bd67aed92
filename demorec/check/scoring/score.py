"""A number from 0 to 1 for each episode of a dataset, with its reasons.

Each quantity of an episode is compared with those of the others of its task; how far it is off, in units of the usual
spread, takes its part off the score. Nothing is taken off for what most do. The spread counts as at least the one of
`_LAWS`, below which differences do not matter; see docs/datasets.md for where these numbers come from.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from demorec.check.rows import longest_run
from demorec.check.scoring import neighbours
from demorec.check.scoring.held import lacking
from demorec.check.scoring.measured import Measured, measure, scale_of
from demorec.check.scoring.movement import Reading
from demorec.check.scoring.sight import Sight
from demorec.core.geometry import Array
from demorec.core.processes import in_turn

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


@dataclass(frozen=True)
class Law:
    """What of a quantity is bad.

    Attributes:
        side: What is odd: more than usual, less, or both.
        spread: Least unit in which that is measured.
        text: The reason, with {value}, {usual} and, of logarithms, their {ratio}.
    """

    side: Literal["more", "less", "both"]
    spread: float
    text: str


_LAWS: Mapping[str, Law] = {
    "pause": Law("more", 0.1, "stands still for {value:.1f} s amid the motion, usual are {usual:.1f} s"),  # 0.5, 1.0
    "idle": Law("more", 0.2, "stands still for {value:.1f} s in all, usual are {usual:.1f} s"),  # 1.0, 2.0
    "duration": Law("both", 0.1, "takes {ratio:.2f} times as long as usual"),  # 0.9, 1.2
    "time": Law("more", 0.12, "takes {value:.1f} s longer than others between such places"),  # 1.1, 2.2
    "strokes": Law("more", 0.4, "moves in {value:.0f} strokes, usual are {usual:.0f}"),  # 0.0, 0.7
    "path": Law("more", 0.1, "goes {value:.0%} of the range farther than others between such places"),  # 4.2, 12.3
    "course": Law("more", 0.08, "strays by {value:.0%} of the range from the way of others"),  # 2.4, 8.0
    "end": Law("more", 0.03, "ends {value:.0%} of the range from where others end, usual are {usual:.0%}"),  # 2.0, 3.8
    "end speed": Law("more", 0.1, "ends at {value:.0%} of its fast speed, usual are {usual:.0%}"),  # 1.9, 3.2
    "state noise": Law("more", 0.2, "the state shakes {ratio:.1f} times as much as usual"),  # 0.8, 1.3
    "jump": Law("more", 0.2, "the state jumps, {ratio:.1f} times as far as usual"),  # 1.4, 2.2
    "action noise": Law("more", 0.2, "the action shakes {ratio:.1f} times as much as usual"),  # 1.6, 2.7
    "lag": Law("both", 0.2, "the state follows the action by {value:+.1f} frames, usual are {usual:+.1f}"),  # 0.8, 1.4
    "limit": Law("more", 0.03, "the action is at the end of its range in {value:.0%} of the frames"),  # 2.1, 3.4
    "switches": Law("both", 0.12, "the gripper is switched {value:.0f} times, usual are {usual:.0f}"),  # 0.0, 0.0
    "slip": Law("more", 0.02, "the gripper closes by {value:.0%} of its range without being told to"),  # 0.1, 0.1
    "grip": Law("less", 0.05, "the gripper closes on nothing"),  # 1.8, 2.2
    "held": Law("more", 0.04, "the hand does not hold what others hold, as {camera} shows it"),  # 0.0, 0.0
    "frozen": Law("more", 0.12, "{camera} shows the same for {value:.1f} s while the arm moves"),  # 0.0, 4.2
    "brightness": Law("both", 6.0, "{camera} has a brightness of {value:.0f}, usual are {usual:.0f}"),  # 1.4, 3.6
    "sharpness": Law("less", 0.1, "{camera} is {ratio:.2f} times as sharp as usual"),  # 0.8, 1.9
    "blank": Law("more", 0.01, "{camera} shows nothing in {value:.0%} of the images"),  # 0.0, 0.0
}  # fmt: skip
"""Quantity -> what of it is bad. Behind each: how far off, in spreads, 95 in 100 of the sound episodes are at most, and
the farthest one, by `benchmarks/curation.py --only pick_place/panda/1 pick_shapes/panda/1 --episodes 50`, which set the
spreads (72 sound episodes, in both formats); of "held": 280 sound ones of ten tasks."""


@dataclass(frozen=True, kw_only=True)
class Reason:
    """Why something is taken off: the factor that is left, in words, the first and the last frame."""

    kind: str
    factor: float
    text: str
    first: int
    last: int


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
    for part in in_turn(partial(measure, root, scale_of(root), images), chunks, workers, ahead=2):
        found += part
        progress(len(found), count)
    return scores(found)


def scores(episodes: Sequence[Measured]) -> list[EpisodeScore]:
    """The scores of measured episodes."""
    reasons: list[list[Reason]] = [
        [Reason(kind=flaw.kind, factor=0.0, text=flaw.text, first=flaw.first, last=flaw.last) for flaw in episode.flaws]
        for episode in episodes
    ]
    for numbers in neighbours.groups([episode.task for episode in episodes]):
        group = [episodes[number] for number in numbers]
        for name, readings, detail in (*_motions(group), *_images(group)):
            for number, reason in _judged(name, readings, detail):
                reasons[numbers[number]].append(reason)
        for number, reason in _ends(group):
            reasons[numbers[number]].append(reason)
    for number, reason in (*_otherwise(episodes), *_other_things(episodes), *_twins(episodes)):
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


Readings = Sequence[Reading | None]
"""Of each episode of a group; None where it has none."""


def _factor(spreads: float) -> float:
    """What is left of the score for something so many usual spreads off."""
    return math.exp(-((max(spreads, 0.0) / _HALF) ** _STEEPNESS))


def _judged(name: str, readings: Readings, detail: str, most: Array | float = math.inf) -> Iterator[tuple[int, Reason]]:
    """(number, reason) of each that is read; none is taken for more than `most` usual spreads off."""
    law = _LAWS[name]
    values = np.array([math.nan if reading is None else reading.value for reading in readings])
    off = neighbours.deviation(values, law.spread)
    off = np.minimum({"more": off, "less": -off, "both": np.abs(off)}[law.side], most)
    usual = float(np.nanmedian(values)) if np.isfinite(values).any() else 0.0
    for number, (reading, spreads) in enumerate(zip(readings, off.tolist(), strict=True)):
        if reading is not None:
            ratio = math.exp(min(reading.value - usual, 50.0))
            text = law.text.format(value=reading.value, usual=usual, ratio=ratio, camera=detail)
            yield number, Reason(kind=name, factor=_factor(spreads), text=text, first=reading.first, last=reading.last)


def _motions(group: Sequence[Measured]) -> Iterator[tuple[str, Readings, str]]:
    """(quantity, its readings, "") of a group."""
    moved = [episode.movement for episode in group]
    for name in _LAWS:
        readings = [None if each is None else each.readings.get(name) for each in moved]
        if any(readings):
            yield name, readings, ""
    if sum(each is not None for each in moved) < neighbours.FEWEST:
        return
    stretches: dict[int, list[int]] = {}
    for number, each in enumerate(moved):
        if each is not None:
            stretches.setdefault(len(each.courses), []).append(number)
    for numbers in stretches.values():
        if len(numbers) >= neighbours.FEWEST:
            yield from ((name, readings, "") for name, readings in _courses(group, numbers))


def _ends(group: Sequence[Measured]) -> Iterator[tuple[int, Reason]]:
    """Of episodes that end both elsewhere than others and elsewhere as seen from the gripper's last switch.

    A hand that let go turned another way, or in another place, ends elsewhere; where it let go it ends as usual.
    """
    known = [(number, each.movement.ends) for number, each in enumerate(group) if each.movement is not None]
    if len(known) < neighbours.FEWEST:
        return
    last = np.array([ends[-2:] for _, ends in known])
    readings: list[Reading | None] = [None] * len(group)
    most = np.full(len(group), math.inf)
    numbers = [number for number, _ in known]
    for number, value in zip(numbers, neighbours.nearest_distance(last[:, 1]).tolist(), strict=True):
        end = group[number].length - 1
        readings[number] = Reading(value=value, first=end, last=end)
    ways = neighbours.nearest_distance(last[:, 1] - last[:, 0])
    most[numbers] = neighbours.deviation(ways, _LAWS["end"].spread)
    yield from _judged("end", readings, "", most)


def _courses(group: Sequence[Measured], numbers: Sequence[int]) -> Iterator[tuple[str, Readings]]:
    """Of the episodes that have as many stretches between switches of the gripper: the odd stretch of each."""
    moved = [each for number in numbers if (each := group[number].movement) is not None]
    ends = np.array([each.ends for each in moved])
    costs = neighbours.cost_residuals(ends, np.array([each.costs for each in moved]))
    for name, residuals in (
        ("course", neighbours.course_residuals(ends, np.array([each.courses for each in moved]))),
        ("time", costs[:, :, 0]),
        ("path", costs[:, :, 1]),
    ):
        found: list[Reading | None] = [None] * len(group)
        for number, each, row in zip(numbers, moved, residuals, strict=True):
            worst = int(np.argmax(row))
            found[number] = Reading(value=float(row[worst]), first=each.bounds[worst], last=each.bounds[worst + 1])
        yield name, found


def _images(group: Sequence[Measured]) -> Iterator[tuple[str, Readings, str]]:
    """(quantity, its readings, camera) of a group."""
    for camera in dict.fromkeys(camera for episode in group for camera in episode.sights):
        sights = [episode.sights.get(camera) for episode in group]

        def whole(of: Callable[[Sight], float], seen: Sequence[Sight | None] = sights) -> Readings:
            return [
                None if each is None else Reading(value=of(each), first=0, last=episode.length - 1)
                for each, episode in zip(seen, group, strict=True)
            ]

        yield "brightness", whole(lambda each: each.brightness), camera
        yield "sharpness", whole(lambda each: math.log(each.sharpness + 0.1)), camera
        yield "blank", whole(lambda each: each.blank), camera
        yield "frozen", _frozen(group, sights), camera


def _frozen(group: Sequence[Measured], sights: Sequence[Sight | None]) -> Readings:
    """For how many seconds an image stands still though the arm moves as fast as it changes images elsewhere."""
    pairs = [
        None
        if each is None or episode.movement is None
        else (each.changes, _moved(episode.movement.steps, each.frames))
        for each, episode in zip(sights, group, strict=True)
    ]
    known = [pair for pair in pairs if pair is not None]
    if not known:
        return [None] * len(group)
    changes, moved = (np.concatenate(part) for part in zip(*known, strict=True))
    fast = moved > np.median(moved)
    rate = float(np.median(changes[fast] / moved[fast])) if fast.any() else 0.0
    least = 0.3 * float(np.median(moved))
    found: list[Reading | None] = []
    for episode, each, pair in zip(group, sights, pairs, strict=True):
        if each is None or pair is None:
            found.append(None)
            continue
        stands = (pair[1] > least) & (pair[0] < np.minimum(_FROZEN * rate * pair[1], _FROZEN_LEVELS))
        length, start = longest_run(stands)
        run = slice(start, start + length)
        if length and np.median(each.most_changes[run]) >= _SAME_PART and np.median(each.changes[run]) >= _SAME_LEVELS:
            length = 0
        first, last = int(each.frames[start]), int(each.frames[start + length])
        fps = 1.0 if episode.movement is None else episode.movement.fps
        found.append(Reading(value=(last - first) / fps, first=first, last=last))
    return found


def _moved(steps: Array, frames: NDArray[np.int64]) -> Array:
    """(N - 1,) how far the arm goes from one of the frames to the next."""
    along = np.concatenate([[0.0], np.cumsum(steps)])
    return np.diff(along[frames])


def _otherwise(episodes: Sequence[Measured]) -> Iterator[tuple[int, Reason]]:
    """Episodes that show what another instruction of the dataset asks for."""
    cameras = sorted({camera for episode in episodes for camera in episode.sights})
    seen = [episode for episode in episodes if cameras and set(episode.sights) == set(cameras)]
    if len(seen) < neighbours.FEWEST:
        return
    looks = np.array([np.concatenate([episode.sights[camera].look for camera in cameras]) for episode in seen])
    off, words = neighbours.contradicted_words([episode.task for episode in seen], looks)
    for episode, spreads, word in zip(seen, off.tolist(), words, strict=True):
        yield (
            episode.number,
            Reason(
                kind="instruction",
                factor=_factor(spreads),
                text=f"its images contradict the instruction as to {word!r}",
                first=0,
                last=episode.length - 1,
            ),
        )


def _other_things(episodes: Sequence[Measured]) -> Iterator[tuple[int, Reason]]:
    """Episodes whose hand lacks the colours of what others hold."""
    grips = {episode.number: episode.movement.grips for episode in episodes if episode.movement is not None}
    for camera in dict.fromkeys(camera for episode in episodes for camera in episode.sights):
        seen = [episode for episode in episodes if camera in episode.sights and grips.get(episode.number)]
        if len(seen) < neighbours.FEWEST:
            continue
        values = lacking(np.stack([each.sights[camera].held for each in seen]), [each.task for each in seen])
        readings: list[Reading | None] = [None] * len(episodes)
        for each, value in zip(seen, values.tolist(), strict=True):
            if not math.isnan(value):
                own = grips[each.number]
                readings[each.number] = Reading(value=value, first=own[0][0], last=own[-1][1])
        yield from _judged("held", readings, camera)


def _twins(episodes: Sequence[Measured]) -> Iterator[tuple[int, Reason]]:
    """Episodes most of whose rows are those of an earlier one."""
    holders: dict[int, list[int]] = {}
    for episode in episodes:
        common: dict[int, int] = {}
        for value in episode.sketch.tolist():
            for other in holders.setdefault(value, []):
                common[other] = common.get(other, 0) + 1
            holders[value].append(episode.number)
        twin = max(common, key=lambda other: common[other], default=-1)
        if twin >= 0 and common[twin] >= _TWIN * len(episode.sketch):
            text = f"is a copy of episode {episodes[twin].episode_index}"
            yield episode.number, Reason(kind="copy", factor=0.0, text=text, first=0, last=episode.length - 1)
