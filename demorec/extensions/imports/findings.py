"""Findings about a bag: lost and repeated messages, clocks, streams that are shorter than others, and images in no row.

The limits give no findings for sensors with ordinary jitter and latency, or for robots that rest for a while. Nothing
is repaired: a finding describes the data in the rows.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from demorec.extensions.imports.bag import NS
from demorec.extensions.imports.clock import SKEW_S, Int, Timeline
from demorec.extensions.imports.rows import RATE, EpisodeRows, Timelines
from demorec.extensions.imports.streams import NO_STAMP

_EPOCH_S = 1e8
"""Difference between two clocks that implies another epoch: three years, since no clock is that wrong."""
_GAP = 5.0
"""Minimum periods without a message for a gap; shorter ones are lost messages."""
_LOST = 1.6
"""Minimum step in periods that implies a lost message."""
_MOVED_S = 0.05
"""Minimum change of a clock in a bag that is reported."""
_SHORTER_S = 0.5
"""Minimum time by which a stream must begin later or end earlier than others."""
_YEAR_S = 365.25 * 86_400
_MAX_ENCODER_NOISE = 1e-3
"""Maximum range of a resting joint: radians or metres, or the same ratio of larger values in degrees or counts."""
NOTE = "note"
"""Kind of an observation that is not a problem."""
_EARLY_S = 0.05
"""Maximum time by which a header may be later than its log time: clocks set by NTP differ by less."""


@dataclass(frozen=True, kw_only=True)
class ImportFinding:
    """A finding of one kind, or a note, about a stream ("observation.state", "camera front"), "" for the whole bag."""

    kind: str
    stream: str
    text: str


def bag_findings(bag: Timelines) -> tuple[ImportFinding, ...]:
    """Findings about a bag's messages, each once."""
    lines = list(bag.lines.values())
    is_log_asked = bag.mapping.clock.stamp == "log"
    found = [finding for line in lines for finding in _stream_findings(line, is_log_asked=is_log_asked)]
    if not _have_another_epoch(lines):
        found += [finding for line in lines for finding in _skew_findings(line)]
    found += [ImportFinding(kind="cut_off", stream="", text=problem) for problem in bag.streams.problems]
    found += [*_extent_findings(lines), *_clock_findings(lines), *_still_findings(lines)]
    once: dict[tuple[str, str], ImportFinding] = {}
    for finding in found:  # features that share a topic also share its findings
        once.setdefault((finding.kind, finding.text), finding)
    return tuple(once.values())


def _of(line: Timeline, kind: str, text: str) -> ImportFinding:
    return ImportFinding(kind=kind, stream=line.stream.label, text=f"{line.stream.topic}: {text}")


def _stream_findings(line: Timeline, *, is_log_asked: bool) -> Iterator[ImportFinding]:
    """Findings about a stream alone."""
    stream = line.stream
    if stream.num_malformed:
        text = f"{stream.num_malformed} messages cannot be used, the first since {stream.first_problem}"
        yield _of(line, "malformed", text)
    unstamped = int(np.sum((stream.header_ns <= 0) & (stream.header_ns != NO_STAMP)))
    if unstamped and not is_log_asked:
        kind = NOTE if unstamped == len(stream) else "unstamped"
        yield _of(line, kind, f"{unstamped} of {len(stream)} headers have no time")
    stamps = stream.header_ns if line.is_header else stream.log_ns
    known = stamps[stamps > 0]
    if late := max(int(np.sum(np.diff(stream.log_ns) < 0)), int(np.sum(np.diff(known) < 0))):
        yield _of(line, "order", f"{late} messages come before earlier ones")
    if repeated := len(known) - len(np.unique(known)):
        yield _of(line, "duplicates", f"{repeated} messages have the time of another one")
    if line.is_regular:
        yield from _loss_findings(line)
    if stream.heads and not stream.heads[0].is_keyframe:
        first = int(np.argmax(stream.are_keyframes))
        yield _of(line, "keyframe", f"its first {first} images cannot be decoded, since no keyframe is before them")


