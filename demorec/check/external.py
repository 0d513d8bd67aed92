"""A recording that somebody else made, as the checks see it, and the checks of its clocks.

What a scene, a seed or a script would say of it nobody knows; the checks that need these are not applicable.
"""

from __future__ import annotations

import zlib
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, closing
from functools import cached_property
from itertools import combinations
from pathlib import Path
from typing import ClassVar

import numpy as np

from demorec.check.base import IMAGES, Form, Found, Measurement, NotMeasured, external_check, worst_frame
from demorec.check.dynamics import Dynamics
from demorec.check.evidence import Motion, motion_of_recording
from demorec.check.motion import Motions, point_masses
from demorec.episode.episode import NO_PICTURE, Columns
from demorec.mcap import Recording
from demorec.mcap.container import Container
from demorec.mcap.video import decode

_NANOSECONDS = 1_000_000_000
_BLANK_LEVELS = 2.0
"""Standard deviation, of 255 levels, below which an image shows nothing."""


class CheckedRecording(ExitStack):
    """One recording of somebody else's, closed at the end of a `with`.

    Args:
        path: The recording.
        urdf: Text of the robot's description that the user names, "" for none.
    """

    form: ClassVar[Form] = "external"

    def __init__(self, path: Path, urdf: str = "") -> None:
        super().__init__()
        self.path, self.urdf = path, urdf

    @cached_property
    def recording(self) -> Recording:
        """The open recording."""
        return self.enter_context(Recording(self.path))

    @property
    def columns(self) -> Columns:
        """All numbers."""
        return self.recording.columns()

    @property
    def num_words(self) -> int:
        """How often a subtask is begun."""
        return len(self.recording.subtasks)

    @property
    def message_counts(self) -> Counter[str]:
        """Topic -> messages that are there; every chunk's checksum is verified on the way."""
        with closing(Container(self.path)) as container:
            return Counter(message.topic for message in container.messages(tuple(container.channels)))

    @cached_property
    def motions(self) -> Motions:
        """The one of its robot."""
        return Motions(lambda: [motion] if (motion := motion_of_recording(self.recording, self.urdf)) else [])

    def likeness_of_cameras(self) -> Iterator[tuple[str, float]]:
        """(two cameras, 1 where their encoded images are the same)."""
        digests = dict.fromkeys(self.recording.cameras, 0)
        for camera in digests:
            for packet in self.recording.packets(camera):
                digests[camera] = zlib.crc32(packet.data, digests[camera])
        for one, other in combinations(sorted(digests), 2):
            yield f"{one} and {other}", float(digests[one] == digests[other] != 0)

    def dynamics_of(self, motion: Motion) -> Dynamics | NotMeasured | None:
        """The torques that its motion needs."""
        return point_masses(motion)


@external_check(
    group="time",
    measures="frames and images that were dropped while recording",
    fail=float("inf"),
)
def drops(subject: CheckedRecording) -> Found:
    """What came could be taken."""
    outcome = subject.recording.outcome
    if outcome is None:
        return NotMeasured(why="the recording has no outcome, which would tell")
    lost = ", ".join(f"{count} of {what}" for what, count in outcome.drops.items() if count)
    return Measurement(value=sum(outcome.drops.values()), detail=lost)


@external_check(
    group="time",
    measures="how much the frames' mean rate differs from the nominal one, as a share of it",
    warn=0.05,
    fail=0.5,
)
def rate(subject: CheckedRecording) -> Found:
    """The frames came at the rate that the episode names, by which datasets and policies go."""
    times, fps = subject.columns.time_ns, subject.recording.info.fps
    if len(times) < 2:
        return None
    rate = (len(times) - 1) * _NANOSECONDS / float(times[-1] - times[0])
    return Measurement(value=abs(rate / fps - 1), detail=f"{rate:.4g} Hz instead of {fps} Hz")


@external_check(
    group="time",
    measures="the longest time between two frames, in nominal periods",
    warn=2.5,
    fail=30,
)
def gaps(subject: CheckedRecording) -> Found:
    """No frames are missing between others."""
    steps = np.diff(subject.columns.time_ns)
    if not len(steps):
        return None
    frame = int(steps.argmax())
    periods = float(steps[frame]) * subject.recording.info.fps / _NANOSECONDS
    return Measurement(value=periods, frame=frame + 1, detail=f"{steps[frame] / 1e6:.4g} ms after the frame before")


@external_check(
    group="alignment",
    unit="s",
    measures="the largest distance between the stamps of a frame and of a sample that it holds",
    warn=0.1,
    fail=1.0,
)
def sample_age(subject: CheckedRecording) -> Iterator[Found]:
    """What a frame holds was sensed at about its time."""
    columns = subject.columns
    for name in columns.stamps:
        yield worst_frame(np.abs(columns.age_ns(name)) / _NANOSECONDS, name)


@external_check(
    group="alignment",
    unit="s",
    measures="the largest distance between the stamps of a frame and of an image that it holds",
    warn=0.2,
    fail=1.0,
)
def image_age(subject: CheckedRecording) -> Iterator[Found]:
    """The images that a frame holds were taken at about its time."""
    columns = subject.columns
    for camera, numbers in columns.pictures.items():
        frames = np.flatnonzero(numbers != NO_PICTURE)
        yield worst_frame(np.abs(columns.picture_age_ns(camera)) / _NANOSECONDS, f"camera {camera}", frames=frames)


@external_check(
    group="pictures",
    measures="the share of frames that have no image of a camera",
    fail=0.5,
)
def missing_images(subject: CheckedRecording) -> Iterator[Found]:
    """Every frame has an image of every camera."""
    for camera, numbers in subject.columns.pictures.items():
        without = np.flatnonzero(numbers == NO_PICTURE)
        if len(numbers):
            first = int(without[0]) if len(without) else None
            told = f"camera {camera}: {len(without)} of {len(numbers)} frames"
            yield Measurement(value=len(without) / len(numbers), frame=first, detail=told)


@external_check(
    group="pictures",
    measures="cameras whose images do not decode, are of another size, or show one colour, or no distance, in more "
    "than half of them",
    needs=IMAGES,
    needs_pictures=True,
)
def images_show_something(subject: CheckedRecording) -> Found:
    """Every image decodes and shows something."""
    recording = subject.recording
    if not recording.info.cameras:
        return None
    blank, unmeasured = [], []
    for camera in recording.depth_cameras:
        shares = [float(np.mean(np.isfinite(values) & (values > 0))) for values in recording.distances(camera)]
        if shares and float(np.median(shares)) == 0:
            unmeasured.append(camera)
    for camera in recording.cameras:
        images = decode(recording.video_settings(camera), recording.packets(camera))
        deviations = [float(image[::4, ::4].std()) for image in images]
        if deviations and float(np.median(deviations)) < _BLANK_LEVELS:
            blank.append(camera)
    blank += unmeasured
    return Measurement(value=len(blank), detail=", ".join(f"camera {camera} shows nothing" for camera in blank))
