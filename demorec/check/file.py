"""Checks of a recording's file: index, checksums, numbers and images."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, suppress
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from demorec.check.base import Fault, Form, NotApplicableError, check, listed
from demorec.core.errors import RecordingError
from demorec.episode.episode import NO_IMAGE
from demorec.mcap import Recording, messages
from demorec.mcap.container import Container
from demorec.mcap.scan import Block

_STAMPED = (
    messages.JOINT_STATE,
    messages.POSE,
    messages.WRENCH,
    messages.COMPRESSED_IMAGE,
    messages.COMPRESSED_VIDEO,
    messages.LOG,
)
"""Types whose first field is a timestamp, alone or in a header."""
_CDR_BYTES = 4
"""Size of the CDR header before the first field."""
MAX_MISSING_RATIO = 0.5
"""Maximum ratio of frames without an image: a camera that is missing more often shows nothing."""


class CheckedEpisode(ExitStack):
    """One recording, closed at the end of a `with`. Properties raise RecordingError for missing data.

    The image check decodes colour images, too, unless `colours` is false.
    """

    def __init__(self, path: Path, *, colours: bool = True) -> None:
        super().__init__()
        self.path = path
        self.colours = colours

    @cached_property
    def recording(self) -> Recording:
        """The open recording."""
        return self.enter_context(Recording(self.path))

    @cached_property
    def form(self) -> Form:
        """Simulated if there is a scene; a recording that cannot be opened counts as simulated."""
        with suppress(RecordingError):
            return "simulated" if self.recording.info.simulation is not None else "external"
        return "simulated"


file_check = partial(
    check,
    family="files",
    on=("simulated", "external"),
    needs="a recording",
    why="The recording is damaged or incomplete.",
    do="demorec recover {path}, or record it again",
)


@file_check(measures="recordings that cannot be opened")
def opens(episode: CheckedEpisode) -> Iterator[Fault]:
    """Verify the checksums of index and metadata, and the format version."""
    Recording(episode.path).close()
    return iter(())


@file_check(measures="damaged chunks, and messages that differ from index or header")
def checksums(episode: CheckedEpisode) -> Iterator[Fault]:
    """Verify the checksum of every chunk, the counts of the index and, in a simulation, the timestamps in headers."""
    recording = episode.recording
    stamped = {topic for topic, (schema, _) in recording.topics.items() if schema in _STAMPED}
    found, shifted = Counter[str](), Counter[str]()
    with closing(Container(episode.path)) as container:
        for blocks in container.blocks_by_chunk(container.channels):
            for topic, block in blocks.items():
                found[topic] += len(block)
                if topic in stamped and episode.form == "simulated":
                    shifted[topic] += _count_other_stamps(block)
    wrong = [
        f"{topic}: {found[topic]}, the index has {count}"
        for topic, (_, count) in recording.topics.items()
        if found[topic] != count
    ]
    wrong += [
        f"{topic}: {count} headers with another time than the message" for topic, count in shifted.items() if count
    ]
    return listed(wrong)


def _count_other_stamps(block: Block) -> int:
    """Count the messages with another time in their first field, seconds and nanoseconds, than in the file."""
    stamps = block.heads(_CDR_BYTES + 8)[:, _CDR_BYTES:].copy().view("<i4").astype(np.int64)
    return int(np.count_nonzero(stamps[:, 0] * 1_000_000_000 + stamps[:, 1] != block.time_ns))


@file_check(measures="streams that lack messages or do not decode")
def readable(episode: CheckedEpisode) -> Iterator[Fault]:
    """Read every event, every number by the layout in the metadata, and every encoded image, at its frame's time."""
    recording = episode.recording
    list(recording.events())
    list(recording.subtasks)
    recording.table()
    for camera in recording.cameras:
        deque(recording.packets(camera), maxlen=0)
    return iter(())


@file_check(measures="recordings that a crash cut off")
def complete(episode: CheckedEpisode) -> Iterator[Fault]:
    """Check for the outcome at the end of a recording."""
    if episode.recording.outcome is None:
        yield Fault(severity="look", message="recovered from a crash, no outcome")


@check(
    family="files",
    on=("external",),
    needs="a timestamp for each sample",
    measures="frames without an image of a camera",
    unit="% of frames",
    why="Images are missing.",
    do="record it again, or leave it out",
)
def missing_images(subject: CheckedEpisode) -> Iterator[Fault]:
    """Count the frames of each camera without an image."""
    for camera, numbers in subject.recording.table().images.items():
        without = np.flatnonzero(numbers == NO_IMAGE)
        if len(without):
            share = len(without) / len(numbers)
            yield Fault(
                severity="broken" if share > MAX_MISSING_RATIO else "look",
                frames=(int(without[0]), int(without[-1])),
                value=f"{share:.0%} of frames",
                message=f"camera {camera}: {len(without)} of {len(numbers)} frames have no image",
            )


@check(
    family="files",
    on=("simulated", "external"),
    measures="cameras whose images do not all decode",
    needs="images",
    why="Images are missing or damaged.",
    do="record it again, or leave it out",
    needs_images=True,
)
def images_decode(subject: CheckedEpisode) -> Iterator[Fault]:
    """Decode every image: colour, depth and labels."""
    recording = subject.recording
    streams: list[tuple[str, Callable[[str], Iterator[Any]]]] = []
    if subject.colours:
        shown = recording.table().images
        streams += [(camera, recording.images) for camera in recording.cameras if camera in shown]
    streams += [(camera, recording.distances) for camera in recording.depth_cameras]
    streams += [(camera, recording.segmentation) for camera in recording.cameras if recording.has_segmentation(camera)]
    if not streams:
        raise NotApplicableError("the recording has no images")
    wrong = []
    for camera, read in streams:
        try:
            deque(read(camera), maxlen=0)
        except RecordingError as error:
            wrong.append(f"{camera}: {error}")
    return listed(wrong)
