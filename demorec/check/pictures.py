"""Are the pictures worth looking at: they decode, change when something moves, and are neither black nor burnt."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from demorec.check.base import Measurement, check, worst
from demorec.check.episode import RecordedEpisode
from demorec.check.rows import longest_run
from demorec.geometry import Array
from demorec.scene.scene import Camera

STILL_CHANGE = 1.5
"""Change of a block of pixels, of 255, below which two pictures are the same to the eye. A still picture coded as
keyframes and predicted pictures in turn changes by 1.1 to 1.3 in its most changed block."""

MOVING_CHANGE = 4.5
"""Change of a block, of 255, that motion makes beyond doubt: before a bare floor a predicted picture can leave a small
motion to the next keyframe, whose change is then up to 3.3."""


REPEATED_CHANGE = 3.0
REPEATED_SHARE = 0.18
"""Change of a block, of 255 and of the changes before and after, below which a picture repeats the one before. Of
pictures that were repeated on purpose 82 % are below both, the others being mostly keyframes after a predicted one;
of 68,013 pictures each of two cameras none, though a swinging hand came to 2.8 and to 0.22."""


@check(group="pictures", measures="frames without a picture that decodes", warn=0, needs_pictures=True)
def pictures_decode(episode: RecordedEpisode) -> Measurement | None:
    """Every camera's video decodes to its end, one picture a frame."""
    found = []
    for camera in episode.cameras:
        summary = episode.pictures(camera)
        missing = episode.num_frames - summary.num_pictures
        detail = f"camera {camera.name}: {summary.error or f'{summary.num_pictures} pictures'}"
        if summary.error and missing == 0:
            missing = 1
        frame = summary.num_pictures if missing else None
        found.append(Measurement(value=abs(missing), frame=frame, detail=detail))
    return worst(*found)


@check(group="pictures", measures="pictures that are nearly all black or nearly all white", warn=0, needs_pictures=True)
def pictures_exposed(episode: RecordedEpisode) -> Measurement | None:
    """No picture is black or burnt out: 95 % of its pixels darker than 12 or brighter than 250 of 255."""
    found = []
    for camera in episode.cameras:
        summary = episode.pictures(camera)
        wrong = (summary.dark > 0.95) | (summary.bright > 0.95)
        frame = int(np.argmax(wrong)) if wrong.any() else None
        found.append(Measurement(value=int(wrong.sum()), frame=frame, detail=f"camera {camera.name}"))
    return worst(*found)


@check(
    group="pictures",
    measures="largest share of a picture that is black or white",
    warn=0.5,
    fail=0.95,
    needs_pictures=True,
)
def exposure(episode: RecordedEpisode) -> Measurement | None:
    """Most of every picture is neither under- nor overexposed."""
    found = []
    for camera in episode.cameras:
        summary = episode.pictures(camera)
        share = np.maximum(summary.dark, summary.bright)
        if len(share):
            frame = int(np.argmax(share))
            found.append(Measurement(value=float(share[frame]), frame=frame, detail=f"camera {camera.name}"))
    return worst(*found)


def _motion(episode: RecordedEpisode, camera: Camera) -> tuple[Array, NDArray[np.bool_]]:
    """(T - 1,) how much moves before a camera from frame to frame, and whether the picture must change for it.

    For a camera on the hand its own motion, metres; for one in the world that of the TCP in the picture, pixels.
    """
    world_from_camera = episode.columns.world_from_camera[camera.name]
    if camera.mount != "world":
        own = np.linalg.norm(np.diff(world_from_camera[:, :3], axis=0), axis=1)
        own = own + 0.3 * np.abs(np.diff(world_from_camera[:, 3:], axis=0)).max(axis=1, initial=0.0)
        return own, own > 0.004
    offset = episode.world_from_tcp[:, :3, 3] - world_from_camera[:, :3]
    in_camera = np.einsum("tij,tj->ti", episode.camera_from_world(camera.name)[:, :3, :3], offset)
    depth = np.maximum(in_camera[:, 2], 1e-3)
    u, v, _ = episode.recorded_intrinsics(camera.name) @ (in_camera / depth[:, None]).T
    inside = (u > 0) & (u < camera.width) & (v > 0) & (v < camera.height) & (in_camera[:, 2] > 0)
    step = np.hypot(np.diff(u), np.diff(v))
    return step, (step > 0.5 * max(camera.height, camera.width) / 160) & inside[1:] & inside[:-1]