def _loss_findings(line: Timeline) -> Iterator[ImportFinding]:
    steps, lost = np.diff(line.times_ns), lost_in(line)
    is_gap = steps > _GAP * line.period_ns
    gaps = np.flatnonzero(is_gap)
    if len(gaps):
        begin = (line.times_ns[gaps[0]] - line.times_ns[0]) / NS
        longest = steps.max() / NS
        yield _of(line, "gap", f"{len(gaps)} gaps, the first at {begin:.2f} s, the longest of {longest:.3f} s")
    if num_lost := int(lost[~is_gap].sum()):
        yield _of(line, "drops", f"{num_lost} of {len(line.times_ns) + num_lost} messages are lost")


def lost_in(line: Timeline) -> Int:
    """(M - 1,) number of lost messages between each two of a regular stream.

    If its steps are uneven, a long one is not a loss: nine in ten are within 1.6 deviations, nearly all within 4.
    """
    steps = np.diff(line.times_ns)
    usual = steps[steps <= _LOST * line.period_ns]
    uneven = float(np.percentile(np.abs(usual - line.period_ns), 90)) if len(usual) else 0.0
    least = max(_LOST * line.period_ns, line.period_ns + 4 / 1.6 * uneven)
    return np.where(steps > least, np.round(steps / line.period_ns).astype(np.int64) - 1, 0)


