"""Findings about a bag that compare its streams, and about the rows made from it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from demorec.core.geometry import signs_of_course
from demorec.episode.features import ACTION
from demorec.extensions.imports.bag import EPOCH_S
from demorec.extensions.imports.clock import NS, SKEW_S, Numbers, Timeline
from demorec.extensions.imports.findings import (
    GAP,
    LOST,
    NOTE,
    STILL_S,
    ImportFinding,
    frozen_images,
    of_stream,
    stream_findings,
)
from demorec.extensions.imports.rows import RATE, EpisodeRows, Timelines

_YEAR_S = 365.25 * 86_400
_RESTS = 0.02
"""Maximum range of a resting robot's elements, relative to their whole range."""
MAX_ENCODER_NOISE = 1e-3
"""Maximum range of a resting joint: radians or metres, or the same ratio of larger values in degrees or counts."""
_SLOW = 1.15
"""Minimum ratio of a stream's period to the rows' period for a slow stream."""


def all_findings(lines: Timelines) -> tuple[ImportFinding, ...]:
    """All findings about a bag, each once."""
    once: dict[tuple[str, str], ImportFinding] = {}
    for finding in _findings(lines):
        once.setdefault((finding.kind, finding.text.partition(":")[0] if finding.stream else finding.text), finding)
    return tuple(once.values())


def _findings(bag: Timelines) -> Iterator[ImportFinding]:
    lines = list(bag.lines.values())
    regular = [line for line in lines if line.is_regular]
    skews = _comparable_skews(lines)
    for line in lines:
        yield from stream_findings(line, skews[line])
    for problem in bag.streams.problems:
        yield ImportFinding(kind="cut_off", stream="", text=problem)
    yield from _joint_findings(regular)
    yield from _extent_findings(regular)
    yield from _offset_findings(lines)
    yield from _epoch_findings(lines)
    yield from _mixed_findings(bag, lines)
    yield from _frozen_findings(lines)
    yield from _still_findings(lines)
    yield from _slow_findings(regular, bag.mapping.clock.fps)


def _comparable_skews(lines: Sequence[Timeline]) -> dict[Timeline, Numbers]:
    """(K,) skews of each stream: log time minus header time, nanoseconds.

    If all headers have another epoch than the log times (simulated time), the absolute difference implies nothing about
    a stream: the result is then relative to the stream with most messages.
    """
    skews: dict[Timeline, Numbers] = {line: line.skews_ns.astype(np.float64) for line in lines}
    known = _of_another_epoch(lines)
    if not known:
        return skews
    usual = max(known, key=lambda line: len(line.skews_ns))
    stamps = usual.stream.header_ns[usual.stream.header_ns > 0]
    order = np.argsort(stamps, kind="stable")
    for line in known:
        own = line.stream.header_ns[line.stream.header_ns > 0]
        skews[line] = line.skews_ns - np.interp(own, stamps[order], usual.skews_ns[order])
    return skews


def _of_another_epoch(lines: Sequence[Timeline]) -> list[Timeline]:
    """Return the streams with header times if all of these have another epoch than the log times."""
    known = [line for line in lines if len(line.skews_ns)]
    return known if all(abs(np.median(line.skews_ns)) >= EPOCH_S * NS for line in known) else []


def _epoch_findings(lines: Sequence[Timeline]) -> Iterator[ImportFinding]:
    """Header times of a simulated or unset clock that the rows use."""
    known = [line for line in _of_another_epoch(lines) if line.is_header]
    if known:
        years = float(np.median([np.median(line.skews_ns) for line in known])) / NS / _YEAR_S
        text = (
            f"all headers are {abs(years):.1f} years {'behind' if years > 0 else 'ahead of'} the times of recording, "
            "and rows follow them: simulated time, or a clock that was never set"
        )
        yield ImportFinding(kind=NOTE, stream="", text=text)


def _mixed_findings(bag: Timelines, lines: Sequence[Timeline]) -> Iterator[ImportFinding]:
    """Streams on log time, although others use header times with another epoch."""
    skews = [float(np.median(line.skews_ns)) / NS for line in lines if line.is_header]
    if not skews or abs(usual := float(np.median(skews))) <= SKEW_S:
        return
    text = f'is on times of recording, {usual:+.3f} s from the headers of the other streams: set clock.stamp = "log"'
    for line in (line for line in lines if not line.is_header):
        yield of_stream(line.stream, "clock_offset", text)
    for topic, texts in bag.streams.texts.items():
        if topic != bag.mapping.robot.urdf_topic and not all(each.is_header for each in texts):
            yield ImportFinding(kind="clock_offset", stream=topic, text=f"{topic}: {text}")