def _relative_change(episode: RecordedEpisode, camera: Camera) -> tuple[Array, NDArray[np.bool_]]:
    """(N - 1,) change of the pictures in units of what the motion usually makes of it, and where it must be seen."""
    change = episode.pictures(camera).change
    motion, must = _motion(episode, camera)
    motion, must = motion[: len(change)], must[: len(change)]
    rate = float(np.median(change[must] / motion[must])) if must.any() else 0.0
    expected = np.maximum(rate * motion, 1e-9)
    # What no eye and no coder sees is no change, however little was to be expected.
    return np.where(change < STILL_CHANGE, 0.0, change / expected), must


@check(
    group="pictures",
    measures="longest run of unchanged pictures while something moves before the camera, frames",
    warn=2,
    fail=4,
    needs_pictures=True,
)
def frozen(episode: RecordedEpisode) -> Measurement | None:
    """A camera does not stand still while the arm moves in its view."""
    found = []
    for camera in episode.cameras:
        relative, must = _relative_change(episode, camera)
        # Not 0: the same picture, coded once more, differs a little.
        length, start = longest_run((relative < 0.06) & must)
        frame = start + 1 if length else None
        found.append(Measurement(value=length, frame=frame, detail=f"camera {camera.name}"))
    return worst(*found)


@check(
    group="pictures",
    measures="single pictures that repeat the one before, in the midst of motion",
    warn=0,
    fail=2,
    needs_pictures=True,
)
def repeated_pictures(episode: RecordedEpisode) -> Measurement | None:
    """No picture was dropped and the one before shown in its place."""
    found = []
    for camera in episode.cameras:
        change = episode.pictures(camera).change
        if len(change) < 3:
            continue
        must = _motion(episode, camera)[1][: len(change)]
        around = np.minimum(change[:-2], change[2:])
        alone = must[1:-1] & (change[1:-1] < np.minimum(REPEATED_CHANGE, REPEATED_SHARE * around))
        alone &= around > MOVING_CHANGE
        frame = int(np.argmax(alone)) + 2 if alone.any() else None
        found.append(Measurement(value=int(alone.sum()), frame=frame, detail=f"camera {camera.name}"))
    return worst(*found)


@check(
    group="pictures",
    measures="likeness of two cameras' pictures (correlation over time)",
    warn=0.98,
    needs_pictures=True,
)
def distinct_cameras(episode: RecordedEpisode) -> Measurement | None:
    """Two cameras in different places do not show the same pictures."""
    found = []
    for number, camera in enumerate(episode.cameras):
        for other in episode.cameras[number + 1 :]:
            first, second = episode.pictures(camera).thumbnails, episode.pictures(other).thumbnails
            count = min(len(first), len(second))
            if first.shape[1:] != second.shape[1:] or count < 2 or _same_place(episode, camera, other):
                continue
            value = _correlation(first[:count], second[:count])
            found.append(Measurement(value=value, detail=f"cameras {camera.name} and {other.name}"))
    return worst(*found)


def _same_place(episode: RecordedEpisode, camera: Camera, other: Camera) -> bool:
    poses = episode.columns.world_from_camera
    return bool(np.abs(poses[camera.name] - poses[other.name]).max(initial=0.0) < 1e-3)


def _correlation(a: NDArray[np.float32], b: NDArray[np.float32]) -> float:
    x, y = a.astype(np.float64) - a.mean(), b.astype(np.float64) - b.mean()
    size = float(np.sqrt((x * x).sum() * (y * y).sum()))
    return float((x * y).sum() / size) if size > 0 else 0.0


@check(
    group="pictures",
    measures="mean colour of the decoded pictures against the recorded histogram, of 255",
    warn=4.0,
    fail=8.0,
    needs_pictures=True,
)
def pixel_statistics(episode: RecordedEpisode) -> Measurement | None:
    """The histograms, counted before coding, are those of the pictures: catches swapped channels and other pictures."""
    found = []
    for camera in episode.cameras:
        decoded = episode.pictures(camera).mean
        if not len(decoded):
            continue
        counted = episode.recording.pixel_statistics(camera.name)
        levels = np.arange(256)
        recorded = (counted.counts * levels).sum(axis=1) / np.maximum(counted.counts.sum(axis=1), 1)
        off = np.abs(decoded.mean(axis=0) - recorded)
        channel = int(np.argmax(off))
        detail = f"camera {camera.name}, {('red', 'green', 'blue')[channel]}"
        found.append(Measurement(value=float(off[channel]), detail=detail))
    return worst(*found)
