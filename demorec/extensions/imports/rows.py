"""Rows of an episode: the data that each takes from every stream, its age, and the reason if there can be no
episode.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import cast

import numpy as np

from demorec.episode.episode import Table
from demorec.episode.info import DEPTH_UNITS, Kept
from demorec.extensions.imports.bag import NS
from demorec.extensions.imports.bag_files import BagError
from demorec.extensions.imports.clock import (
    MISSING,
    ChosenSamples,
    Int,
    Numbers,
    Timeline,
    followed,
    grid,
    timeline,
)
from demorec.extensions.imports.image_messages import KEPT_FORMATS, VIDEO_FORMATS, ImageHead
from demorec.extensions.imports.mapping import SourceMapping
from demorec.extensions.imports.streams import BagStreams, Key

RATE = 0.05
"""Maximum relative difference between fps and the rate of images that rows follow, the limit of the check `rate`. If
fps is the rounded rate, half an image per second may be more.
"""
_SAME_COUNT = 2
"""Maximum difference in image counts between cameras of one rate: one at each end of an episode."""


@dataclass(frozen=True, kw_only=True, eq=False)
class TakenImages:
    """Images that an episode takes from a camera.

    Attributes:
        topic, head: Topic of the messages, and head of the first image.
        kept: Codec of passthrough packets, or encoding of depth; "" for pixels, which are encoded once.
        taken: (P,) index of each image's message in its topic, sorted by time.
    """

    topic: str
    head: ImageHead
    kept: Kept
    taken: Int

    def described(self) -> str:
        """Describe the treatment of the images."""
        kind = self.head.encoding if self.head.format == "raw" else self.head.format
        fate = f"{self.kept} passed through as it is" if self.kept else f"{kind}, encoded once"
        return f"{len(self.taken)} images {self.head.width}x{self.head.height}, {fate}"


@dataclass(frozen=True, kw_only=True, eq=False)
class EpisodeRows:
    """An episode before its images are read.

    Attributes:
        table: Its rows, by the mapping's clock; a feature has the age of its oldest source.
        cameras: Name -> its images.
        follows: Stream with one row per message ("camera front"); "" for a grid.
    """

    table: Table
    cameras: Mapping[str, TakenImages]
    follows: str


class Timelines:
    """All streams of a bag on the mapping's clock; `lines` is stream -> timeline."""

    def __init__(self, streams: BagStreams, mapping: SourceMapping) -> None:
        self.streams, self.mapping = streams, mapping
        self.lines = {key: timeline(stream, mapping.clock) for key, stream in streams.all.items()}
        if empty := [line for line in self.lines.values() if not len(line.times_ns)]:
            raise BagError(f"No message of {empty[0].label} has a usable time")

    def sources(self, feature: str) -> Iterator[tuple[Key, int]]:
        """Stream of each of a feature's sources, and the number of rows by which it is later: 1 for the streams of
        another feature's next row.
        """
        for index, source in enumerate(self.mapping.features[feature]):
            if source.next:
                yield from ((key, 1) for key, _ in self.sources(source.next))
            else:
                yield (feature, index), 0

    def rows(self) -> EpisodeRows:
        """Rows of the bag's episode; BagError if a stream has no usable data for them."""
        begin, end = self._extent()
        times, follows = self._times(begin, end)
        if len(times) < 2:
            raise BagError(f"only {len(times)} rows have all streams")
        chosen = {key: line.chosen(times) for key, line in self.lines.items()}
        for judge in (_too_old, _unfit):
            if problems := [text for key, rows in chosen.items() if (text := judge(self.lines[key], rows, times))]:
                raise BagError("; ".join(problems))
        mapped = self.mapping.features
        has_next = any(source.next for sources in mapped.values() for source in sources)
        count = len(times) - has_next
        features = {name: self._feature(name, chosen, times, count) for name in mapped}
        shown = {name: chosen[name].index[:count] for name in self.mapping.cameras}
        places = {name: _taken(self.lines[name], indices) for name, indices in shown.items()}
        return EpisodeRows(
            table=Table(
                time_ns=times[:count],
                features={name: values for name, (values, _) in features.items()},
                stamps={name: stamps for name, (_, stamps) in features.items()},
                images={name: np.searchsorted(places[name], indices) for name, indices in shown.items()},
                image_stamps={name: self.lines[name].times_ns[taken] for name, taken in places.items()},
            ),
            cameras={name: _camera(self.lines[name], taken) for name, taken in places.items()},
            follows=follows,
        )

    def _feature(self, name: str, chosen: Mapping[Key, ChosenSamples], times: Int, count: int) -> tuple[Numbers, Int]:
        """First `count` rows (R, D) of a feature, float32 if all sources are, otherwise float64; their timestamps."""
        values, ages = [], []
        for key, later in self.sources(name):
            part = slice(later, later + count)
            line = self.lines[key]
            values.append(line.stream.values[line.order[chosen[key].index]][part])
            # The age of a next row is relative to the row that contains it, and thus negative.
            ages.append(chosen[key].age_ns[part] - (times[part] - times[:count]))
        return np.concatenate(values, axis=1), times[:count] - np.max(np.stack(ages), axis=0)

    @property
    def begin_ns(self) -> int:
        """Time of the bag's first message."""
        return min(int(line.times_ns[0]) for line in self.lines.values())

    def _extent(self) -> tuple[int, int]:
        """Interval in which all streams have data."""
        max_trim_s, lines = self.mapping.clock.max_trim_s, list(self.lines.values())
        begins, ends = [int(line.times_ns[0]) for line in lines], [_end(line) for line in lines]
        begin, last = max(begins), max(int(line.times_ns[-1]) for line in lines)
        end = min(last, *ends)
        late, early = lines[begins.index(begin)], lines[ends.index(min(ends))]
        problems = []
        if begin - self.begin_ns > round(max_trim_s * NS):
            problems.append(f"{late.label} begins {(begin - self.begin_ns) / NS:.2f} s late")
        if last - end > round(max_trim_s * NS):
            problems.append(f"{early.label} ends {(last - end) / NS:.2f} s early")
        if problems:
            raise BagError(f"{' and '.join(problems)}, allowed are {max_trim_s:g} s")
        return begin, end

    def _times(self, begin: int, end: int) -> tuple[Int, str]:
        """(R,) row times, and the stream that they follow."""
        fps = self.mapping.clock.fps
        if cameras := self._cameras_at_fps(begin, end):
            return self._followed(cameras, begin, end), f"camera {cameras[0]}"
        # A stream faster than the rows has skipped messages for any choice of rows. (The median period of a
        # stream with jitter has an error of a few hundredths.)
        slow = [line for line in self.lines.values() if line.is_regular and line.period_ns * fps > 0.9 * NS]
        return grid(begin, end, fps, [line.times_ns for line in slow]), ""

    def _cameras_at_fps(self, begin: int, end: int) -> list[str]:
        """Cameras with an image for each row. The first, which rows follow, has the fewest images, but not depth; among
        those with nearly as few it is the first of the mapping, so that it is the same in all episodes.
        """
        fps = self.mapping.clock.fps
        counts: dict[str, int] = {}
        for name in self.mapping.cameras:
            times = self.lines[name].within(begin, end)
            seconds = float(times[-1] - times[0]) / NS if len(times) > 1 else 0.0
            if seconds and abs(len(times) - 1 - fps * seconds) <= max(RATE * fps, 0.5) * seconds + 1:
                counts[name] = len(times)
        colour = [name for name in counts if self.lines[name].stream.heads[0].encoding not in DEPTH_UNITS]
        may_lead = colour or list(counts)
        fewest = min((counts[name] for name in may_lead), default=0)
        lead = next((name for name in may_lead if counts[name] <= fewest + _SAME_COUNT), "")
        return [lead, *(name for name in counts if name != lead)] if lead else []

    def _followed(self, cameras: list[str], begin: int, end: int) -> Int:
        """One row for each image of the first camera, placed so that the others' images are also shown."""
        line = self.lines[cameras[0]]
        # An image from shortly before another stream's start is used as soon as that stream has data.
        first = begin - line.period_ns // 2
        lead = np.unique(np.maximum(line.within(first, end), begin))
        others = [self.lines[name].times_ns for name in cameras[1:]]
        return followed(lead, others, period_ns=line.period_ns, end_ns=end)


