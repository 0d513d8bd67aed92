"""One clock for streams with separate clocks: the message, or the two messages, that a row takes from each stream.

All times are integer nanoseconds. Missing data is never filled in: a row records the age of its data, and data older
than the mapping allows yields no row.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from demorec.extensions.imports.bag import EPOCH_S
from demorec.extensions.imports.mapping import CameraSource, Clock, Sampling
from demorec.extensions.imports.streams import Stream

NS = 1_000_000_000
MISSING = 2**62
"""Age of missing data."""
SKEW_S = 0.1
"""Maximum difference between header time and log time; a camera's exposure and transport take less."""
_PHASES = 64
"""Number of candidate start phases of a grid within a period: a stream with jitter of a third of a period leaves 21 of
them free.
"""
_ROUNDED_NS = 2_000
"""Maximum error, in either direction, of the distance between two timestamps rounded to microseconds."""
_WAITS = (0.0, 0.25, 0.5, 0.75, 1.0)
"""Parts of a period for which a row may wait for an image."""
Int = NDArray[np.int64]
Numbers = NDArray[np.floating[Any]]


@dataclass(frozen=True, kw_only=True, eq=False)
class Timeline:
    """A stream's messages sorted by time.

    Attributes:
        stream: The stream.
        times_ns: (M,) int64, strictly increasing.
        order: (M,) indices of the stream's messages. Excludes all but the first of equal times, messages without a
        time if others have one, and video before its first keyframe.
        is_header: Whether times are header times.
        period_ns: Usual interval, 0 for fewer than two messages.
        is_regular: Whether intervals are similar; false for a stream that publishes only changes.
        is_log_asked: Whether the mapping requests log times.
        sample: Sampling rule of the rows.
        max_age_ns: Maximum age of sampled messages.
    """

    stream: Stream
    times_ns: Int
    order: Int
    is_header: bool
    period_ns: int
    is_regular: bool
    is_log_asked: bool
    sample: Sampling
    max_age_ns: int

    @property
    def label(self) -> str:
        """Label of the stream for people."""
        return f"{self.stream.label} ({self.stream.topic})"

    @property
    def rule(self) -> str:
        """Sampling rule in words."""
        return f"{self.sample} by {'header' if self.is_header else 'log'} time"

    @property
    def stamps_ns(self) -> Int:
        """(N,) header times of the stream's messages; 0 or less if a header has no time."""
        return self.stream.header_ns if self.is_header else self.stream.log_ns

    @property
    def skews_ns(self) -> Int:
        """(K,) log time minus header time, for messages with a header time."""
        return (self.stream.log_ns - self.stream.header_ns)[self.stream.header_ns > 0]

    @property
    def num_repeated(self) -> int:
        """Number of messages with the same time as another one."""
        known = self.stamps_ns[self.stamps_ns > 0]
        return len(known) - len(np.unique(known))

    def chosen(self, rows_ns: Int) -> ChosenSamples:
        """Messages that rows at these times (R,) take."""
        return choose(self.times_ns, rows_ns, self.sample)

    def sampled(self, chosen: ChosenSamples) -> Numbers:
        """(R, D) numbers of these rows, for a source."""
        stream = self.stream
        return sampled(stream.values, self.order, chosen, unit=stream.unit, quaternions=stream.quaternions)

    def within(self, begin_ns: int, end_ns: int) -> Int:
        """Times between two moments."""
        return self.times_ns[(self.times_ns >= begin_ns) & (self.times_ns <= end_ns)]


def timeline(stream: Stream, clock: Clock) -> Timeline:
    """Build the timeline of a stream, by header times if requested and if most messages have one."""
    by_header = (stream.part.stamp or clock.stamp) == "header"
    sample: Sampling = stream.part.sample or clock.sample
    if isinstance(stream.part, CameraSource) and sample == "linear":
        sample = "latest"  # images are not interpolated
    age_s = clock.max_age_s if stream.part.max_age_s is None else stream.part.max_age_s
    stamped = stream.header_ns > 0
    is_header = by_header and bool(len(stamped)) and bool(np.mean(stamped) > 0.5)
    times = stream.header_ns if is_header else stream.log_ns
    is_known = stamped if is_header else ~without_log_time(stream.log_ns)
    if is_known.all() and bool(np.all(times[1:] > times[:-1])):
        order: Int = np.arange(len(times))
        ordered = times
    else:
        usable = np.flatnonzero(is_known)
        order = usable[np.argsort(times[usable], kind="stable")]
        ordered = times[order]
        is_first = np.diff(ordered, prepend=ordered[:1] - 1) > 0
        ordered, order = ordered[is_first], order[is_first]
    steps = np.diff(ordered)
    period = int(np.median(steps)) if len(steps) else 0
    # Most steps of a sensor take about a period, even with losses; those of commands on change vary freely.
    is_regular = len(steps) >= 8 and bool(np.mean((steps > 0.3 * period) & (steps < 1.7 * period)) > 0.6)
    if stream.heads:
        keyframes = np.flatnonzero(stream.heads.are_keyframes[order])
        first = int(keyframes[0]) if len(keyframes) else len(order)
        ordered, order = ordered[first:], order[first:]
    return Timeline(
        stream=stream,
        times_ns=ordered,
        order=order,
        is_header=is_header,
        period_ns=period,
        is_regular=is_regular,
        is_log_asked=not by_header,
        sample=sample,
        max_age_ns=MISSING - 1 if age_s >= 1e9 else round(age_s * NS),
    )


