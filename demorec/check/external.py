"""Are the clocks of a recording that somebody else made in order, and do its images show something?

What a scene, a seed or a script would say of it nobody knows; the checks that need these are not applicable.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from demorec.check.base import IMAGES, Found, Measurement, NotMeasured, check, external_check, worst_frame
from demorec.check.episode import CheckedEpisode
from demorec.check.over_time import Filmed
from demorec.episode.episode import NO_IMAGE

_NANOSECONDS = 1_000_000_000


@external_check(
    group="time",
    measures="frames and images that were dropped while recording",
    fail=float("inf"),
)
def drops(subject: CheckedEpisode) -> Found:
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
def rate(subject: CheckedEpisode) -> Found:
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
def gaps(subject: CheckedEpisode) -> Found:
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
def sample_age(subject: CheckedEpisode) -> Iterator[Found]:
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
def image_age(subject: CheckedEpisode) -> Iterator[Found]:
    """The images that a frame holds were taken at about its time."""
    columns = subject.columns
    for camera, numbers in columns.images.items():
        frames = np.flatnonzero(numbers != NO_IMAGE)
        yield worst_frame(np.abs(columns.image_age_ns(camera)) / _NANOSECONDS, f"camera {camera}", frames=frames)


@external_check(
    group="images",
    measures="the share of frames that have no image of a camera",
    fail=0.5,
)
def missing_images(subject: CheckedEpisode) -> Iterator[Found]:
    """Every frame has an image of every camera."""
    for camera, numbers in subject.columns.images.items():
        without = np.flatnonzero(numbers == NO_IMAGE)
        if len(numbers):
            first = int(without[0]) if len(without) else None
            text = f"camera {camera}: {len(without)} of {len(numbers)} frames"
            yield Measurement(value=len(without) / len(numbers), frame=first, detail=text)


@check(
    group="images",
    on=("external", "dataset"),
    measures="cameras whose images are of one colour, or show no distance, in more than half of them",
    needs=IMAGES,
    needs_images=True,
)
def images_show_something(subject: Filmed) -> Found:
    """No camera is covered, and none of depth sees nothing."""
    blank = [camera for camera, films in subject.films.items() if any(film.is_blank for film in films)]
    for camera, images in subject.distances():
        shares = [float(np.mean(np.isfinite(values) & (values > 0))) for values in images]
        if shares and float(np.median(shares)) == 0:
            blank.append(camera)
    if not subject.films and not blank:
        return None
    return Measurement(value=len(blank), detail=", ".join(f"camera {camera} shows nothing" for camera in blank))