def _end(line: Timeline) -> int:
    """Time until which a stream has data: its last message is valid until the next would have arrived."""
    age = min(line.max_age_ns, line.period_ns) if line.is_regular else line.max_age_ns
    return int(line.times_ns[-1]) + age


def _too_old(line: Timeline, chosen: ChosenSamples, times: Int) -> str:
    """Reason why the rows' data is missing or too old; "" if it is not."""
    bad = np.flatnonzero(chosen.age_ns > line.max_age_ns)
    if not len(bad):
        return ""
    worst = int(chosen.age_ns[bad].max())
    what = "has nothing" if worst >= MISSING else f"is up to {worst / NS:.3f} s old"
    return (
        f"{line.label} {what} at {len(bad)} of {len(times)} rows, from {(times[bad[0]] - times[0]) / NS:.2f} s on, "
        f"allowed are {line.max_age_ns / NS:g} s"
    )


def _unfit(line: Timeline, chosen: ChosenSamples, times: Int) -> str:
    """Reason why the rows' data cannot be recorded; "" if it can."""
    stream = line.stream
    if stream.names:
        bad = np.flatnonzero(~np.isfinite(stream.values[line.order[chosen.index]]).all(axis=1))
        if len(bad):
            at = (times[bad[0]] - times[0]) / NS
            return f"{line.label} has numbers that are not finite at {len(bad)} rows, from {at:.2f} s on"
        return ""
    first, last = int(chosen.index.min()), int(chosen.index.max())
    heads = {stream.heads[place] for place in line.order[first : last + 1].tolist()}
    sizes = sorted({(head.width, head.height) for head in heads if head.width})
    formats = sorted({head.format for head in heads})
    if len(sizes) > 1:
        return f"{line.label} changes its size ({', '.join(f'{w}x{h}' for w, h in sizes)})"
    return f"{line.label} has images of several kinds ({', '.join(formats)})" if len(formats) > 1 else ""


def _taken(line: Timeline, shown: Int) -> Int:
    """Indices of the images in its timeline that a camera needs to show these (R,): for video, from the preceding
    keyframe.
    """
    taken = np.unique(shown)
    if line.stream.heads[int(line.order[shown[0]])].format not in VIDEO_FORMATS:
        return taken
    first = int(taken[0])
    while not line.stream.heads[int(line.order[first])].is_keyframe:
        first -= 1
    return np.arange(first, int(taken[-1]) + 1)


def _camera(line: Timeline, taken: Int) -> TakenImages:
    """Describe the images of a camera that an episode takes from its timeline."""
    head = line.stream.heads[int(line.order[taken[0]])]
    kept = head.encoding if head.encoding in DEPTH_UNITS else head.format if head.format in KEPT_FORMATS else ""
    numbers = np.asarray(line.stream.places)[line.order[taken]]
    return TakenImages(topic=line.stream.topic, head=head, kept=cast(Kept, kept), taken=numbers)