def without_log_time(log_ns: Int) -> NDArray[np.bool_]:
    """(N,) whether each message was recorded without a time: 0, if others are not in simulated time from 0."""
    is_dated = bool(len(log_ns)) and float(np.median(log_ns)) > EPOCH_S * NS
    return np.asarray((log_ns == 0) & is_dated)


@dataclass(frozen=True, kw_only=True, eq=False)
class ChosenSamples:
    """Messages that rows take from a stream.

    Attributes:
        index: (R,) index of the message in its timeline; for two, the earlier one; -1 for none.
        fraction: (R,) position of the row between that message and the next one, 0 to 1; None without interpolation.
        age_ns: (R,) row time minus message time, negative if the message is later; for two, of the earlier one.
        reach_ns: (R,) distance of the message; for two, of the farther one. MISSING without a message.
    """

    index: Int
    fraction: NDArray[np.float64] | None
    age_ns: Int
    reach_ns: Int

    @property
    def num_unused(self) -> int:
        """Number of messages from the first to the last of the rows that none of them takes; all have one."""
        used = self.index if self.fraction is None else np.append(self.index, self.index[self.fraction > 0] + 1)
        return int(used.max() - used.min()) + 1 - len(np.unique(used))


def choose(times_ns: Int, rows_ns: Int, sample: Sampling) -> ChosenSamples:
    """Choose the messages for some rows.

    Args:
        times_ns: (M,) strictly increasing, M > 0.
        rows_ns: (R,) increasing.
        sample: latest: the last message at or before the row; nearest: the closest one, the earlier of two equally
        close;
            linear: both neighbours, or one exactly at the row.
    """
    count = len(times_ns)
    before = np.searchsorted(times_ns, rows_ns, side="right") - 1
    after = np.minimum(before + 1, count - 1)
    since = np.where(before >= 0, rows_ns - times_ns[np.maximum(before, 0)], MISSING)
    until = np.where(before + 1 < count, times_ns[after] - rows_ns, MISSING)
    if sample == "latest":
        return ChosenSamples(index=before, fraction=None, age_ns=since, reach_ns=since)
    if sample == "nearest":
        later = until < since
        age = np.where(later, -until, since)
        return ChosenSamples(index=np.where(later, after, before), fraction=None, age_ns=age, reach_ns=np.abs(age))
    exact = since == 0
    # A row outside the stream has a neighbour on one side only and cannot be interpolated.
    is_outside = ~exact & ((before < 0) | (before + 1 >= count))
    reach = np.where(is_outside, MISSING, np.where(exact, 0, np.maximum(since, until)))
    width = np.where(exact | is_outside, 1, times_ns[after] - times_ns[np.maximum(before, 0)])
    fraction = np.where(exact, 0.0, np.clip(since / width, 0.0, 1.0))
    return ChosenSamples(index=before, fraction=fraction, age_ns=np.where(is_outside, MISSING, since), reach_ns=reach)


def sampled(values: Numbers, order: Int, chosen: ChosenSamples, *, unit: str, quaternions: tuple[int, ...]) -> Numbers:
    """(R, D) numbers of some rows.

    Args:
        values: (N, D) in the bag's order.
        order: (M,) order of the timeline.
        chosen: Choice for the rows; all of them have a message.
        unit: Unit of the values: angles (rad, degree) are interpolated along the shorter direction.
        quaternions: First elements of x, y, z, w groups, which are interpolated on the sphere.

    Returns:
        Bit-exact values where one message is taken; float64 where two are interpolated.
    """
    if chosen.fraction is None or not np.any(chosen.fraction):
        return values[order[chosen.index]]
    first = values[order[chosen.index]].astype(np.float64)
    second = values[order[np.minimum(chosen.index + 1, len(order) - 1)]].astype(np.float64)
    fraction = chosen.fraction[:, np.newaxis]
    step = second - first
    turn = {"rad": 2 * np.pi, "degree": 360.0}.get(unit)
    wraps = np.abs(step) > turn / 2 if turn else np.zeros(step.shape, bool)
    if turn:
        step = np.where(wraps, step - turn * np.round(step / turn), step)
    mixed = first + fraction * step
    if turn:
        mixed = np.where(wraps, mixed - turn * np.round(mixed / turn), mixed)
    for start in quaternions:
        part = slice(start, start + 4)
        mixed[:, part] = _slerp(first[:, part], second[:, part], chosen.fraction)
    return np.where(fraction == 0.0, first, mixed)


