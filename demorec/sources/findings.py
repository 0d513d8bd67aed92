"""What is odd in a bag's streams, found from times, numbers and image heads alone, with names for each kind.

The limits are such that sensors with ordinary jitter and latency, and robots that stand still for a while, give none.
Nothing is repaired: a finding tells what the rows hold.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from demorec.episode.external import DEPTH_UNITS
from demorec.sources.clock import NS, SKEW_S, Int, Numbers, Timeline
from demorec.sources.fields import frame_id_of
from demorec.sources.mapping import ACTION, STATE, SourceMapping
from demorec.sources.rows import Timelines
from demorec.sources.streams import NO_STAMP, BagStreams, Stream

_JITTER = 0.25
"""Of a period: what nine of ten steps of a sensor stay within."""
_GAP = 5.0
"""Periods without a message that are told as a gap; shorter ones are lost messages."""
_STEP_S = 0.05
"""By which a clock must jump, or drift in a bag, to be told."""
_STILL_S = 0.5
"""For which a sensor with noise never gives the same number."""
_FROZEN = 5
"""Images in a row with the same bytes: no camera without noise."""
_SPIKE = 25.0
"""Times the usual step of an element."""
_EPOCH_S = 1e8
"""Between two clocks: three years. No clock is as wrong; one of the two counts from another beginning."""
_SLOW = 1.15
"""Periods of the rows, from which on a stream is called slower than they are."""
_EARLY_S = 0.05
"""By which a header may be later than its recording, in which it was no more: clocks that NTP sets differ by less."""
_DEGREES = (40.0, 80.0)
"""Times the range of the same joints, of which one is in degrees: 57, and a leader does not reach as far as its arm."""
LOST = 1.6
"""Periods, from which on a message is missing between two."""
NOTE = "note"
"""Kind of what is not odd, but good to know."""
_FULL_TURNS = 4 * np.pi
"""Beyond which no joint angle is in rad."""


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


def all_findings(lines: Timelines) -> tuple[Finding, ...]:
    """What is odd in a bag, each thing once."""
    once: dict[tuple[str, str], Finding] = {}
    for finding in _findings(lines, list(lines.lines.values())):
        once.setdefault((finding.kind, finding.text.partition(":")[0] if finding.stream else finding.text), finding)
    return tuple(once.values())


def _findings(bag: Timelines, lines: Sequence[Timeline]) -> Iterator[Finding]:
    skews = _comparable_skews(lines)
    for line in lines:
        found = (*_message_findings(line), *_time_findings(line), *_clock_findings(skews[line]))
        for kind, text in (*found, *_picture_findings(line), *_value_findings(line)):
            yield of_stream(line.stream, kind, text)
    for problem in bag.streams.problems:
        yield Finding(kind="cut_off", stream="", text=problem)
    yield from _joint_findings([line for line in lines if line.is_regular])
    yield from _extent_findings([line for line in lines if line.is_regular])
    yield from _offset_findings(lines)
    yield from _mixed_findings(bag, lines)
    yield from _camera_findings(bag.streams)
    yield from _slow_findings(lines, bag.mapping.clock.fps)
    yield from _unit_findings(bag.streams, bag.mapping)
    yield from _action_findings(bag.streams, bag.mapping)


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
    gaps = np.flatnonzero(steps > _GAP * line.period_ns)
    lost = lost_in(line)
    small = np.flatnonzero((lost > 0) & (steps <= _GAP * line.period_ns))
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


def _comparable_skews(lines: Sequence[Timeline]) -> dict[Timeline, Numbers]:
    """(K,) of each stream: time of recording minus that of the header, nanoseconds.

    Where all headers count from another beginning than times of recording (simulated time), that difference says
    nothing of a single stream: then it is the one to the difference of the stream that has most messages.
    """
    skews: dict[Timeline, Numbers] = {line: line.skews_ns.astype(np.float64) for line in lines}
    known = [line for line in lines if len(line.skews_ns)]
    if not known or any(abs(np.median(line.skews_ns)) < _EPOCH_S * NS for line in known):
        return skews
    usual = max(known, key=lambda line: len(line.skews_ns))
    stamps = usual.stream.header_ns[usual.stream.header_ns > 0]
    order = np.argsort(stamps, kind="stable")
    for line in known:
        own = line.stream.header_ns[line.stream.header_ns > 0]
        skews[line] = line.skews_ns - np.interp(own, stamps[order], usual.skews_ns[order])
    return skews


def _mixed_findings(bag: Timelines, lines: Sequence[Timeline]) -> Iterator[Finding]:
    """What goes by the time of recording where other streams go by headers, and these are of another clock."""
    skews = [float(np.median(line.skews_ns)) / NS for line in lines if line.is_header]
    if not skews or abs(usual := float(np.median(skews))) <= SKEW_S:
        return
    text = f'goes by times of recording, {usual:+.3f} s from the headers of the other streams: set clock.stamp = "log"'
    for line in (line for line in lines if not line.is_header):
        yield of_stream(line.stream, "clock_offset", text)
    for topic, texts in bag.streams.texts.items():
        if topic != bag.mapping.robot.urdf_topic and not all(each.is_header for each in texts):
            yield Finding(kind="clock_offset", stream=topic, text=f"{topic}: {text}")


def _value_findings(line: Timeline) -> Iterator[tuple[str, str]]:
    stream = line.stream
    if stream.values is None or stream.layout is None or len(line.order) < 2:
        return
    elements, names = _Elements(stream.values, line.order), stream.layout.names
    yield from _number_findings(elements, names)
    for start in stream.layout.quaternions:
        off = float(np.abs(np.linalg.norm(elements.quaternion(start), axis=1) - 1).max())
        if off > 1e-3:
            yield "quaternion", f"the length of a quaternion is off by {off:.3g}"
    if len(names) > 1 and not any(np.any(element) for element in elements):
        yield "zeros", "all numbers are 0"
        return
    yield from _still_findings(elements, names, line)
    signs: dict[int, NDArray[np.float64]] = {}
    for start in stream.layout.quaternions:
        signs |= dict.fromkeys(range(start, start + 4), _signs(elements.quaternion(start)))
    for column, (name, element) in enumerate(zip(names, elements, strict=True)):
        steps = np.abs(np.diff(element * signs[column] if column in signs else element))
        usual = float(np.percentile(steps, 90))
        largest = int(steps.argmax())
        if usual > 0 and steps[largest] > _SPIKE * usual:
            at = (line.times_ns[largest + 1] - line.times_ns[0]) / NS
            yield "jump", f"{name!r} jumps by {steps[largest]:.3g} at {at:.2f} s, usual are {usual:.2g}"
            break


class _Elements:
    """A stream's numbers, one element of the vector at a time: all at once take several times the stream's memory.

    What is no finite number is 0 in them.
    """

    def __init__(self, values: Numbers, order: Int) -> None:
        self.values, self.order = values, order

    def __iter__(self) -> Iterator[NDArray[np.float64]]:
        """(T,) of each element, in the order of the times."""
        for column in range(self.values.shape[1]):
            yield self._finite(self.values[self.order, column])

    def quaternion(self, start: int) -> NDArray[np.float64]:
        """(T, 4) of four elements."""
        return self._finite(self.values[self.order, start : start + 4])

    def _finite(self, part: Numbers) -> NDArray[np.float64]:
        return np.nan_to_num(part.astype(np.float64), nan=0.0, posinf=0.0, neginf=0.0)


def _number_findings(elements: _Elements, names: tuple[str, ...]) -> Iterator[tuple[str, str]]:
    """Numbers that are none."""
    are_finite = np.asarray(np.isfinite(elements.values).all(axis=1))
    rows = elements.values[elements.order[~are_finite[elements.order]]]
    if len(rows):
        column = int(np.flatnonzero(~np.isfinite(rows[0]))[0])
        kind = "nan" if np.isnan(rows).any() else "infinite"
        yield kind, f"{len(rows)} messages hold no finite number, the first in {names[column]!r}"


def _signs(quaternions: NDArray[np.float64]) -> NDArray[np.float64]:
    """(T,) by which each of (T, 4) is nearest to the one before: both signs mean the same rotation."""
    flips = np.where((quaternions[1:] * quaternions[:-1]).sum(axis=1) < 0, -1.0, 1.0)
    return np.concatenate(([1.0], np.cumprod(flips)))


def _still_findings(elements: _Elements, names: tuple[str, ...], line: Timeline) -> Iterator[tuple[str, str]]:
    """Elements with noise that suddenly have none."""
    stuck = []
    for name, element in zip(names, elements, strict=True):
        begin, end = _longest_run(element)
        seconds = (line.times_ns[end] - line.times_ns[begin]) / NS
        others = np.concatenate((element[:begin], element[end + 1 :]))
        if seconds < _STILL_S or end - begin < 10 or len(others) < 10:
            continue
        if np.mean(np.diff(others) != 0) > 0.8:
            stuck.append((name, seconds, (line.times_ns[begin] - line.times_ns[0]) / NS))
    if stuck:
        name, seconds, at = stuck[0]
        more = f" and {len(stuck) - 1} more elements" if len(stuck) > 1 else ""
        yield "stuck", f"{name!r}{more} gives the very same number for {seconds:.2f} s from {at:.2f} s on"


def _longest_run(numbers: NDArray[Any]) -> tuple[int, int]:
    """First and last index of the longest run of equal numbers."""
    edges = np.concatenate(([0], np.flatnonzero(np.diff(numbers) != 0) + 1, [len(numbers)]))
    longest = int(np.argmax(np.diff(edges)))
    return int(edges[longest]), int(edges[longest + 1]) - 1


def _picture_findings(line: Timeline) -> Iterator[tuple[str, str]]:
    stream = line.stream
    if not stream.heads:
        return
    formats = {(head.format, head.encoding) for head in stream.heads.kinds()}
    if len(formats) > 1:
        told = ", ".join(sorted(f"{name} {encoding}".strip() for name, encoding in formats))
        yield "format", f"its images are of several kinds ({told})"
    sizes = {(head.width, head.height) for head in stream.heads.kinds() if head.width}
    if len(sizes) > 1:
        yield "size", f"its images change their size ({', '.join(f'{w}x{h}' for w, h in sorted(sizes))})"
    sums = np.asarray(stream.image_sums)[line.order]
    begin, end = _longest_run(sums.astype(np.int64))
    if end - begin + 1 >= _FROZEN:
        at = (line.times_ns[begin] - line.times_ns[0]) / NS
        yield "frozen", f"{end - begin + 1} images from {at:.2f} s on have the very same bytes"
    if stream.heads[0].format in ("h264", "h265", "av1") and not stream.heads[0].is_keyframe:
        keyframes = np.flatnonzero(stream.heads.are_keyframes)
        first = int(keyframes[0]) if len(keyframes) else len(stream.heads)
        yield "keyframe", f"its first {first} images cannot be decoded, since no keyframe is before them"


def _joint_findings(regular: Sequence[Timeline]) -> Iterator[Finding]:
    """Joints that stop coming while others of their topic, or the same ones from another publisher, go on."""
    for line in regular:
        joints = line.stream.layout.joints if line.stream.layout else ()
        key = (line.stream.topic, line.is_header)
        others = [other for other in regular if (other.stream.topic, other.is_header) == key]
        early = max(int(other.times_ns[-1]) for other in others) - int(line.times_ns[-1])
        if joints and early > _GAP * line.period_ns:
            told = f"{joints[0]!r}" + (f" and {len(joints) - 1} more joints" if len(joints) > 1 else "")
            text = f"{told} stop {early / NS:.2f} s before other joints of the topic"
            yield of_stream(line.stream, "early_end", text)


def _extent_findings(regular: Sequence[Timeline]) -> Iterator[Finding]:
    if len(regular) < 2:
        return
    begin = float(np.median([line.times_ns[0] for line in regular]))
    end = float(np.median([line.times_ns[-1] for line in regular]))
    for line in regular:
        late, early = (line.times_ns[0] - begin) / NS, (end - line.times_ns[-1]) / NS
        if late > _STILL_S:
            yield of_stream(line.stream, "late_start", f"begins {late:.2f} s late")
        if early > _STILL_S:
            yield of_stream(line.stream, "early_end", f"ends {early:.2f} s early")


def _offset_findings(lines: Sequence[Timeline]) -> Iterator[Finding]:
    """Streams whose headers are on another clock than those of most."""
    skews = {line.stream.label: float(np.median(line.skews_ns)) / NS for line in lines if len(line.skews_ns)}
    if len(skews) < 2:
        return
    usual = float(np.median(list(skews.values())))
    for label, skew in skews.items():
        if abs(skew - usual) > SKEW_S:
            text = f"its clock is off by {usual - skew:+.3f} s against that of the other streams"
            yield Finding(kind="clock_offset", stream=label, text=text)


def _camera_findings(streams: BagStreams) -> Iterator[Finding]:
    """Cameras whose messages are those of another one, by coordinate frame or image."""
    for name, stream in streams.cameras.items():
        frame = frame_id_of(streams.infos.get(name, {}))
        if frame and stream.frame_ids and stream.frame_ids[0] and frame != stream.frame_ids[0]:
            text = f"its images are of {stream.frame_ids[0]!r}, its calibration is of {frame!r}"
            yield of_stream(stream, "swapped", text)
        elif stream.heads[0].encoding not in DEPTH_UNITS and (other := _claimed_by(name, streams)):  # registered to one
            text = f"its coordinate frame {stream.frame_ids[0]!r} is named like the topic of {other}"
            yield of_stream(stream, "swapped", text)
    for (name, stream), (other_name, other_stream) in pairwise(sorted(streams.cameras.items())):
        shared = min(len(stream), len(other_stream))
        if shared >= _FROZEN and np.mean(np.isin(stream.image_sums, other_stream.image_sums)) > 0.9:
            text = f"{stream.topic} and {other_stream.topic} show the same images"
            yield Finding(kind="same_pictures", stream=f"camera {name}, camera {other_name}", text=text)


def _claimed_by(name: str, streams: BagStreams) -> str:
    """The camera to whose topic a camera's coordinate frame belongs by its words, where it is not its own."""

    def words(text: str) -> set[str]:
        return {word for word in text.lower().replace("/", " ").replace("_", " ").split() if word not in _COMMON}

    stream = streams.cameras[name]
    frame = words(stream.frame_ids[0]) if stream.frame_ids else set()
    own = words(stream.topic)
    for other, other_stream in streams.cameras.items():
        theirs = words(other_stream.topic)
        if other != name and frame & (theirs - own) and not frame & (own - theirs):
            return f"camera {other}"
    return ""


