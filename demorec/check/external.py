"""Checks of times and images of recordings that demorec did not simulate, whose streams have clocks of their own."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from demorec.check.base import Found, Measurement, NotMeasured, external_check, worst_frame
from demorec.check.episode import CheckedEpisode
from demorec.episode.episode import NO_IMAGE

_NANOSECONDS = 1_000_000_000


@external_check(
    group="time",
    measures="frames and images that were dropped while recording",
    fail=math.inf,
)
def drops(subject: CheckedEpisode) -> Found:
    """Count the frames and images that the recorder dropped."""
    outcome = subject.recording.outcome
    if outcome is None:
        return NotMeasured(why="the recording has no outcome, which would state it")
    lost = ", ".join(f"{count} of {what}" for what, count in outcome.drops.items() if count)
    return Measurement(value=sum(outcome.drops.values()), detail=lost)


@external_check(
    group="time",
    measures="difference of the frames' mean rate from the nominal one, as a share of it",
    warn=0.05,
    fail=0.5,
)
def rate(subject: CheckedEpisode) -> Found:
    """Compare the mean rate of the frames with the nominal one, which datasets and policies use."""
    times, fps = subject.recording.table().time_ns, subject.recording.info.fps
    if len(times) < 2:
        return None
    rate = (len(times) - 1) * _NANOSECONDS / float(times[-1] - times[0])
    return Measurement(value=abs(rate / fps - 1), detail=f"{rate:.4g} Hz instead of {fps} Hz")


@external_check(
    group="time",
    measures="longest time between two frames, in nominal periods",
    warn=2.5,
    fail=30,
)
def gaps(subject: CheckedEpisode) -> Found:
    """Find frames that are missing between others."""
    steps = np.diff(subject.recording.table().time_ns)
    if not len(steps):
        return None
    frame = int(steps.argmax())
    periods = float(steps[frame]) * subject.recording.info.fps / _NANOSECONDS
    return Measurement(value=periods, frame=frame + 1, detail=f"{steps[frame] / 1e6:.4g} ms after the frame before")


@external_check(
    group="alignment",
    unit="s",
    measures="largest distance between the timestamps of a frame and of a sample or an image in it",
    warn=0.2,
    fail=1.0,
)
def sample_age(subject: CheckedEpisode) -> Iterator[Found]:
    """Compare the timestamp of each frame with those of its samples and images."""
    table = subject.recording.table()
    for name in table.stamps:
        yield worst_frame(np.abs(table.age_ns(name)) / _NANOSECONDS, name)
    for camera, numbers in table.images.items():
        ages = np.full(len(numbers), np.nan)
        ages[numbers != NO_IMAGE] = np.abs(table.image_age_ns(camera)) / _NANOSECONDS
        yield worst_frame(ages, f"camera {camera}")


@external_check(
    group="images",
    measures="share of frames that have no image of a camera",
    fail=0.5,
)
def missing_images(subject: CheckedEpisode) -> Iterator[Found]:
    """Count the frames without an image, of each camera."""
    for camera, numbers in subject.recording.table().images.items():
        without = np.flatnonzero(numbers == NO_IMAGE)
        if len(numbers):
            first = int(without[0]) if len(without) else None
            text = f"camera {camera}: {len(without)} of {len(numbers)} frames"
            yield Measurement(value=len(without) / len(numbers), frame=first, detail=text)
