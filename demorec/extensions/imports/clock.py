"""One clock for streams with separate clocks: the message that a row takes from each stream.

All times are integer nanoseconds. Missing data is never filled in: a row records the age of its data, and data older
than the mapping allows yields no row.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from demorec.extensions.imports.bag import NS
from demorec.extensions.imports.mapping import Clock, Source
from demorec.extensions.imports.streams import Stream

MISSING = 2**62
"""Age of missing data."""
SKEW_S = 0.1
"""Maximum difference between header time and log time; a camera's exposure and transport take less."""
_PHASES = 64
"""Number of candidate start phases of a grid within a period: a stream with jitter of a third of a period leaves 21 of
them free.
"""
_WAITS = tuple(part / 8 for part in range(8))
"""Parts of a period for which rows may wait for images."""
Int = NDArray[np.int64]
Numbers = NDArray[np.floating[Any]]


@dataclass(frozen=True, kw_only=True, eq=False)
class Timeline:
    """A stream's messages sorted by time.

    Attributes:
        times_ns: (M,) int64, strictly increasing.
        order: (M,) indices of the stream's messages. Excludes all but the first of equal times, messages without a
        time if others have one, and video before its first keyframe.
        is_header: Whether times are header times.
        period_ns: Usual interval, 0 for fewer than two messages.
        is_regular: Whether intervals are similar; false for a stream that publishes only changes.
        max_age_ns: Maximum age of the messages that rows take.
    """

    stream: Stream
    times_ns: Int
    order: Int
    is_header: bool
    period_ns: int
    is_regular: bool
    max_age_ns: int

    @property
    def label(self) -> str:
        """Label of the stream for people."""
        return f"{self.stream.label} ({self.stream.topic})"

    @property
    def skews_ns(self) -> Int:
        """(K,) log time minus header time, for messages with a header time."""
        return (self.stream.log_ns - self.stream.header_ns)[self.stream.header_ns > 0]

    def chosen(self, rows_ns: Int) -> ChosenSamples:
        """Messages that rows at these times (R,) take."""
        index = np.searchsorted(self.times_ns, rows_ns, side="right") - 1
        age = np.where(index >= 0, rows_ns - self.times_ns[np.maximum(index, 0)], MISSING)
        return ChosenSamples(index=index, age_ns=age)

    def within(self, begin_ns: int, end_ns: int) -> Int:
        """Times between two moments."""
        return self.times_ns[(self.times_ns >= begin_ns) & (self.times_ns <= end_ns)]


def timeline(stream: Stream, clock: Clock) -> Timeline:
    """Build the timeline of a stream, by header times if requested and if most messages have one."""
    own_age_s = stream.part.max_age_s if isinstance(stream.part, Source) else None
    age_s = clock.max_age_s if own_age_s is None else own_age_s
    stamped = stream.header_ns > 0
    is_header = clock.stamp == "header" and bool(len(stamped)) and bool(np.mean(stamped) > 0.5)
    times = stream.header_ns if is_header else stream.log_ns
    usable = np.flatnonzero(stamped) if is_header else np.arange(len(times))
    order: Int = usable[np.argsort(times[usable], kind="stable")]
    ordered = times[order]
    is_first = np.diff(ordered, prepend=ordered[:1] - 1) > 0
    ordered, order = ordered[is_first], order[is_first]
    steps = np.diff(ordered)
    period = int(np.median(steps)) if len(steps) else 0
    # Most steps of a sensor take about a period, even with losses; those of commands on change vary freely.
    is_regular = len(steps) >= 8 and bool(np.mean((steps > 0.3 * period) & (steps < 1.7 * period)) > 0.6)
    if stream.heads:
        keyframes = np.flatnonzero(stream.are_keyframes[order])
        first = int(keyframes[0]) if len(keyframes) else len(order)
        ordered, order = ordered[first:], order[first:]
    return Timeline(
        stream=stream,
        times_ns=ordered,
        order=order,
        is_header=is_header,
        period_ns=period,
        is_regular=is_regular,
        max_age_ns=MISSING - 1 if age_s >= 1e9 else round(age_s * NS),
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class ChosenSamples:
    """Messages that rows take from a stream.

    Attributes:
        index: (R,) index of the message in its timeline; -1 for none.
        age_ns: (R,) row time minus message time; MISSING without a message.
    """

    index: Int
    age_ns: Int


def grid(begin_ns: int, end_ns: int, fps: int, streams: Sequence[Int] = ()) -> Int:
    """(R,) evenly spaced row times, `fps` per second; the first within a period from `begin_ns`, none after `end_ns`.

    Row k is k/fps s after the first, rounded down. The first row is placed so that a reader taking the last message
    before each row sees most messages of `streams`, (M,) times of each.
    """

    def rows(phase: int) -> Int:
        first = begin_ns + NS * phase // (fps * _PHASES)
        return first + np.arange(max(0, (end_ns - first) * fps // NS + 1), dtype=np.int64) * NS // fps

    def num_shown(phase: int) -> int:
        return sum(len(np.unique(np.searchsorted(times, rows(phase), side="right"))) for times in streams)

    return rows(max(range(_PHASES), key=num_shown))


def followed(lead: Int, others: Sequence[Int], *, period_ns: int, end_ns: int) -> Int:
    """(R,) row times up to `end_ns`, one for each image of `lead`, or all later if images of `others` would be lost.

    Images that several cameras take at about the same moment arrive in varying order. With a row at each image of one
    camera, another camera's image would be one period old in one row and skipped in the next. Rows therefore wait for
    the part of a period in `_WAITS` with the fewest skipped or repeated images, the shortest of equals.
    """

    def rows(part: float) -> Int:
        return np.minimum(lead + round(part * period_ns), end_ns)

    def num_off(part: float) -> int:
        steps = [np.diff(np.searchsorted(times, rows(part), side="right")) for times in (lead, *others)]
        return sum(int(np.abs(step - 1).sum()) for step in steps)

    return rows(min(_WAITS, key=num_off)) if others else lead