def _joint_findings(regular: Sequence[Timeline]) -> Iterator[ImportFinding]:
    """Joints that end while others of their topic, or the same ones from another publisher, continue."""
    for line in regular:
        joints = line.stream.reader.joints if line.stream.reader else ()
        key = (line.stream.topic, line.is_header)
        others = [other for other in regular if (other.stream.topic, other.is_header) == key]
        early = max(int(other.times_ns[-1]) for other in others) - int(line.times_ns[-1])
        if joints and early > GAP * line.period_ns:
            names = f"{joints[0]!r}" + (f" and {len(joints) - 1} more joints" if len(joints) > 1 else "")
            text = f"{names} stop {early / NS:.2f} s before other joints of the topic"
            yield of_stream(line.stream, "early_end", text)


def _extent_findings(regular: Sequence[Timeline]) -> Iterator[ImportFinding]:
    if len(regular) < 2:
        return
    begin = float(np.median([line.times_ns[0] for line in regular]))
    end = float(np.median([line.times_ns[-1] for line in regular]))
    for line in regular:
        late, early = (line.times_ns[0] - begin) / NS, (end - line.times_ns[-1]) / NS
        if late > STILL_S:
            yield of_stream(line.stream, "late_start", f"begins {late:.2f} s late")
        if early > STILL_S:
            yield of_stream(line.stream, "early_end", f"ends {early:.2f} s early")


def _offset_findings(lines: Sequence[Timeline]) -> Iterator[ImportFinding]:
    """Streams with another header clock than most."""
    skews = {line.stream.label: float(np.median(line.skews_ns)) / NS for line in lines if len(line.skews_ns)}
    if len(skews) < 2:
        return
    usual = float(np.median(list(skews.values())))
    for label, skew in skews.items():
        if abs(skew - usual) > SKEW_S:
            text = f"its clock is off by {usual - skew:+.3f} s against that of the other streams"
            yield ImportFinding(kind="clock_offset", stream=label, text=text)


def _frozen_findings(lines: Sequence[Timeline]) -> Iterator[ImportFinding]:
    """Cameras that froze. A rendered camera repeats its image while the robot rests for a moment."""
    for line in lines:
        if (run := frozen_images(line)) is None:
            continue
        begin_ns, end_ns = (int(line.times_ns[index]) for index in run)
        if (end_ns - begin_ns) / NS >= STILL_S or not _rests(lines, begin_ns, end_ns):
            at = (begin_ns - line.times_ns[0]) / NS
            text = f"{run[1] - run[0] + 1} images from {at:.2f} s on have the very same bytes"
            yield of_stream(line.stream, "frozen", text)


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
    noise = MAX_ENCODER_NOISE * np.maximum(np.abs(values).max(axis=0), 1.0)
    return bool((np.ptp(values, axis=0) > noise).any())


def _rests(lines: Sequence[Timeline], begin_ns: int, end_ns: int) -> bool:
    """Whether all measured elements of the robot rest in an interval; False if nothing is measured."""
    moves = []
    for line in lines:
        if not line.stream.names or line.stream.label.partition(" (")[0] == ACTION:
            continue
        values = line.stream.values
        within = values[line.order[(line.times_ns >= begin_ns) & (line.times_ns <= end_ns)]].astype(np.float64)
        if len(within) < 2:
            continue
        for start in line.stream.quaternions:
            within[:, start : start + 4] *= signs_of_course(within[:, start : start + 4])[:, None]
        whole = np.linalg.norm(np.ptp(np.nan_to_num(values), axis=0))
        moves.append(not np.linalg.norm(np.ptp(within, axis=0)) <= _RESTS * whole)  # also true for NaN
    return bool(moves) and not any(moves)


def _slow_findings(regular: Sequence[Timeline], fps: int) -> Iterator[ImportFinding]:
    """Streams slower than the rows: a note for numbers, which are held; cameras if none has enough images."""
    slow = [line for line in regular if line.period_ns * fps > _SLOW * NS]
    is_filmed = any(line.stream.heads and line not in slow for line in regular)
    for line in slow:
        rate = NS / line.period_ns
        text = f"comes {rate:.1f} times a second, rows {fps} times"
        if not line.stream.heads:
            yield of_stream(line.stream, NOTE, text)
        elif not is_filmed:
            yield of_stream(line.stream, "slow", f"{text}: use fps = {max(1, round(rate))}")