def _slerp(first: Numbers, second: Numbers, fraction: NDArray[np.float64]) -> Numbers:
    """(R, 4) on the shorter great arc from `first` to `second`, with the mean of their lengths."""
    lengths = [np.linalg.norm(part, axis=1, keepdims=True) for part in (first, second)]
    a, b = first / np.maximum(lengths[0], 1e-300), second / np.maximum(lengths[1], 1e-300)
    cosine = np.sum(a * b, axis=1, keepdims=True)
    b = np.where(cosine < 0, -b, b)
    angle = np.arccos(np.clip(np.abs(cosine), 0.0, 1.0))
    t, sine = fraction[:, np.newaxis], np.sin(angle)
    small = sine < 1e-6
    safe = np.where(small, 1.0, sine)
    of_a, of_b = (np.where(small, part, np.sin(part * angle) / safe) for part in (1 - t, t))
    mixed = of_a * a + of_b * b
    length = (1 - t) * lengths[0] + t * lengths[1]
    return np.asarray(mixed / np.maximum(np.linalg.norm(mixed, axis=1, keepdims=True), 1e-300) * length)


def grid(begin_ns: int, end_ns: int, fps: int, streams: Sequence[Int] = ()) -> Int:
    """(R,) evenly spaced row times, `fps` per second; the first within a period from `begin_ns`, none after `end_ns`.

    Row k is k/fps s after the first, rounded down: an integer is after that time exactly if it is after the rounded
    time. The first row is placed so that a reader taking the last message before each row sees most messages of
    `streams`, (M,) times of each, as early as possible; none is at an edge, where jitter and rounding would decide.
    """
    count = max(0, (end_ns - begin_ns) * fps // NS + 1)
    inside = [times[(times >= begin_ns) & (times <= end_ns)] for times in streams]

    def fit(phase: int) -> tuple[int, int]:
        first, num_shown, age = begin_ns + phase, 0, 0
        for times in inside:
            rows = np.maximum(-((first - times) * fps // NS), 0)  # first row not before the message
            is_shown = np.append(rows[1:] != rows[:-1], True) & (rows <= (end_ns - first) * fps // NS)
            num_shown += int(is_shown.sum())
            age += int((first + rows * NS // fps - times)[is_shown].sum())
        return num_shown, -age

    phases = (0, _ROUNDED_NS, *(NS * part // (fps * _PHASES) for part in range(1, _PHASES)))
    begin_ns += max(phases, key=fit) if count and inside else 0
    count = max(0, (end_ns - begin_ns) * fps // NS + 1)
    return begin_ns + np.arange(count, dtype=np.int64) * NS // fps


def followed(lead: Int, others: Sequence[Int], *, period_ns: int, end_ns: int) -> Int:
    """(R,) row times, one for each time of `lead`: at that time, or slightly later if an image of `others` would be
    lost.

    Images that several cameras take at about the same moment arrive in varying order. With a row at each image of one
    camera, another camera's image would be one period old in one row and skipped in the next. A row that would repeat
    another camera's image may therefore wait for the next one, unless that skips an image: up to the part of a period
    in `_WAITS` with the fewest skipped or repeated images, the shortest of equals.

    Args:
        lead: (R,) increasing.
        others: (M,) times of each other camera with that rate, increasing.
        period_ns: Usual interval.
        end_ns: Maximum time of a row.
    """
    best, fewest = lead, -1
    for part in _WAITS:
        rows = _waited(lead, others, round(part * period_ns), end_ns)
        steps = [np.diff(np.searchsorted(times, rows, side="right")) for times in others]
        # Number of skipped or repeated images. Otherwise cameras with a constant order would lose the same image at
        # both ends.
        num_off = sum(int(np.abs(step - 1).sum()) for step in steps)
        if fewest < 0 or num_off < fewest:
            best, fewest = rows, num_off
        if not fewest:
            break
    return best


def _waited(lead: Int, others: Sequence[Int], wait_ns: int, end_ns: int) -> Int:
    """(R,) rows of `followed` with a maximum wait of `wait_ns`."""
    if not wait_ns or not len(lead):
        return lead
    images = [times.tolist() for times in others]
    shown = [bisect_right(times, int(lead[0])) - 1 for times in images]
    rows = []
    for time, following in zip(lead.tolist(), [*lead[1:].tolist(), end_ns + 1], strict=True):
        ends = [times[last + 2] - 1 for times, last in zip(images, shown, strict=True) if last + 2 < len(times)]
        until = min(time + wait_ns, following - 1, end_ns, *ends)
        nexts = [times[last + 1] for times, last in zip(images, shown, strict=True) if last + 1 < len(times)]
        row = max([time, *(image for image in nexts if image <= until)])
        shown = [bisect_right(times, row) - 1 for times in images]
        rows.append(row)
    return np.array(rows, dtype=np.int64)
