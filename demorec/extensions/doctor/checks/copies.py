"""Checks of copies: whole episodes and segments that occur twice, within a set and across two."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from demorec.check.base import Fault, NotApplicableError, NotMeasuredError, check
from demorec.core.geometry import Array
from demorec.extensions.doctor.evidence import DROP, EpisodeEvidence, Evidence

PIECE_S = 0.5
"""Minimum duration of a shared segment, s."""
MIN_PIECE = 8
"""Minimum frames of a shared segment: that many moving readings of all elements do not repeat by chance."""
_MOMENTS = 32
_NOWHERE = (-1, -1)
"""Episode and frame of a row that the other set lacks."""
MAX_DISTANCE = 1e-3
"""Maximum root mean square difference of two motions, as a ratio of the usual range, at which one is a copy: it is the
size of an encoder step, and people never repeat a motion so closely."""


@check(
    family="set",
    needs="state",
    measures="episodes that are copies of another",
    unit="episodes",
    why="A copy counts twice in training, and in a validation split it hides overfitting.",
    do=DROP,
)
def copied_episodes(evidence: Evidence) -> Iterator[Fault]:
    """Compare the states of all episodes of equal length at 32 instants each; all copies are listed."""
    episodes = evidence.need_state(MIN_PIECE)
    if len(episodes) < 2:
        raise NotMeasuredError("it needs two episodes")
    for later, earlier in copies(episodes, episodes, evidence.ranges):
        yield Fault(
            severity="broken",
            episode=later.number,
            value=f"copy of episode {earlier.number}",
            message=f"it has the motion of episode {earlier.number}",
        )


def copies(
    later: Sequence[tuple[EpisodeEvidence, Array]], earlier: Sequence[tuple[EpisodeEvidence, Array]], ranges: Array
) -> Iterator[tuple[EpisodeEvidence, EpisodeEvidence]]:
    """Yield (episode, the first one that it is a copy of); within one set, each is compared with earlier ones."""
    alive = ranges > 0
    by_length: dict[int, list[tuple[EpisodeEvidence, Array]]] = defaultdict(list)
    for episode, state in earlier:
        by_length[len(state)].append((episode, _moments(state, ranges, alive)))
    moments = {length: np.stack([each for _, each in group]) for length, group in by_length.items()}
    same = later is earlier
    for episode, state in later:
        if not np.ptp(state, axis=0).any() or len(state) not in moments:
            continue  # an episode at rest has no motion to copy
        group = by_length[len(state)]
        count = sum(other.number < episode.number for other, _ in group) if same else len(group)
        distances = moments[len(state)][:count] - _moments(state, ranges, alive)
        near = np.flatnonzero(np.sqrt((distances**2).mean(axis=(1, 2))) <= MAX_DISTANCE)
        if len(near):
            yield episode, group[near[0]][0]


def _moments(state: Array, ranges: Array, alive: NDArray[np.bool_]) -> Array:
    moments = np.linspace(0, len(state) - 1, _MOMENTS).round().astype(int)
    return np.asarray(state[moments][:, alive] / ranges[alive])


@check(
    family="set",
    needs="state",
    measures="segments that two episodes share",
    unit="frames",
    why="A segment was written twice: one of the episodes has frames of the other.",
    do=DROP,
)
def shared_pieces(evidence: Evidence) -> Iterator[Fault]:
    """Find runs of moving frames with bit-exact state and action in two episodes, or twice in one."""
    episodes = evidence.need_state(MIN_PIECE)
    whole = {later.number for later, _ in copies(episodes, episodes, evidence.ranges)}
    first_seen: dict[bytes, tuple[int, int]] = {}
    for episode, _ in episodes:
        number = episode.number
        if number in whole:
            continue
        places = [first_seen.setdefault(row, (number, frame)) for frame, row in enumerate(_rows(episode))]
        for other, (first, last) in _pieces(places, number, evidence.fps).items():
            where = "twice" if other == number else f"in episode {other} too"
            yield Fault(
                severity="broken",
                episode=number,
                frames=(first, last),
                value=f"{last - first + 1} frames",
                message=f"frames {first} to {last} occur {where}, to the last bit",
            )


def _pieces(places: Sequence[tuple[int, int]], number: int, fps: float) -> Mapping[int, tuple[int, int]]:
    """Find episode -> first and last frame of moving segments that it shares with this one.

    Frames at rest were first seen in one frame, moving ones in consecutive frames.

    Args:
        places: Episode and frame in which each frame was first seen.
        number: This episode; frames at their own place are not shared.
        fps: Frames per second.
    """
    found: dict[int, tuple[int, int]] = {}
    for (owner, offset), group in groupby(enumerate(places), key=lambda each: (each[1][0], each[1][1] - each[0])):
        frames = [frame for frame, _ in group]
        if (owner, offset) != (number, 0) and len(frames) > max(MIN_PIECE, PIECE_S * fps):
            found[owner] = (found.get(owner, frames)[0], frames[-1])
    return found


def _rows(episode: EpisodeEvidence) -> list[bytes]:
    """Return the bytes of state and action of each frame."""
    assert episode.state is not None
    parts = [episode.state] if episode.action is None else [episode.state, episode.action]
    table = np.ascontiguousarray(np.hstack(parts).astype(np.float32))
    return [row.tobytes() for row in table]


@check(
    family="set",
    needs="two datasets with states",
    measures="episodes that two datasets share (check A B)",
    unit="episodes",
    why="Training data cannot validate a policy: its score is too good.",
    do="drop them from one of the two: " + DROP,
)
def leakage(evidence: Evidence) -> Iterator[Fault]:
    """Find the episodes and segments of every dataset of the command in the datasets named before it."""
    if not evidence.earlier:
        raise NotApplicableError("it compares two datasets: demorec check TRAIN VAL")
    for other in evidence.earlier:
        yield from _leaks(other, evidence)


def _leaks(train: Evidence, other: Evidence) -> Iterator[Fault]:
    ours, theirs = train.with_state(MIN_PIECE), other.with_state(MIN_PIECE)
    if not ours or not theirs or len(train.ranges) != len(other.ranges):
        return
    copied: set[int] = set()
    for later, earlier in copies(theirs, ours, train.ranges):
        copied.add(later.number)
        yield Fault(
            severity="broken",
            episode=later.number,
            value=f"episode {earlier.number}",
            message=f"it is episode {earlier.number} of {train.path}",
        )
    first_seen: dict[bytes, tuple[int, int]] = {}
    for episode, _ in ours:
        for frame, row in enumerate(_rows(episode)):
            first_seen.setdefault(row, (episode.number, frame))
    for episode, _ in theirs:
        if episode.number in copied:
            continue
        places = [first_seen.get(row, _NOWHERE) for row in _rows(episode)]
        for owner, (first, last) in list(_pieces(places, _NOWHERE[0], train.fps).items())[:1]:
            yield Fault(
                severity="broken",
                episode=episode.number,
                frames=(first, last),
                value=f"{last - first + 1} frames",
                message=f"its frames {first} to {last} are in episode {owner} of {train.path}",
            )
