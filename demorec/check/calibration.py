"""Do cameras see what their calibration says: K, extrinsics, names, depth units, pictures the right way round."""

from __future__ import annotations

import math

import numpy as np

from demorec.check.base import COLOR_TOPICS, Found, Measurement, NotMeasured, check, worst
from demorec.check.cells import ImageKind
from demorec.check.episode import CheckedEpisode
from demorec.check.rows import displacement, matrices
from demorec.errors import RecordingError
from demorec.geometry import Array
from demorec.recording import channels
from demorec.scene.camera_error import told_error
from demorec.scene.scene import Camera

UNRELATED = 16.0
"""Root mean square difference of all pictures from the drawn ones, of 255, from which on they show something else."""


@check(
    group="calibration",
    measures="K of the camera's message against size and field of view",
    unit="px",
    warn=0.01,
    fail=0.5,
    reads=(
        "/camera/{camera}/camera_info",
        "info.scene.cameras.fov_y",
        "info.scene.cameras.width",
        "info.scene.cameras.height",
    ),
)
def intrinsics(episode: CheckedEpisode) -> Found:
    """The calibration message agrees with the scene's camera and the pictures' size."""
    found = []
    for camera in episode.cameras:
        scan = episode.scan.get(channels.camera_topic(camera.name, "camera_info"))
        if scan is None or not scan.first:
            found.append(Measurement(value=math.inf, detail=f"camera {camera.name} has no calibration"))
            continue
        told = episode.recording.calibration(camera.name)
        settings = episode.recording.video_settings(camera.name)
        off = float(np.abs(told.intrinsics - camera.intrinsics).max())
        off = max(off, abs(told.width - settings.width), abs(told.height - settings.height))
        found.append(Measurement(value=off, detail=f"camera {camera.name}"))
    return worst(*found)


@check(
    group="calibration",
    measures="extrinsics against the camera's mount on the robot",
    unit="m",
    warn=1e-5,
    fail=1e-3,
    reads=(
        "/camera/{camera}/pose",
        "info.scene.cameras.mount",
        "info.scene.cameras.mount_from_camera",
        "info.scene.robot.world_from_base",
    ),
)
def extrinsics(episode: CheckedEpisode) -> Found:
    """Recorded camera poses are those of the mount, by forward kinematics (0.1 m per rad of rotation)."""
    found = []
    for camera in episode.cameras:
        off = displacement(matrices(episode.columns.world_from_camera[camera.name]), _expected(episode, camera))
        if len(off):
            frame = int(np.argmax(off))
            found.append(Measurement(value=float(off[frame]), frame=frame, detail=f"camera {camera.name}"))
    return worst(*found)


def _expected(episode: CheckedEpisode, camera: Camera) -> Array:
    mounted = camera.mount_from_camera.matrix()[None]
    if camera.mount == "world":
        return np.broadcast_to(mounted, (episode.num_frames, 4, 4))
    try:
        link = episode.base_from_link(camera.mount)
    except RecordingError as error:
        if not isinstance(error.__cause__, KeyError):  # damage is no wrong camera
            raise
        return np.full((episode.num_frames, 4, 4), np.inf)
    return np.asarray(episode.world_from_base @ link @ mounted)


def _allowance(episode: CheckedEpisode, camera: Camera) -> float:
    """By how much pictures may be shifted, of their height: older recordings do not tell how they are turned."""
    if told_error(camera.name, episode.info.behaviour) is not None:
        return 0.0
    angle = episode.info.behaviour.get(f"calibration_{camera.name}_angle", 0.0)
    return angle / (2 * math.tan(camera.fov_y / 2))


