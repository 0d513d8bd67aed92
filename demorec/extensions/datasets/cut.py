"""Cuts of a plan's episodes: at frames, at jumps of the data, around pauses, or at idle ends."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from demorec.core.errors import ConfigError, OptionError
from demorec.core.geometry import Array
from demorec.core.registry import check_choice
from demorec.datasets.lerobot.files import column_numbers
from demorec.datasets.lerobot.layout import AUTOMATIC_FEATURES
from demorec.extensions.datasets.plan import EpisodeSlice, Plan

_NEAR = 5
"""Number of steps before and after a step for comparison; a slow sensor repeats a number for fewer frames."""
Span = tuple[int, int]
"""First frame of a part, and the one after its last."""


class WatchedNumbers:
    """Numbers that define motion, episode by episode.

    Args:
        plan: Plan of a whole dataset.
        features: Features to watch; empty for the state.
        grippers: Whether to watch the grippers of the state.

    Raises:
        ConfigError: No such numeric feature, or the state is unknown.
    """

    def __init__(self, plan: Plan, features: Sequence[str], *, grippers: bool = False) -> None:
        (source,) = plan.sources
        own = source.info.features.items()
        numeric = [name for name, feature in own if feature.is_numeric and name not in AUTOMATIC_FEATURES]
        for feature in features:
            check_choice("feature of numbers", feature, numeric)
        self._names = features or source.roles.state
        if not self._names:
            raise ConfigError(f"No state was found: give frames (trim --head, cut --at), or --feature: {source.root}")
        self._is_watched = slice(None) if features or grippers else ~source.roles.grippers()
        self._places, self._rows = source.places, source.rows(self._names)

    def episode(self, number: int) -> Array:
        """(T, D) numbers of an episode."""
        table = self._rows.read(self._places[number])
        columns = [column_numbers(table.column(name).combine_chunks()) for name in self._names]
        return np.asarray(np.hstack(columns).astype(np.float64)[:, self._is_watched])

    def least(self, option: str, ratio: float) -> Array:
        """(D,) minimum change: a ratio of the difference between largest and smallest number over the dataset."""
        if not 0 < ratio <= 1:
            raise OptionError(option, f"is {ratio}, allowed are ratios above 0 and up to 1.")
        low, high = np.inf, -np.inf
        for number in range(len(self._places)):
            values = self.episode(number)
            low = np.fmin(low, np.fmin.reduce(values))
            high = np.fmax(high, np.fmax.reduce(values))
        return np.asarray(ratio * (high - low))


def cut_at(plan: Plan, frames: Mapping[int, Sequence[int]]) -> Plan:
    """Cut episodes before given frames: number of an episode -> first frames of further parts."""
    for number, begins in frames.items():
        root = plan.sources[0].root
        if not 0 <= number < len(plan.cuts):
            raise ConfigError(f"Episode {number} does not exist, the dataset has 0 to {len(plan.cuts) - 1}: {root}")
        length = plan.cuts[number].last
        if wrong := [frame for frame in begins if not 0 < frame < length]:
            raise ConfigError(
                f"Episode {number} of {length} frames cannot be cut before frame {wrong[0]}: give 1 to {length - 1}."
            )
    return _in_parts(plan, {number: _between(plan.cuts[number].last, begins) for number, begins in frames.items()})


def cut_at_jumps(plan: Plan, features: Sequence[str], threshold: float) -> Plan:
    """Cut episodes where numbers jump.

    Args:
        plan: Plan of a whole dataset.
        features: Features to watch; empty for the state without grippers.
        threshold: A jump is a step between frames that exceeds all steps near it by more than this ratio of its range
            over the dataset; in motion, neighbouring steps are similar.
    """
    watched = WatchedNumbers(plan, features)
    least = watched.least("jump_threshold", threshold)
    parts = {}
    for number, cut in enumerate(plan.cuts):
        steps = np.abs(np.diff(watched.episode(number), axis=0))
        begins = np.flatnonzero((steps - _largest_near(steps) > least).any(axis=1)) + 1
        parts[number] = _between(cut.last, begins.tolist())
    return _in_parts(plan, parts)


def without_pauses(plan: Plan, features: Sequence[str], seconds: float, threshold: float, margin: int) -> Plan:
    """Remove pauses; each part between two pauses becomes an episode.

    Args:
        plan: Plan of a whole dataset.
        features: Features to watch; empty for the state without grippers.
        seconds: Minimum length of a pause.
        threshold: Maximum change of each number during a pause, as a ratio of its range over the dataset.
        margin: Still frames to keep at either end of a pause.
    """
    min_frames = round(seconds * plan.info.fps)
    if min_frames < 2:
        raise OptionError("pauses", f"is shorter than two frames at {plan.info.fps} frames per second.")
    watched = WatchedNumbers(plan, features)
    least = watched.least("still_threshold", threshold)
    parts = {}
    for number, cut in enumerate(plan.cuts):
        kept: list[Span] = []
        begin = 0
        for first, last in _pauses(watched.episode(number), least, min_frames):
            end = min(first + margin, last) if first else 0
            kept.append((begin, end))
            begin = max(last - margin, end) if last < cut.last else cut.last
        kept = [span for span in [*kept, (begin, cut.last)] if span[1] > span[0]]
        parts[number] = kept or [(0, cut.last)]  # no motion at all: that is a decision for `drop`
    return _in_parts(plan, parts)


def without_idle_ends(plan: Plan, threshold: float, margin: int) -> Plan:
    """Cut off the still frames at the beginning and the end of each episode.

    Args:
        plan: Plan of a whole dataset.
        threshold: Maximum change of each number in still frames, as a ratio of its range over the dataset.
        margin: Still frames to keep at either end.
    """
    watched = WatchedNumbers(plan, (), grippers=True)
    least = watched.least("idle_threshold", threshold)
    cuts = []
    for cut in plan.cuts:
        values = watched.episode(cut.episode)
        # Compared with the initial and final values, so that slow motion counts as well.
        away_from_start = np.flatnonzero((np.abs(values - values[0]) > least).any(axis=1))
        away_from_end = np.flatnonzero((np.abs(values - values[-1]) > least).any(axis=1))
        if not len(away_from_start):
            cuts.append(cut)  # no motion at all: that is a decision for `drop`
            continue
        first = max(0, int(away_from_start[0]) - 1 - margin)
        last = min(cut.last, int(away_from_end[-1]) + 2 + margin)
        cuts.append(replace(cut, first=first, last=max(last, first + 1)))
    return plan.with_cuts(cuts)


def _largest_near(steps: Array) -> Array:
    """Find the largest of the steps (T, D) around each one."""
    padded = np.pad(steps, ((_NEAR, _NEAR), (0, 0)))
    shifts = [shift for shift in range(2 * _NEAR + 1) if shift != _NEAR]
    return np.asarray(np.max([padded[shift : shift + len(steps)] for shift in shifts], axis=0))


def _pauses(values: Array, least: Array, min_frames: int) -> Iterator[Span]:
    """Yield the intervals in which all of (T, D) numbers stay within `least` (D,) of their initial values."""
    begin = 0
    while begin + min_frames <= len(values):
        has_left = (np.abs(values[begin + 1 : begin + min_frames] - values[begin]) > least).any(axis=1)
        if has_left.any():
            begin += 1
            continue
        moved = np.flatnonzero((np.abs(values[begin:] - values[begin]) > least).any(axis=1))
        end = begin + int(moved[0]) if len(moved) else len(values)
        yield begin, end
        begin = end


def _between(length: int, begins: Sequence[int]) -> list[Span]:
    """Parts of an episode that begin at 0 and at these frames."""
    return list(pairwise([0, *sorted(set(begins)), length]))


def _in_parts(plan: Plan, parts: Mapping[int, Sequence[Span]]) -> Plan:
    """Split episodes into parts, of which the last has the episode's end; others stay complete."""
    cuts: list[EpisodeSlice] = []
    for number, cut in enumerate(plan.cuts):
        spans = parts.get(number, [(cut.first, cut.last)])
        cuts += [replace(cut, first=first, last=last, has_end=False) for first, last in spans[:-1]]
        cuts.append(replace(cut, first=spans[-1][0], last=spans[-1][1]))
    return plan.with_cuts(cuts)