def _skew_findings(line: Timeline) -> Iterator[ImportFinding]:
    """Findings about the difference between log times and header times."""
    skew = line.skews_ns
    if len(skew) < 8:
        return
    median = float(np.median(skew)) / NS
    if median > SKEW_S:
        yield _of(line, "clock_offset", f"its headers are {median:.3f} s behind the times of recording")
    elif median < -_EARLY_S:
        yield _of(line, "clock_offset", f"its headers are {-median:.3f} s later than the times of recording")
    width = max(3, min(20, len(skew) // 4))  # a delay of single messages does not change a median
    smooth = np.array([np.median(part) for part in np.array_split(skew, max(2, len(skew) // width))]) / NS
    if np.ptp(smooth) > _MOVED_S:
        yield _of(line, "clock_drift", f"its clock moves by {np.ptp(smooth):.3f} s against the times of recording")


def _have_another_epoch(lines: Sequence[Timeline]) -> bool:
    """Whether all header times have another epoch than the log times: simulated time."""
    known = [line for line in lines if len(line.skews_ns)]
    return bool(known) and all(abs(np.median(line.skews_ns)) >= _EPOCH_S * NS for line in known)


def _clock_findings(lines: Sequence[Timeline]) -> Iterator[ImportFinding]:
    """Streams with another clock than most, and log times next to header times of another clock."""
    skews = {line: float(np.median(line.skews_ns)) / NS for line in lines if len(line.skews_ns)}
    if not skews:
        return
    usual = float(np.median(list(skews.values())))
    if _have_another_epoch(lines):
        text = (
            f"all headers are {abs(usual) / _YEAR_S:.1f} years {'behind' if usual > 0 else 'ahead of'} the times of "
            "recording, and rows follow them: simulated time, or a clock that was never set"
        )
        yield ImportFinding(kind=NOTE, stream="", text=text)
    for line, skew in skews.items():
        if abs(skew - usual) > SKEW_S:
            yield _of(line, "clock_offset", f"its clock is off by {usual - skew:+.3f} s against the other streams")
    used = [skews[line] for line in lines if line.is_header]
    if not used or abs(usual := float(np.median(used))) <= SKEW_S:
        return
    text = f'is on times of recording, {usual:+.3f} s from the headers of the other streams: set clock.stamp = "log"'
    for line in (line for line in lines if not line.is_header):
        yield _of(line, "clock_offset", text)


def _extent_findings(lines: Sequence[Timeline]) -> Iterator[ImportFinding]:
    """Streams that begin later or end earlier than most."""
    regular = [line for line in lines if line.is_regular]
    begin = float(np.median([line.times_ns[0] for line in regular] or [0]))
    end = float(np.median([line.times_ns[-1] for line in regular] or [0]))
    for line in regular:
        late, early = (line.times_ns[0] - begin) / NS, (end - line.times_ns[-1]) / NS
        if late > _SHORTER_S:
            yield _of(line, "late_start", f"begins {late:.2f} s late")
        if early > _SHORTER_S:
            yield _of(line, "early_end", f"ends {early:.2f} s early")


def _still_findings(lines: Sequence[Timeline]) -> Iterator[ImportFinding]:
    """A robot without any motion in the whole bag: a rehearsal, a stopped controller, or another robot's topics."""
    measured = [line for line in lines if line.stream.names and len(line.times_ns) > 1]
    if measured and not any(_moves(line) for line in measured):
        text = f"nothing moves: no number of {', '.join(line.stream.label for line in measured)} changes in this bag"
        yield ImportFinding(kind="still", stream="", text=text)


def _moves(line: Timeline) -> bool:
    values = line.stream.values.astype(np.float64)
    values = values[np.isfinite(values).all(axis=1)]
    if len(values) < 2:
        return False
    noise = _MAX_ENCODER_NOISE * np.maximum(np.abs(values).max(axis=0), 1.0)
    return bool((np.ptp(values, axis=0) > noise).any())


def row_findings(lines: Timelines, rows: EpisodeRows) -> Iterator[ImportFinding]:
    """Findings about the rows of a bag's episode."""
    fps, times_ns = lines.mapping.clock.fps, rows.table.time_ns
    steps = np.diff(times_ns)
    if rows.follows and len(steps):
        rate = NS / float(steps[steps <= _LOST * np.median(steps)].mean())
        if abs(rate - fps) > RATE * fps:
            text = f"rows follow its messages, {rate:.1f} a second, but fps is {fps}"
            yield ImportFinding(kind="fps", stream=rows.follows, text=text)
    for line in lines.lines.values():
        if line.stream.heads:
            yield from _use_findings(line, times_ns, fps, rows.follows)


def _use_findings(line: Timeline, rows_ns: Int, fps: int, follows: str) -> Iterator[ImportFinding]:
    """Rows that repeat an image, and images in no row, if other rows would lose fewer."""
    index = line.chosen(rows_ns).index
    steps = np.diff(index)
    num_images = int(np.ptp(index)) + 1
    num_skipped = int(np.maximum(steps - 1, 0).sum())
    # A row may repeat an image if the next one is lost, or at the stream's end, or once at the episode's edge.
    again = index[1:][steps == 0]
    num_repeated = len(again)
    again = again[again < len(line.times_ns) - 1]
    waits = line.times_ns[again + 1] - line.times_ns[again]
    num_free = max(0, int(np.sum(waits <= _LOST * line.period_ns)) - 1)
    rate = NS / max(line.period_ns, 1)
    repeats = f"{100 * num_repeated / len(index):.3g} % of the rows repeat its image"
    skips = f"{100 * num_skipped / num_images:.3g} % of its images are in no row"
    advice = f"use fps = {max(1, round(rate))}"
    if num_free and num_skipped:
        is_other_rate = abs(rate - fps) > max(RATE * fps, 0.5)
        uneven = "they come too unevenly for these rows"
        yield _of(line, "repeats", f"{repeats} and {skips}: {advice if is_other_rate else uneven}")
    elif follows:
        return  # the images of a camera that has another rate than the one that rows follow
    elif num_free > RATE * len(index):
        yield _of(line, "repeats", f"{repeats}: {advice}")
    elif num_skipped > RATE * num_images and abs(rate / fps - round(rate / fps)) > RATE:
        yield _of(line, "skips", f"{skips}: {advice}")  # taking every second image can be intended
