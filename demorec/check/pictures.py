"""Are the pictures worth looking at: they decode, change when something moves, and are neither black nor burnt."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from demorec.check.base import COLOR_TOPICS, Found, Measurement, NotMeasured, check, worst
from demorec.check.drawn import PictureComparison
from demorec.check.episode import CheckedEpisode
from demorec.check.rows import longest_run
from demorec.geometry import Array
from demorec.scene.scene import Camera

MIN_MOTION = 2.5
"""Root mean square change of the drawn cells from frame to frame, of 255, that a picture must show."""
STALE_SHARE, STALE_EXCESS = 0.3, 2.5
"""A picture is stale that shows less than this share of the motion, and is more unlike the drawn one than the usual
picture by more than this, of 255: a predicted picture may leave a small motion to the next keyframe."""
_PREDICTED_WEIGHT = 0.5
"""Of the difference of a predicted picture of AV1, which at low qualities leaves whole motions to the next keyframe."""


@check(
    group="pictures",
    measures="frames without a picture that decodes",
    warn=0,
    needs_pictures=True,
    reads=(
        *COLOR_TOPICS,
        "/camera/{camera}/depth",
        "/camera/{camera}/segmentation",
    ),
)
def pictures_decode(episode: CheckedEpisode) -> Found:
    """Every camera's video, depth and labels decode to their end, one picture a frame."""
    found = []
    for camera in episode.cameras:
        for kind in episode.kinds(camera.name):
            summary = episode.pictures(camera, kind)
            missing = episode.num_frames - summary.num_pictures
            detail = f"camera {camera.name}, {kind}: {summary.error or f'{summary.num_pictures} pictures'}"
            if summary.error and missing == 0:
                missing = 1
            frame = summary.num_pictures if missing else None
            found.append(Measurement(value=abs(missing), frame=frame, detail=detail))
    return worst(*found)


@check(
    group="pictures",
    measures="pictures that are nearly all black or nearly all white",
    warn=0,
    needs_pictures=True,
    reads=(*COLOR_TOPICS,),
)
def pictures_exposed(episode: CheckedEpisode) -> Found:
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
    needs_pictures=True,
    reads=(*COLOR_TOPICS,),
)
def exposure(episode: CheckedEpisode) -> Found:
    """Most of every picture is neither under- nor overexposed."""
    found = []
    for camera in episode.cameras:
        summary = episode.pictures(camera)
        share = np.maximum(summary.dark, summary.bright)
        if len(share):
            frame = int(np.argmax(share))
            found.append(Measurement(value=float(share[frame]), frame=frame, detail=f"camera {camera.name}"))
    return worst(*found)


@check(
    group="pictures",
    measures="difference of the pictures from what the recorded numbers make of them, median of 255",
    needs_pictures=True,
    reads=(
        *COLOR_TOPICS,
        "info.scene.bodies.rgba",
        "info.scene.bodies.texture",
        "info.scene.light",
    ),
)
def pictures_as_drawn(episode: CheckedEpisode) -> Found:
    """The pictures show robot, objects, colours and light as recorded: drawn anew and compared in every frame."""
    found: list[Found] = []
    for camera in episode.cameras:
        compared = episode.compared(camera)
        if isinstance(compared, NotMeasured):
            found.append(compared)
            continue
        found.append(Measurement(value=float(np.median(compared.unlike)), detail=f"camera {camera.name}"))
    return worst(*found)


@check(
    group="pictures",
    measures="difference of a single picture from what was recorded at its frame, beyond the usual, of 255",
    needs_pictures=True,
    reads=(
        *COLOR_TOPICS,
        "/joint_states",
        "/object/{body}/pose",
    ),
)
def odd_pictures(episode: CheckedEpisode) -> Found:
    """No single picture is another one, torn, blurred, shifted or off in colour."""
    found: list[Found] = []
    for camera in episode.cameras:
        compared = episode.compared(camera)
        if isinstance(compared, NotMeasured):
            found.append(compared)
            continue
        excess = _excess(compared)
        excess[~_is_exact(episode, camera)[: len(excess)]] *= _PREDICTED_WEIGHT
        frame = int(np.argmax(excess))
        found.append(Measurement(value=float(excess[frame]), frame=frame, detail=f"camera {camera.name}"))
    return worst(*found)


def _excess(compared: PictureComparison) -> Array:
    """(T,) by how much each picture is more unlike the drawn one than the usual picture."""
    return np.maximum(compared.unlike - np.median(compared.unlike), 0.0)


def _is_exact(episode: CheckedEpisode, camera: Camera) -> NDArray[np.bool_]:
    """(T,) pictures whose coder leaves nothing to the next: all but the predicted ones of AV1."""
    if episode.recording.video_settings(camera.name).codec != "av1":
        return np.ones(episode.num_frames, dtype=np.bool_)
    return np.array([packet.is_keyframe for packet in episode.recording.packets(camera.name)], dtype=np.bool_)


