"""Are the images worth looking at: they decode, change when something moves, and are neither black nor burnt.

Also: do a dataset's first images show what its sidecar describes."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import wraps

import numpy as np
from numpy.typing import NDArray

from demorec.check.base import (
    Found,
    Lacking,
    Measurement,
    NotMeasured,
    image_check,
    sidecar_check,
    worst_frame,
)
from demorec.check.dataset import Dataset, Recorded
from demorec.check.drawn import ImageComparison, judge_lag, judge_unlike
from demorec.check.episode import CheckedEpisode
from demorec.check.full_size import FullSize
from demorec.check.rows import longest_run
from demorec.core.geometry import Array
from demorec.episode.scene import SceneCamera

MIN_MOTION = 2.5
"""Root mean square change of the drawn cells from frame to frame, of 255, that an image must show."""
STALE_SHARE, STALE_EXCESS = 0.3, 2.5
"""An image is stale that shows less than this share of the motion, and is more unlike the drawn one than the usual
image by more than this, of 255: a predicted image may leave a small motion to the next keyframe."""
_VARIES = 0.3
"""Share of the encoder's error by which that of a single image may be above the usual one."""
_FEWEST_MEANS = 3
"""Images whose mean colours tell: the encoder may darken one by 5 of 255."""
_PREDICTED_WEIGHT = 0.25
"""Of the difference of a predicted image of AV1, which leaves whole motions to the next keyframe (15 levels seen)."""


_OfEpisode = Callable[[CheckedEpisode], Iterator[Found]]


def of_each_camera[Seen](
    look: Callable[[CheckedEpisode, SceneCamera], Seen | NotMeasured],
) -> Callable[[Callable[[CheckedEpisode, SceneCamera, Seen], Found]], _OfEpisode]:
    """A check of what is known of one camera (by `look`), as one of all cameras of a recording."""

    def of_all(judge: Callable[[CheckedEpisode, SceneCamera, Seen], Found]) -> _OfEpisode:
        @wraps(judge)
        def judge_all(episode: CheckedEpisode) -> Iterator[Found]:
            for camera in episode.cameras:
                seen = look(episode, camera)
                yield seen if isinstance(seen, NotMeasured) else judge(episode, camera, seen)

        return judge_all

    return of_all


@image_check(measures="frames without an image that decodes")
def images_decode(episode: CheckedEpisode) -> Iterator[Found]:
    """Every camera's video, depth and labels decode to their end, one image a frame."""
    for camera in episode.cameras:
        for kind in episode.kinds(camera.name):
            summary = episode.images(camera, kind)
            missing = episode.num_frames - summary.num_images
            detail = f"camera {camera.name}, {kind}: {summary.error or f'{summary.num_images} images'}"
            if summary.error and missing == 0:
                missing = 1
            frame = summary.num_images if missing else None
            yield Measurement(value=abs(missing), frame=frame, detail=detail)


@image_check(measures="largest share of an image that is black or white")
def exposure(episode: CheckedEpisode) -> Iterator[Found]:
    """Most of every image is neither under- nor overexposed."""
    for camera in episode.cameras:
        summary = episode.images(camera)
        yield worst_frame(np.maximum(summary.dark, summary.bright), f"camera {camera.name}")


@image_check(
    measures="difference of the images from what the recorded numbers and the encoder make of them, median of 255"
)
def images_as_drawn(episode: CheckedEpisode) -> Iterator[Found]:
    """The images show robot, objects, colours and light as recorded: drawn anew and compared in every frame.

    In small images of low quality the encoder's own error does not vanish in the cells.
    """
    for camera in episode.cameras:
        found, full = judge_unlike(episode.compared(camera), f"camera {camera.name}"), episode.full_size(camera)
        if isinstance(found, Measurement) and isinstance(full, FullSize):
            found = replace(found, value=math.sqrt(max(found.value**2 - full.encoded**2, 0.0)))
        yield found


@image_check(
    measures="mean difference of a colour from what is drawn and encoded at full size, in units of the encoder's error"
)
@of_each_camera(CheckedEpisode.full_size)
def image_colors(episode: CheckedEpisode, camera: SceneCamera, compared: FullSize) -> Found:
    """Every colour is as drawn: catches other gains, curves, saturation and colour matrices, also if they drift."""
    return Measurement(value=compared.color, frame=compared.color_frame, detail=f"camera {camera.name}")


@image_check(
    measures="blur or sharpening of some images at full size, as half its variance",
    unit="px^2",
)
@of_each_camera(CheckedEpisode.full_size)
def image_sharpness(episode: CheckedEpisode, camera: SceneCamera, compared: FullSize) -> Found:
    """Images are as sharp as their encoder leaves them."""
    word = "blurred" if compared.sharpness > 0 else "sharpened"
    frame = int(compared.frames[0])
    return Measurement(value=abs(compared.sharpness), frame=frame, detail=f"camera {camera.name}, {word}")


@image_check(measures="error of an image at full size, or of its worst block, in units of the encoder's own")
@of_each_camera(CheckedEpisode.full_size)
def image_errors(episode: CheckedEpisode, camera: SceneCamera, compared: FullSize) -> Found:
    """No part is farther from what is drawn than its encoder leaves it: catches noise, spots, lines and stamps."""
    return worst_frame(compared.errors, f"camera {camera.name}", frames=compared.frames.astype(np.intp))