_COMMON = {"camera", "cam", "color", "image", "raw", "rect", "compressed", "optical", "frame", "link", "rgb", "depth"}


def _slow_findings(lines: Iterable[Timeline], fps: int) -> Iterator[Finding]:
    """Streams that are slower than the rows; cameras only where none has an image for each row."""
    regular = [line for line in lines if line.is_regular]
    slow = [line for line in regular if line.period_ns * fps > _SLOW * NS]
    is_filmed = any(line.stream.heads and line not in slow for line in regular)
    for line in slow:
        rate = NS / line.period_ns
        if not line.stream.heads:
            yield of_stream(line.stream, "slow", f"comes {rate:.1f} times a second, rows {fps} times")
        elif not is_filmed:
            advice = f"use fps = {max(1, round(rate))}"
            yield of_stream(line.stream, "slow", f"comes {rate:.1f} times a second, rows {fps} times: {advice}")


def _unit_findings(streams: BagStreams, mapping: SourceMapping) -> Iterator[Finding]:
    for (name, index), stream in streams.sources.items():
        source = mapping.features[name][index]
        if stream.values is None or source.next or (source.to or source.unit) != "rad":
            continue
        largest = float(np.nanmax(np.abs(stream.values), initial=0.0))
        if largest > _FULL_TURNS:
            yield of_stream(stream, "unit", f"angles reach {largest:.4g}, which is hardly rad")


