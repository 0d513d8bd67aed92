"""Do cameras see what their calibration says: K, extrinsics, names, depth units, images the right way round."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from demorec.check.base import (
    Found,
    Measurement,
    NotMeasured,
    alignment_check,
    calibration_check,
    worst_frame,
)
from demorec.check.cells import ImageKind
from demorec.check.drawn import ImageComparison, judge_lag
from demorec.check.episode import CheckedEpisode
from demorec.check.full_size import FullSize
from demorec.check.images import of_each_camera
from demorec.check.rows import displacement, matrices
from demorec.core.errors import RecordingError
from demorec.core.geometry import Array
from demorec.episode.camera_error import stated_error
from demorec.episode.scene import SceneCamera
from demorec.mcap import channels

UNRELATED = 16.0
"""Root mean square difference of all images from the drawn ones, of 255, from which on they show something else."""


@calibration_check(
    measures="K of the camera's message against size and field of view",
    unit="px",
    warn=0.01,
    fail=0.5,
)
def intrinsics(episode: CheckedEpisode) -> Iterator[Found]:
    """The calibration message agrees with the scene's camera and the images' size."""
    for camera in episode.cameras:
        scan = episode.scan.get(channels.camera_topic(camera.name, "camera_info"))
        if scan is None or not scan.first:
            yield Measurement(value=math.inf, detail=f"camera {camera.name} has no calibration")
            continue
        (height, width), recorded = episode.recording.calibration(camera.name)
        settings = episode.recording.video_settings(camera.name)
        off = float(np.abs(recorded - camera.intrinsics).max())
        off = max(off, abs(width - settings.width), abs(height - settings.height))
        yield Measurement(value=off, detail=f"camera {camera.name}")


@calibration_check(
    measures="extrinsics against the camera's mount on the robot",
    unit="m",
    warn=1e-5,
    fail=1e-3,
)
def extrinsics(episode: CheckedEpisode) -> Iterator[Found]:
    """Recorded camera poses are those of the mount, by forward kinematics (0.1 m per rad of rotation)."""
    for camera in episode.cameras:
        off = displacement(matrices(episode.columns.world_from_camera[camera.name]), _expected(episode, camera))
        yield worst_frame(off, f"camera {camera.name}")


def _expected(episode: CheckedEpisode, camera: SceneCamera) -> Array:
    mounted = camera.mount_from_camera.matrix()[None]
    if camera.mount == "world":
        return np.broadcast_to(mounted, (episode.num_frames, 4, 4))
    try:
        return np.asarray(episode.world_from_link(camera.mount) @ mounted)
    except RecordingError as error:
        if not isinstance(error.__cause__, KeyError):  # damage is no wrong camera
            raise
        return np.full((episode.num_frames, 4, 4), np.inf)


def _allowance(episode: CheckedEpisode, camera: SceneCamera) -> float:
    """By how much images may be shifted, of their height: older recordings do not tell how they are turned."""
    if stated_error(camera.name, episode.info.behaviour) is not None:
        return 0.0
    angle = episode.info.behaviour.get(f"calibration_{camera.name}_angle", 0.0)
    return angle / (2 * math.tan(camera.fov_y / 2))


@calibration_check(
    measures="shift of the images against what the recorded numbers make of them, of the height",
    unit="%",
    needs_images=True,
)
@of_each_camera(CheckedEpisode.compared)
def projection(episode: CheckedEpisode, camera: SceneCamera, compared: ImageComparison) -> Found:
    """Recorded poses, projected with K and extrinsics, fall where the image has them.

    The images are drawn anew from joints, objects, K and mounts, and the shift that fits best is measured over all
    frames. Catches mirrored and flipped images, a wrong K, images or the name of another camera, swapped colours.
    Where the episode has a calibration error of its own, which it names, that much is allowed.
    """
    usual = float(np.median(compared.unlike))
    if usual > UNRELATED:
        detail = f"camera {camera.name}: its images show something else than the recorded numbers ({usual:.0f})"
        return Measurement(value=math.inf, frame=int(np.argmax(compared.unlike)), detail=detail)
    recorded = (episode.recording.calibration(camera.name)[1] - camera.intrinsics)[:2, 2] / camera.height
    off = float(np.linalg.norm(compared.shift - recorded))
    detail = f"camera {camera.name}: {off * camera.height:.2f} px"
    return Measurement(value=100 * max(off - _allowance(episode, camera), 0.0), detail=detail)


@calibration_check(
    measures="how far things are from where the recorded numbers put them, in some images at full size",
    unit="px",
    needs_images=True,
)
@of_each_camera(CheckedEpisode.full_size)
def image_placement(episode: CheckedEpisode, camera: SceneCamera, compared: FullSize) -> Found:
    """Nothing is shifted by a part of a pixel, turned, sheared, or of another size or aspect than K makes it."""
    return Measurement(value=compared.displacement, frame=int(compared.frames[0]), detail=f"camera {camera.name}")


@calibration_check(
    measures="share of the pixels of some images of depth or labels that are not what is drawn at full size",
    needs_images=True,
)
def pixels_as_drawn(episode: CheckedEpisode) -> Iterator[Found]:
    """Depth and labels are exact to the pixel: catches offsets, steps, noise, filters, smeared and grown edges."""
    for camera in episode.cameras:
        for kind in episode.kinds(camera.name)[1:]:
            found = episode.pixels_off(camera, kind)
            what = f"camera {camera.name}, {kind}"
            yield found if isinstance(found, NotMeasured) else worst_frame(found[0], what, frames=found[1])


@alignment_check(
    measures="lag between images and numbers, frames",
    needs_images=True,
)
def image_lag(episode: CheckedEpisode) -> Iterator[Found]:
    """Image t shows state t: robot and objects are where the numbers of the same frame put them.

    Colour, depth and labels of each camera against the images that are drawn of the frames before and after. Where
    less than a dozen frames show any motion nothing is measured.
    """
    for camera in episode.cameras:
        for kind in episode.kinds(camera.name):
            what = f"camera {camera.name}, {kind}"
            yield judge_lag(episode.compared(camera, kind), what, f"camera {camera.name}")


@calibration_check(
    measures="share of a depth image that is not what the recorded numbers make of it",
    needs_images=True,
)
def depth_matches_scene(episode: CheckedEpisode) -> Iterator[Found]:
    """Depth is metres along the optical axis, in every frame: catches other units, distances along the ray, flips."""
    return _strays(episode, "depth")


@calibration_check(
    measures="share of an image of labels that is not what the recorded numbers make of it",
    needs_images=True,
)
def segmentation_matches_scene(episode: CheckedEpisode) -> Iterator[Found]:
    """Every pixel has the label of the body that geometry puts there, in every frame."""
    return _strays(episode, "labels")


def _strays(episode: CheckedEpisode, kind: ImageKind) -> Iterator[Found]:
    """The largest share of any image of a kind, of each camera."""
    for camera in episode.cameras:
        if kind in episode.kinds(camera.name):
            share = episode.strays(camera, kind)
            yield share if isinstance(share, NotMeasured) else worst_frame(share, f"camera {camera.name}")
