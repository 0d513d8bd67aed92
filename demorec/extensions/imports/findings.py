"""Findings about a stream of a bag: lost, repeated and late messages, clocks, images, with a name for each kind.

The limits give no findings for sensors with ordinary jitter and latency, or for robots that rest for a while. Nothing
is repaired: a finding describes the data in the rows.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from demorec.extensions.imports.clock import NS, SKEW_S, Int, Numbers, Timeline, without_log_time
from demorec.extensions.imports.streams import NO_STAMP, Stream

_JITTER = 0.25
"""Maximum deviation of nine in ten sensor steps, as a ratio of the period."""
GAP = 5.0
"""Minimum periods without a message for a gap; shorter ones are lost messages."""
_STEP_S = 0.05
"""Minimum jump or drift of a clock in a bag that is reported."""
STILL_S = 0.5
"""Minimum time by which a stream must begin later or end earlier than others; no camera repeats an image for
that long.
"""
FROZEN = 5
"""Minimum images in a row with the same bytes: no real camera is free of noise."""
_EARLY_S = 0.05
"""Maximum time by which a header may be later than its log time: clocks set by NTP differ by less."""
LOST = 1.6
"""Minimum step in periods that implies a lost message."""
NOTE = "note"
"""Kind of an observation that is not a problem."""


@dataclass(frozen=True, kw_only=True)
class ImportFinding:
    """A finding or note.

    Attributes:
        kind: Kind, one word of a fixed list.
        stream: Stream ("observation.state", "camera front"), "" for the whole bag.
        text: Description with figures.
    """

    kind: str
    stream: str
    text: str


def stream_findings(line: Timeline, skew: Numbers) -> Iterator[ImportFinding]:
    """Findings about a stream; (K,) its skews relative to the others."""
    found = (*_message_findings(line), *_time_findings(line), *_clock_findings(skew), *_image_findings(line))
    for kind, text in found:
        yield of_stream(line.stream, kind, text)


def of_stream(stream: Stream, kind: str, text: str) -> ImportFinding:
    """Create a finding about a stream."""
    return ImportFinding(kind=kind, stream=stream.label, text=f"{stream.topic}: {text}")


def _message_findings(line: Timeline) -> Iterator[tuple[str, str]]:
    stream = line.stream
    if stream.num_malformed:
        yield "malformed", f"{stream.num_malformed} messages cannot be used, the first since {stream.first_problem}"
    if not line.is_header and (untimed := int(without_log_time(stream.log_ns).sum())):
        yield "unstamped", f"{untimed} of {len(stream)} messages have no log time and are left out"
    unstamped = int(np.sum((stream.header_ns <= 0) & (stream.header_ns != NO_STAMP)))
    if unstamped and not line.is_log_asked:
        yield "unstamped", f"{unstamped} of {len(stream)} headers have no time"


def _time_findings(line: Timeline) -> Iterator[tuple[str, str]]:
    late = int(np.sum(np.diff(line.stream.log_ns) < 0))
    is_known = line.stamps_ns > 0
    known = line.stamps_ns[is_known]
    backwards = int(np.sum(np.diff(known) < 0))
    if late or backwards:
        yield "order", f"{max(late, backwards)} messages come before earlier ones"
    if repeated := line.num_repeated:
        checksums = np.asarray(line.stream.sums)[is_known].astype(np.int64)
        same = int(np.sum((np.diff(known) == 0) & (np.diff(checksums) == 0)))
        yield "duplicates", f"{repeated} messages have the time of another one, {same} of them the same bytes as well"
    if not line.is_regular:
        return
    steps = np.diff(line.times_ns)
    gaps = np.flatnonzero(steps > GAP * line.period_ns)
    lost = lost_in(line)
    small = np.flatnonzero((lost > 0) & (steps <= GAP * line.period_ns))
    if len(gaps):
        longest = int(steps[gaps].max())
        begin = (line.times_ns[gaps[0]] - line.times_ns[0]) / NS
        yield "gap", f"{len(gaps)} gaps, the first at {begin:.2f} s, the longest of {longest / NS:.3f} s"
    if len(small):
        yield "drops", f"{int(lost[small].sum())} of {len(line.times_ns) + int(lost[small].sum())} messages are lost"
    off = _unevenness(line)
    if off > _JITTER * line.period_ns:
        yield "jitter", f"its steps of {line.period_ns / 1e6:.1f} ms are off by {off / 1e6:.1f} ms (one of ten by more)"


def _unevenness(line: Timeline) -> float:
    """Maximum deviation of nine in ten steps of a stream from its period, nanoseconds."""
    steps = np.diff(line.times_ns)
    regular = steps[steps <= LOST * line.period_ns]
    return float(np.percentile(np.abs(regular - line.period_ns), 90)) if len(regular) else 0.0


def lost_in(line: Timeline) -> Int:
    """(M - 1,) number of lost messages between each two of a regular stream.

    If its steps are uneven, a long one is not a loss: nine in ten are within 1.6 deviations, nearly all within 4.
    """
    steps = np.diff(line.times_ns)
    least = max(LOST * line.period_ns, line.period_ns + 4 / 1.6 * _unevenness(line))
    return np.where(steps > least, np.round(steps / line.period_ns).astype(np.int64) - 1, 0)


def _clock_findings(skew: Numbers) -> Iterator[tuple[str, str]]:
    """Findings about the difference between log times and header times."""
    if len(skew) < 8:
        return
    median = float(np.median(skew)) / NS
    if median > SKEW_S:
        yield "clock_offset", f"its headers are {median:.3f} s behind the times of recording"
    elif median < -_EARLY_S:
        yield "clock_offset", f"its headers are {-median:.3f} s later than the times of recording"
    width = max(3, min(20, len(skew) // 4))
    smooth = np.array([np.median(part) for part in np.array_split(skew, max(2, len(skew) // width))]) / NS
    # A jump in the middle of a part is split between the steps before and after it.
    steps = np.diff(smooth)
    pairs = steps[:-1] + steps[1:] if len(steps) > 1 else steps
    largest = int(np.argmax(np.abs(pairs)))
    step = float(pairs[largest])
    rest = np.delete(steps, [largest, min(largest + 1, len(steps) - 1)])
    total = float(smooth[-1] - smooth[0])
    if abs(step) > _STEP_S and abs(step) > 5 * (np.abs(rest).max(initial=0.0) + 1e-4):
        yield "clock_jump", f"its clock jumps by {-step:+.3f} s"
    elif abs(total) > _STEP_S and abs(total) > 0.7 * np.abs(np.diff(smooth)).sum():
        yield "clock_drift", f"its clock drifts by {-total:+.3f} s in the bag"


def frozen_images(line: Timeline) -> tuple[int, int] | None:
    """First and last index of consecutive images with the same bytes, for a camera without shorter repetitions."""
    if not line.stream.heads:
        return None
    sums = np.asarray(line.stream.image_sums)[line.order].astype(np.int64)
    edges = np.concatenate(([0], np.flatnonzero(np.diff(sums) != 0) + 1, [len(sums)]))
    runs = np.diff(edges)
    longest = int(np.argmax(runs))
    # a rendered camera repeats its image whenever everything rests
    has_noise = not ((runs > 1) & (runs < FROZEN)).any()
    is_frozen = runs[longest] >= FROZEN and has_noise
    return (int(edges[longest]), int(edges[longest + 1]) - 1) if is_frozen else None


def _image_findings(line: Timeline) -> Iterator[tuple[str, str]]:
    stream = line.stream
    if not stream.heads:
        return
    formats = {(head.format, head.encoding) for head in stream.heads.kinds()}
    if len(formats) > 1:
        kinds = ", ".join(sorted(f"{name} {encoding}".strip() for name, encoding in formats))
        yield "format", f"its images are of several kinds ({kinds})"
    sizes = {(head.width, head.height) for head in stream.heads.kinds() if head.width}
    if len(sizes) > 1:
        yield "size", f"its images change their size ({', '.join(f'{w}x{h}' for w, h in sorted(sizes))})"
    if stream.heads[0].format in ("h264", "h265", "av1") and not stream.heads[0].is_keyframe:
        keyframes = np.flatnonzero(stream.heads.are_keyframes)
        first = int(keyframes[0]) if len(keyframes) else len(stream.heads)
        yield "keyframe", f"its first {first} images cannot be decoded, since no keyframe is before them"