@check(
    group="calibration",
    measures="shift of the pictures against what the recorded numbers make of them, of the height",
    unit="%",
    needs_pictures=True,
    reads=(
        *COLOR_TOPICS,
        "/camera/{camera}/camera_info",
        "info.scene.cameras",
        "info.behaviour",
    ),
)
def projection(episode: CheckedEpisode) -> Found:
    """Recorded poses, projected with K and extrinsics, fall where the picture has them.

    The pictures are drawn anew from joints, objects, K and mounts, and the shift that fits best is measured over all
    frames. Catches mirrored and flipped pictures, a wrong K, pictures or the name of another camera, swapped colours.
    Where the episode has a calibration error of its own, which it names, that much is allowed.
    """
    found: list[Found] = []
    for camera in episode.cameras:
        compared = episode.compared(camera)
        if isinstance(compared, NotMeasured):
            found.append(compared)
            continue
        usual = float(np.median(compared.unlike))
        if usual > UNRELATED:
            detail = f"camera {camera.name}: its pictures show something else than the recorded numbers ({usual:.0f})"
            found.append(Measurement(value=math.inf, frame=int(np.argmax(compared.unlike)), detail=detail))
            continue
        told = (episode.recorded_intrinsics(camera.name) - camera.intrinsics)[:2, 2] / camera.height
        off = float(np.linalg.norm(compared.shift - told))
        detail = f"camera {camera.name}: {off * camera.height:.2f} px"
        found.append(Measurement(value=100 * max(off - _allowance(episode, camera), 0.0), detail=detail))
    return worst(*found)


@check(
    group="calibration",
    measures="size of what the pictures show against what the recorded numbers make of it, off 1",
    needs_pictures=True,
    reads=(
        *COLOR_TOPICS,
        "/camera/{camera}/camera_info",
        "info.scene.cameras.fov_y",
    ),
)
def projected_size(episode: CheckedEpisode) -> Found:
    """Things are as large in the picture as their distance and K make them: catches a wrong focal length or scale."""
    found: list[Found] = []
    for camera in episode.cameras:
        compared = episode.compared(camera)
        if isinstance(compared, NotMeasured):
            found.append(compared)
            continue
        told = float(episode.recorded_intrinsics(camera.name)[1, 1] / camera.intrinsics[1, 1])
        size = (1 + compared.scale) / told
        detail = f"camera {camera.name}: things appear {size:.3f} times as large"
        found.append(Measurement(value=abs(size - 1), detail=detail))
    return worst(*found)


@check(
    group="alignment",
    measures="lag between pictures and numbers, frames",
    needs_pictures=True,
    reads=(
        *COLOR_TOPICS,
        "/camera/{camera}/depth",
        "/camera/{camera}/segmentation",
        "/joint_states",
        "/object/{body}/pose",
    ),
)
def picture_lag(episode: CheckedEpisode) -> Found:
    """Picture t shows state t: robot and objects are where the numbers of the same frame put them.

    Colour, depth and labels of each camera against the pictures that are drawn of the frames before and after. Where
    less than a dozen frames show any motion nothing is told.
    """
    found: list[Found] = []
    for camera in episode.cameras:
        for kind in episode.kinds(camera.name):
            compared = episode.compared(camera, kind)
            if isinstance(compared, NotMeasured):
                found.append(compared)
            elif compared.lag is None:
                found.append(NotMeasured(why=f"too little moves before camera {camera.name}"))
            else:
                detail = f"camera {camera.name}, {kind}: {compared.lag:+.2f} frames late"
                found.append(Measurement(value=abs(compared.lag), detail=detail))
    return worst(*found)


@check(
    group="calibration",
    measures="share of a depth picture that is not what the recorded numbers make of it",
    needs_pictures=True,
    reads=(
        "/camera/{camera}/depth",
        "/joint_states",
        "/object/{body}/pose",
        "info.scene.bodies.shape",
        "info.scene.cameras.far",
    ),
)
def depth_matches_scene(episode: CheckedEpisode) -> Found:
    """Depth is metres along the optical axis, in every frame: catches other units, distances along the ray, flips."""
    return _strays(episode, "depth")


@check(
    group="calibration",
    measures="share of a picture of labels that is not what the recorded numbers make of it",
    needs_pictures=True,
    reads=(
        "/camera/{camera}/segmentation",
        "/joint_states",
        "/object/{body}/pose",
        "info.scene.bodies.shape",
    ),
)
def segmentation_matches_scene(episode: CheckedEpisode) -> Found:
    """Every pixel has the label of the body that geometry puts there, in every frame."""
    return _strays(episode, "labels")


def _strays(episode: CheckedEpisode, kind: ImageKind) -> Found:
    """The largest share of any picture of a kind."""
    found: list[Found] = []
    for camera in episode.cameras:
        if kind not in episode.kinds(camera.name):
            continue
        share = episode.strays(camera, kind)
        if isinstance(share, NotMeasured):
            found.append(share)
            continue
        frame = int(np.argmax(share))
        found.append(Measurement(value=float(share[frame]), frame=frame, detail=f"camera {camera.name}"))
    return worst(*found)