def _action_findings(streams: BagStreams, mapping: SourceMapping) -> Iterator[Finding]:
    """State and action that do not speak of the same thing."""
    if any(source.next for source in mapping.features[ACTION]):
        return
    state, action = streams.sources[STATE, 0], streams.sources[ACTION, 0]
    if state.values is None or action.values is None or state.layout is None or action.layout is None:
        return
    shared = [(state.layout.names.index(name), column) for column, name in enumerate(action.layout.names)
              if name in state.layout.names]  # fmt: skip
    moving = [pair for pair in shared if _spread(action.values[:, pair[1]]) > 0.05]
    dead = [pair for pair in moving if _spread(state.values[:, pair[0]]) == 0.0]
    if dead:
        name = state.layout.names[dead[0][0]]
        yield of_stream(state, "stuck", f"{name!r} never changes while the action of the same name does")
    ratios = [_spread(state.values[:, ours]) / _spread(action.values[:, theirs]) for ours, theirs in moving]
    ratio = float(np.median(ratios)) if len(ratios) > 1 else 1.0
    wide, narrow = (state, action) if ratio > 1 else (action, state)
    if _DEGREES[0] < max(ratio, 1 / max(ratio, 1e-9)) < _DEGREES[1]:
        text = f"in degrees, it seems: joints move {max(ratio, 1 / ratio):.3g} times as far as those of {narrow.topic}"
        yield of_stream(wide, "unit", text)


def _spread(numbers: NDArray[Any]) -> float:
    finite: Int = numbers[np.isfinite(numbers)]
    return float(np.ptp(finite)) if len(finite) else 0.0