def row_findings(lines: Timelines, episodes: Sequence[EpisodeRows]) -> Iterator[ImportFinding]:
    """Findings about the rows of a bag's episodes, each once."""
    fps = lines.mapping.clock.fps
    for rows in (rows for rows in episodes if rows.follows and len(rows.table.time_ns) > 1):
        steps = np.diff(rows.table.time_ns)
        rate = NS / float(steps[steps <= LOST * np.median(steps)].mean())
        if abs(rate - fps) > RATE * fps:
            text = f"rows follow its messages, {rate:.1f} a second, but fps is {fps}"
            yield ImportFinding(kind="fps", stream=rows.follows, text=text)
            break
    for name in lines.mapping.cameras if episodes else ():
        yield from _use_findings(name, lines, episodes)
    if episodes and not lines.mapping.cameras:
        yield from _skip_notes(lines, episodes)


def _skip_notes(lines: Timelines, episodes: Sequence[EpisodeRows]) -> Iterator[ImportFinding]:
    """Streams of numbers with many messages in no row; cameras, if any, decide the rows."""
    for line in (line for line in lines.lines.values() if line.stream.names and line.is_regular):
        num_unused = num_messages = 0
        for rows in episodes:
            chosen = line.chosen(rows.table.time_ns)
            num_unused += chosen.num_unused
            num_messages += int(np.ptp(chosen.index)) + 1
        if num_unused > RATE * num_messages:
            share = 100 * num_unused / num_messages
            text = (
                f"{share:.3g} % of its messages are in no row, since it comes {NS / line.period_ns:.1f} times a second "
                f"and rows {lines.mapping.clock.fps} times"
            )
            yield of_stream(line.stream, NOTE, text)


def _use_findings(name: str, lines: Timelines, episodes: Sequence[EpisodeRows]) -> Iterator[ImportFinding]:
    """Use of a camera's images: a finding if other rows could show more of them, else a note."""
    line, clock = lines.lines[name], lines.mapping.clock
    num_repeated = num_free = num_skipped = num_images = 0
    for rows in episodes:
        shown = line.chosen(rows.table.time_ns).index
        steps = np.diff(shown)
        repeated = shown[1:][steps == 0]
        num_repeated += len(repeated)
        # Except rows with a missing image or at the stream's end; an episode may also begin between two images.
        repeated = repeated[repeated < len(line.times_ns) - 1]
        waits = line.times_ns[repeated + 1] - line.times_ns[repeated]
        num_free += max(0, int(np.sum(waits <= LOST * line.period_ns)) - 1)
        num_skipped += int(np.maximum(steps - 1, 0).sum())
        num_images += int(shown[-1] - shown[0]) + 1
    num_rows = sum(len(rows.table.time_ns) for rows in episodes)
    rate = NS / max(line.period_ns, 1)
    repeats = f"{100 * num_repeated / num_rows:.3g} % of the rows show the image before"
    skips = f"{100 * num_skipped / num_images:.3g} % of its images are in no row"
    if min(num_free, num_skipped):  # one row repeats while another skips, so other rows would lose nothing
        advice = 'use rows = "camera"'
        if abs(rate - clock.fps) > max(RATE * clock.fps, 0.5):
            advice = f"use fps = {max(1, round(rate))}"
        elif clock.rows == "camera":
            advice = "they come too unevenly for these rows"
        yield of_stream(line.stream, "repeats", f"{repeats} and {skips}: {advice}")
    elif max(num_free / num_rows, num_skipped / num_images) > RATE:
        text = f"{repeats if num_free else skips}, since it comes {rate:.1f} times a second and rows {clock.fps} times"
        # Taking every second image can be intended; an irregular step is only justified by a slower camera.
        is_uneven = abs(rate / clock.fps - round(rate / clock.fps)) > RATE
        if num_skipped and is_uneven and not any(rows.follows for rows in episodes):
            yield of_stream(line.stream, "skips", f"{text}: use fps = {max(1, round(rate))}")
        else:
            yield of_stream(line.stream, NOTE, text)
    elif num_skipped and (follows := next((rows.follows for rows in episodes if rows.follows), "")):
        yield of_stream(line.stream, NOTE, f"{skips}: rows follow {follows}")