def _stale(compared: PictureComparison) -> NDArray[np.bool_]:
    """(T,) pictures that show what was before, though something moves."""
    still = (compared.motion > MIN_MOTION) & (compared.shown < STALE_SHARE)
    return np.asarray(still & (_excess(compared) > STALE_EXCESS))


@check(
    group="pictures",
    measures="longest run of unchanged pictures while something moves before the camera, frames",
    needs_pictures=True,
    reads=(
        *COLOR_TOPICS,
        "/joint_states",
        "/object/{body}/pose",
    ),
)
def frozen(episode: CheckedEpisode) -> Found:
    """A camera does not stand still while something moves in its view."""
    return worst(*(_stale_frames(episode, camera, in_runs=True) for camera in episode.cameras))


@check(
    group="pictures",
    measures="pictures that repeat the one before, in the midst of motion",
    needs_pictures=True,
    reads=(
        *COLOR_TOPICS,
        "/joint_states",
        "/object/{body}/pose",
    ),
)
def repeated_pictures(episode: CheckedEpisode) -> Found:
    """No picture was dropped and the one before shown in its place."""
    return worst(*(_stale_frames(episode, camera, in_runs=False) for camera in episode.cameras))


def _stale_frames(episode: CheckedEpisode, camera: Camera, *, in_runs: bool) -> Found:
    """How many pictures of a camera are stale: the longest run of them, or all."""
    compared = episode.compared(camera)
    if isinstance(compared, NotMeasured):
        return compared
    num_moving = int((compared.motion > MIN_MOTION).sum())
    if not num_moving:
        return NotMeasured(why=f"too little moves before camera {camera.name}")
    stale = _stale(compared)
    if not in_runs:
        stale &= _is_exact(episode, camera)[: len(stale)]
    value, start = longest_run(stale) if in_runs else (int(stale.sum()), int(np.argmax(stale)))
    detail = f"camera {camera.name}, of {num_moving} frames with motion"
    return Measurement(value=value, frame=start if value else None, detail=detail)


@check(
    group="pictures",
    measures="likeness of two cameras' pictures (correlation over time)",
    needs_pictures=True,
    reads=(*COLOR_TOPICS,),
)
def distinct_cameras(episode: CheckedEpisode) -> Found:
    """Two cameras in different places do not show the same pictures."""
    found = []
    for number, camera in enumerate(episode.cameras):
        for other in episode.cameras[number + 1 :]:
            first, second = episode.pictures(camera).cells, episode.pictures(other).cells
            count = min(len(first), len(second))
            if first.shape[1:] != second.shape[1:] or count < 2 or _same_place(episode, camera, other):
                continue
            value = _correlation(first[:count], second[:count])
            found.append(Measurement(value=value, detail=f"cameras {camera.name} and {other.name}"))
    return worst(*found)


def _same_place(episode: CheckedEpisode, camera: Camera, other: Camera) -> bool:
    poses = episode.columns.world_from_camera
    return bool(np.abs(poses[camera.name] - poses[other.name]).max(initial=0.0) < 1e-3)


def _correlation(a: NDArray[np.float32], b: NDArray[np.float32]) -> float:
    x, y = (a - a.mean()).reshape(-1), (b - b.mean()).reshape(-1)
    size = math.sqrt(_dot(x, x) * _dot(y, y))
    return _dot(x, y) / size if size > 0 else 0.0


def _dot(x: NDArray[np.float32], y: NDArray[np.float32]) -> float:
    return float(np.einsum("i,i->", x, y))  # no BLAS: its threads wait for each other on a busy machine


@check(
    group="pictures",
    measures="mean colour of the decoded pictures against the recorded histogram, of 255",
    needs_pictures=True,
    reads=(
        *COLOR_TOPICS,
        "/camera/{camera}/histogram",
    ),
)
def pixel_statistics(episode: CheckedEpisode) -> Found:
    """The histograms, counted before coding, are those of the pictures: catches swapped channels and other pictures."""
    found = []
    for camera in episode.cameras:
        decoded = episode.pictures(camera).mean
        if not len(decoded):
            continue
        counted = episode.recording.pixel_statistics(camera.name)
        if counted.num_images != (episode.num_frames + 1) // 2:  # every other picture is counted
            detail = f"camera {camera.name}: {counted.num_images} pictures are counted of {episode.num_frames}"
            found.append(Measurement(value=math.inf, detail=detail))
            continue
        levels = np.arange(256)
        recorded = (counted.counts * levels).sum(axis=1) / np.maximum(counted.counts.sum(axis=1), 1)
        off = np.abs(decoded.mean(axis=0) - recorded)
        channel = int(np.argmax(off))
        detail = f"camera {camera.name}, {('red', 'green', 'blue')[channel]}"
        found.append(Measurement(value=float(off[channel]), detail=detail))
    return worst(*found)
