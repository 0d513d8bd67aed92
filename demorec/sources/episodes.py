"""Where the episodes of a bag begin and end, what they are called and how they ended."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from demorec.core.plain import listed
from demorec.sources.bag import Bag
from demorec.sources.bag_files import BagError
from demorec.sources.clock import NS, Int, Timeline
from demorec.sources.mapping import SourceMapping
from demorec.sources.streams import BagStreams, Text
from demorec.sources.words import task_in_name

_SHOWN, _MOST_LISTED = 40, 5
"""Characters of a marker, and markers, in an error."""


@dataclass(frozen=True, kw_only=True)
class Window:
    """Where an episode is in its bag.

    Attributes:
        begin_ns, end_ns: Its first and last moment, by the mapping's clock.
        success: How it ended; None where the bag does not say.
        discarded: The marker that says that it is no episode; "" for those that are.
    """

    begin_ns: int
    end_ns: int
    success: bool | None = None
    discarded: str = ""


def windows(bag: Bag, streams: BagStreams, timelines: list[Timeline], mapping: SourceMapping) -> list[Window]:
    """The episodes of a bag, in order; BagError when there are none, or where a marker has no meaning."""
    begin = min(int(line.times_ns[0]) for line in timelines if len(line.times_ns))
    end = max(int(line.times_ns[-1]) for line in timelines if len(line.times_ns))
    episodes = mapping.episodes
    if episodes.cut == "file":
        return [Window(begin_ns=begin, end_ns=end)]
    if episodes.cut == "times":
        found = [
            Window(begin_ns=begin + round(first * NS), end_ns=begin + round(last * NS))
            for first, last in episodes.times_s
        ]
        if outside := [window for window in found if window.begin_ns >= end]:
            raise BagError(
                f"An episode begins {(outside[0].begin_ns - begin) / NS:g} s after the first message, the bag has only "
                f"{(end - begin) / NS:.1f} s: {bag.path}"
            )
        return found
    if episodes.cut == "gap":
        return _between_gaps(timelines, episodes.gap_s)
    markers = streams.texts[episodes.topic]
    if unknown := _unknown_words(markers, mapping):
        raise BagError(
            f"Markers of {episodes.topic} say {unknown}, which the mapping "
            f"does not know: put it into episodes.discard (the episode is left out) or episodes.ignore, or set start, "
            f"stop, success or failure: {bag.path}"
        )
    if found := _between_markers(markers, mapping):
        return found
    raise BagError(
        f"No marker of {episodes.topic} says {episodes.start!r} and then {episodes.stop!r}, so there is no episode: "
        f"{bag.path}"
    )


def _between_gaps(timelines: list[Timeline], gap_s: float) -> list[Window]:
    times = np.unique(np.concatenate([line.times_ns for line in timelines]))
    breaks = np.flatnonzero(np.diff(times) > gap_s * NS)
    begins = np.concatenate(([0], breaks + 1))
    ends = np.concatenate((breaks, [len(times) - 1]))
    return [Window(begin_ns=int(times[a]), end_ns=int(times[b])) for a, b in zip(begins, ends, strict=True)]


def _unknown_words(markers: list[Text], mapping: SourceMapping) -> str:
    """What markers say that the mapping gives no meaning, each once; "" for nothing. Subtasks may share their topic."""
    words = mapping.episodes
    known = {True, False, "", words.start, words.stop, words.success, words.failure, *words.discard, *words.ignore}
    is_shared = words.topic == mapping.subtasks.topic

    def is_known(value: object) -> bool:
        return isinstance(value, str | int | float) and ((is_shared and isinstance(value, str)) or value in known)

    found = dict.fromkeys(repr(marker.value)[:_SHOWN] for marker in markers if not is_known(marker.value))
    return listed(found, _MOST_LISTED, ", ")


def _between_markers(markers: list[Text], mapping: SourceMapping) -> list[Window]:
    words = mapping.episodes
    found: list[Window] = []
    begin: int | None = None
    for marker in sorted(markers, key=lambda marker: marker.time_ns):
        if marker.value is True or marker.value == words.start:
            begin = marker.time_ns
        elif begin is not None and (
            marker.value is False or marker.value in (words.stop, words.success, words.failure)
        ):
            success = {words.success: True, words.failure: False}.get(marker.value) if marker.value else None
            found.append(Window(begin_ns=begin, end_ns=marker.time_ns, success=success))
            begin = None
        elif begin is None and found and marker.value in (words.success, words.failure):
            # The verdict may come after the end.
            found[-1] = replace(found[-1], success=marker.value == words.success)
        elif begin is not None and marker.value in words.discard:
            found.append(Window(begin_ns=begin, end_ns=marker.time_ns, discarded=marker.value))
            begin = None
        elif found and marker.value in words.discard:
            found[-1] = replace(found[-1], discarded=marker.value)
    return found


def task_text(bag: Bag, streams: BagStreams, window: Window, mapping: SourceMapping) -> str:
    """What the robot was asked to do in an episode; BagError where the bag does not say."""
    task = mapping.task
    if task.text:
        return task.text.strip()
    if task.file_name:
        if text := task_in_name(bag.name):
            return text
        raise BagError(f"The bag's name says no task, which the mapping takes from it: {bag.path}")
    texts = [text for text in streams.texts[task.topic] if text.time_ns <= window.end_ns]
    if not texts:
        raise BagError(f"No text of {task.topic} is before the episode's end, so its task is unknown: {bag.path}")
    value = max(texts, key=lambda text: text.time_ns).value
    if not isinstance(value, str) or not value.strip():
        raise BagError(f"The task of {task.topic} is no text: {bag.path}")
    return value.strip()


def subtask_rows(
    bag: Bag, streams: BagStreams, window: Window, times_ns: Int, mapping: SourceMapping
) -> dict[int, str]:
    """Row -> what is begun there: the texts of the mapping's topic that were said within the episode.

    Of several before a row the last one holds from it on; a text that is said again, and an empty one, begins nothing.

    Raises:
        BagError: What was said is no text.
    """
    words = mapping.episodes
    is_marker = words.cut == "marker" and words.topic == mapping.subtasks.topic
    ends = {words.start, words.stop, words.success, words.failure, *words.discard, *words.ignore}
    markers = ends if is_marker else set()
    found: dict[int, str] = {}
    for text in sorted(streams.texts.get(mapping.subtasks.topic, ()), key=lambda text: text.time_ns):
        if not window.begin_ns <= text.time_ns <= times_ns[-1]:
            continue
        if not isinstance(text.value, str):
            raise BagError(f"The subtask of {mapping.subtasks.topic} is no text: {bag.path}")
        if text.value in markers:
            continue
        if said := " ".join(text.value.split()):
            found[int(np.searchsorted(times_ns, text.time_ns))] = said
    before = ["", *found.values()]
    return {row: said for (row, said), last in zip(found.items(), before, strict=False) if said != last}
