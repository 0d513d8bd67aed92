"""What is odd in a stream of a bag, found from times, numbers and image heads alone, with names for each kind.

The limits are such that sensors with ordinary jitter and latency, and robots that stand still for a while, give none.
Nothing is repaired: a finding tells what the rows hold.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from demorec.core.geometry import signs_of_course
from demorec.episode.features import ACTION
from demorec.sources.clock import NS, SKEW_S, Int, Numbers, Timeline
from demorec.sources.streams import NO_STAMP, Stream

_JITTER = 0.25
"""Of a period: what nine of ten steps of a sensor stay within."""
GAP = 5.0
"""Periods without a message that are reported as a gap; shorter ones are lost messages."""
_STEP_S = 0.05
"""By which a clock must jump, or drift in a bag, to be reported."""
STILL_S = 0.5
"""For which a sensor with noise never gives the same number."""
FROZEN = 5
"""Images in a row with the same bytes: no camera without noise."""
_SPIKE = 25.0
"""Times the usual step of an element."""
_LEAST_JUMP = 1e-4
"""rad, m: what no sensor tells from noise."""
_AS_FAST = 1.5
"""Times the largest step of what goes on."""
_GOES_ON = 0.1
"""Share of a step that the next one, or the one before, has in the same direction where something moves."""
_NOISE = 5.0
"""Times the usual step of an element that rests, beyond which it moves."""
_EARLY_S = 0.05
"""By which a header may be later than its recording, in which it was no more: clocks that NTP sets differ by less."""
LOST = 1.6
"""Periods, from which on a message is missing between two."""
NOTE = "note"
"""Kind of what is not odd, but good to know."""


@dataclass(frozen=True, kw_only=True)
class Finding:
    """Something odd.

    Attributes:
        kind: What, in one word of a fixed list.
        stream: Which ("observation.state", "camera front"), "" for the bag as a whole.
        text: What was found, with figures.
    """

    kind: str
    stream: str
    text: str


def stream_findings(line: Timeline, skew: Numbers) -> Iterator[Finding]:
    """What is odd in a stream; (K,) its skews, as they compare with those of the others."""
    found = (*_message_findings(line), *_time_findings(line), *_clock_findings(skew))
    for kind, text in (*found, *_image_findings(line), *_value_findings(line)):
        yield of_stream(line.stream, kind, text)


def of_stream(stream: Stream, kind: str, text: str) -> Finding:
    """A finding of a stream."""
    return Finding(kind=kind, stream=stream.label, text=f"{stream.topic}: {text}")


def _message_findings(line: Timeline) -> Iterator[tuple[str, str]]:
    stream = line.stream
    if stream.num_malformed:
        yield "malformed", f"{stream.num_malformed} messages cannot be used, the first since {stream.first_problem}"
    unstamped = int(np.sum((stream.header_ns <= 0) & (stream.header_ns != NO_STAMP)))
    if unstamped and not line.is_log_asked:
        yield "unstamped", f"{unstamped} of {len(stream)} headers have no time"
    if len(stream.frame_ids) > 1:
        yield "frame_id", f"its messages name several coordinate frames ({', '.join(stream.frame_ids[:4])})"


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
    """What nine of ten steps of a stream are off its period by at most, nanoseconds."""
    steps = np.diff(line.times_ns)
    regular = steps[steps <= LOST * line.period_ns]
    return float(np.percentile(np.abs(regular - line.period_ns), 90)) if len(regular) else 0.0


def lost_in(line: Timeline) -> Int:
    """(M - 1,) how many messages of a regular stream are missing between each two.

    Where its steps are uneven, a long one is no loss: nine of ten are within 1.6 deviations, nearly all within 4.
    """
    steps = np.diff(line.times_ns)
    least = max(LOST * line.period_ns, line.period_ns + 4 / 1.6 * _unevenness(line))
    return np.where(steps > least, np.round(steps / line.period_ns).astype(np.int64) - 1, 0)


def _clock_findings(skew: Numbers) -> Iterator[tuple[str, str]]:
    """Of the difference between the times of recording and of headers."""
    if len(skew) < 8:
        return
    median = float(np.median(skew)) / NS
    if median > SKEW_S:
        yield "clock_offset", f"its headers are {median:.3f} s behind the times of recording"
    elif median < -_EARLY_S:
        yield "clock_offset", f"its headers are {-median:.3f} s later than the times of recording"
    width = max(3, min(20, len(skew) // 4))
    smooth = np.array([np.median(part) for part in np.array_split(skew, max(2, len(skew) // width))]) / NS
    # A jump in the middle of a part is half in the step to it and half in the one from it.
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


def _value_findings(line: Timeline) -> Iterator[tuple[str, str]]:
    stream = line.stream
    if not stream.names or len(line.order) < 2:
        return
    yield from _number_findings(line)
    for start in stream.quaternions:
        off = float(np.abs(np.linalg.norm(_quaternion(line, start), axis=1) - 1).max())
        if off > 1e-3:
            yield "quaternion", f"the length of a quaternion is off by {off:.3g}"
    if len(stream.names) > 1 and not any(_finite(line, column).any() for column in range(len(stream.names))):
        yield "zeros", "all numbers are 0"
        return
    # What is sent may hold until the bag ends.
    yield from _still_findings(line, may_rest=stream.label == ACTION)
    for name, change in _changes(line):
        steps = np.linalg.norm(change, axis=1)
        usual = float(np.percentile(steps, 90))
        # What begins to move after a long rest goes on, as an opening gripper does. At a low rate a shorter way takes
        # one step, but no larger one than those of the longer.
        beside, least = (change[1:] * change[:-1]).sum(axis=1), _GOES_ON * steps**2
        goes_on = np.append(beside > least[:-1], False) | np.insert(beside > least[1:], 0, False)
        limit = max(_SPIKE * usual, _LEAST_JUMP, _AS_FAST * float(steps[goes_on].max(initial=0.0)))
        # Fingers at rest that shut on something within a message go on a little, and rest.
        rests, settles = steps <= _NOISE * usual, np.zeros(len(steps), dtype=np.bool_)
        settles[1:-2] = rests[:-3] & (beside[1:-1] > _NOISE * usual * steps[1:-2]) & rests[3:]
        steps[goes_on | settles] = 0.0
        largest = int(steps.argmax())
        if usual > 0 and steps[largest] > limit:
            at = (line.times_ns[largest + 1] - line.times_ns[0]) / NS
            yield "jump", f"{name!r} jumps by {steps[largest]:.3g} at {at:.2f} s, usual are {usual:.2g}"
            break


def _changes(line: Timeline) -> Iterator[tuple[str, NDArray[np.float64]]]:
    """(T - 1, n) from each message to the next, of every element and of every rotation as a whole."""
    quaternions = line.stream.quaternions
    turns = {start + part for start in quaternions for part in range(4)}
    for column, name in enumerate(line.stream.names):
        if column in quaternions:
            quaternion = _quaternion(line, column)
            yield name, np.diff(quaternion * signs_of_course(quaternion)[:, None], axis=0)
        elif column not in turns:
            yield name, np.diff(_finite(line, column))[:, None]


def _finite(line: Timeline, columns: int | slice) -> NDArray[np.float64]:
    """(T,) of an element, or (T, n) of some, in the order of the times; 0 in place of what is no finite number.

    One at a time: all at once take several times the stream's memory.
    """
    part = line.stream.values[line.order, columns].astype(np.float64)
    return np.nan_to_num(part, nan=0.0, posinf=0.0, neginf=0.0)


def _quaternion(line: Timeline, start: int) -> NDArray[np.float64]:
    """(T, 4) of the elements from one on."""
    return _finite(line, slice(start, start + 4))


def _number_findings(line: Timeline) -> Iterator[tuple[str, str]]:
    """Numbers that are none."""
    are_finite = np.asarray(np.isfinite(line.stream.values).all(axis=1))
    rows = line.stream.values[line.order[~are_finite[line.order]]]
    if len(rows):
        column = int(np.flatnonzero(~np.isfinite(rows[0]))[0])
        kind = "nan" if np.isnan(rows).any() else "infinite"
        yield kind, f"{len(rows)} messages hold no finite number, the first in {line.stream.names[column]!r}"


def _still_findings(line: Timeline, *, may_rest: bool) -> Iterator[tuple[str, str]]:
    """Elements with noise that suddenly have none; those that `may_rest` do so in the end, and at a joint's limit."""
    stuck = []
    for column, name in enumerate(line.stream.names):
        element = _finite(line, column)
        begin, end = _longest_run(element)
        seconds = (line.times_ns[end] - line.times_ns[begin]) / NS
        others = np.concatenate((element[:begin], element[end + 1 :]))
        rests = may_rest and (end == len(element) - 1 or element[begin] in (element.min(), element.max()))
        if seconds < STILL_S or end - begin < 10 or len(others) < 10 or rests:
            continue
        if np.mean(np.diff(others) != 0) > 0.8:
            stuck.append((name, seconds, (line.times_ns[begin] - line.times_ns[0]) / NS))
    waits = may_rest and len(stuck) >= max(len(line.stream.names) - 1, 2)  # an arm, while its gripper moves
    if stuck and not waits:
        name, seconds, at = stuck[0]
        more = f" and {len(stuck) - 1} more elements" if len(stuck) > 1 else ""
        yield "stuck", f"{name!r}{more} gives the very same number for {seconds:.2f} s from {at:.2f} s on"


def _longest_run(numbers: NDArray[Any]) -> tuple[int, int]:
    """First and last index of the longest run of equal numbers."""
    edges = _run_edges(numbers)
    longest = int(np.argmax(np.diff(edges)))
    return int(edges[longest]), int(edges[longest + 1]) - 1


def frozen_images(line: Timeline) -> tuple[int, int] | None:
    """First and last index of images in a row with the very same bytes, of a camera that repeats none for less."""
    if not line.stream.heads:
        return None
    sums = np.asarray(line.stream.image_sums)[line.order].astype(np.int64)
    begin, end = _longest_run(sums)
    runs = np.diff(_run_edges(sums))
    has_noise = not ((runs > 1) & (runs < FROZEN)).any()  # a drawn camera gives the same again wherever all rests
    return (begin, end) if end - begin + 1 >= FROZEN and has_noise else None


def _run_edges(numbers: NDArray[Any]) -> Int:
    """First index of each run of equal numbers, and their count."""
    return np.concatenate(([0], np.flatnonzero(np.diff(numbers) != 0) + 1, [len(numbers)]))


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