@image_check(measures="difference of a single image from what was recorded at its frame, beyond the usual, of 255")
@of_each_camera(CheckedEpisode.compared)
def odd_images(episode: CheckedEpisode, camera: SceneCamera, compared: ImageComparison) -> Found:
    """No single image is another one, torn, blurred, shifted or off in colour."""
    full = episode.full_size(camera)
    excess = _excess(compared) - (_VARIES * full.encoded if isinstance(full, FullSize) else 0.0)
    excess = np.maximum(excess, 0.0)
    excess[~_is_exact(episode, camera)[: len(excess)]] *= _PREDICTED_WEIGHT
    return worst_frame(excess, f"camera {camera.name}")


def _excess(compared: ImageComparison) -> Array:
    """(T,) by how much each image is more unlike the drawn one than the usual image."""
    return np.maximum(compared.unlike - np.median(compared.unlike), 0.0)


def _is_exact(episode: CheckedEpisode, camera: SceneCamera) -> NDArray[np.bool_]:
    """(T,) images whose coder leaves nothing to the next: all but the predicted ones of AV1."""
    if episode.recording.video_settings(camera.name).codec != "av1":
        return np.ones(episode.num_frames, dtype=np.bool_)
    return np.array([packet.is_keyframe for packet in episode.recording.packets(camera.name)], dtype=np.bool_)


def _stale(compared: ImageComparison) -> NDArray[np.bool_]:
    """(T,) images that show what was before, though something moves."""
    still = (compared.motion > MIN_MOTION) & (compared.shown < STALE_SHARE)
    return np.asarray(still & (_excess(compared) > STALE_EXCESS))


@image_check(measures="longest run of unchanged images while something moves before the camera, frames")
@of_each_camera(CheckedEpisode.compared)
def frozen(episode: CheckedEpisode, camera: SceneCamera, compared: ImageComparison) -> Found:
    """A camera does not stand still while something moves in its view."""
    return _stale_frames(camera, compared, *longest_run(_stale(compared)))


@image_check(measures="images that repeat the one before, in the midst of motion")
@of_each_camera(CheckedEpisode.compared)
def repeated_images(episode: CheckedEpisode, camera: SceneCamera, compared: ImageComparison) -> Found:
    """No image was dropped and the one before shown in its place.

    A motion that changes cells by less than their encoder does may be left to the next image.
    """
    stale = _stale(compared)
    stale &= _is_exact(episode, camera)[: len(stale)]
    full = episode.full_size(camera)
    if isinstance(full, FullSize):
        stale &= compared.motion > full.encoded
    return _stale_frames(camera, compared, int(stale.sum()), int(np.argmax(stale)))


def _stale_frames(camera: SceneCamera, compared: ImageComparison, count: int, first: int) -> Found:
    """So many images of a camera are stale, of those in which something moves."""
    num_moving = int((compared.motion > MIN_MOTION).sum())
    if not num_moving:
        return NotMeasured(why=f"too little moves before camera {camera.name}")
    detail = f"camera {camera.name}, of {num_moving} frames with motion"
    return Measurement(value=count, frame=first if count else None, detail=detail)


@image_check(
    measures="likeness of two cameras' images (correlation over time)",
    warn=0.9999,
    on=("simulated", "external", "dataset"),
    needs="two cameras",
)
def distinct_cameras(subject: Recorded) -> Iterator[Found]:
    """Two cameras in different places do not show the same images, as when one is plugged in under two names."""
    pairs = list(subject.likeness_of_cameras())
    if not pairs:
        yield Lacking(need="two cameras")
    yield from (Measurement(value=value, detail=names) for names, value in pairs)


@image_check(measures="mean colour of the decoded images against the recorded histogram, of 255")
def pixel_statistics(episode: CheckedEpisode) -> Iterator[Found]:
    """The histograms, counted before coding, are those of the images: catches swapped channels and other images."""
    for camera in episode.cameras:
        decoded = episode.images(camera).mean
        if not len(decoded):
            continue
        counted = episode.recording.pixel_statistics(camera.name)
        if counted.num_images != (episode.num_frames + 1) // 2:  # every other image is counted
            detail = f"camera {camera.name}: {counted.num_images} images are counted of {episode.num_frames}"
            yield Measurement(value=math.inf, detail=detail)
            continue
        if len(decoded) < _FEWEST_MEANS:
            yield NotMeasured(why=f"camera {camera.name} has {len(decoded)} images")
            continue
        levels = np.arange(256)
        recorded = (counted.counts * levels).sum(axis=1) / np.maximum(counted.counts.sum(axis=1), 1)
        off = np.abs(decoded.mean(axis=0) - recorded)
        channel = int(np.argmax(off))
        detail = f"camera {camera.name}, {('red', 'green', 'blue')[channel]}"
        yield Measurement(value=float(off[channel]), detail=detail)


@sidecar_check(
    needs_images=True,
    measures="difference of an episode's first images from what its states and scene make of them, median of 255",
    warn=13.0,
    fail=16.0,
)
def dataset_images_as_drawn(dataset: Dataset) -> Iterator[Found]:
    """Each video shows its own episode by its own camera, drawn anew until the fingers close, for 3 s at most."""
    for number, camera, compared in dataset.compared:
        yield judge_unlike(compared, f"camera {camera}, episode {number}")


@sidecar_check(
    needs_images=True,
    measures="lag between an episode's first images and its states, frames",
    warn=0.73,
    fail=0.85,
)
def dataset_image_lag(dataset: Dataset) -> Iterator[Found]:
    """Image t shows state t, in each episode and camera, until the fingers close, for 3 s at most."""
    for number, camera, compared in dataset.compared:
        yield judge_lag(compared, f"camera {camera}, episode {number}", f"camera {camera} in episode {number}")
