"""What all renderers ask of a setup: cameras that can draw, on mounts that exist."""

from __future__ import annotations

import math

from demorec.core.errors import RenderError
from demorec.core.geometry import Array, Pose
from demorec.episode.scene import SceneCamera
from demorec.render import RenderSetup, first_rows

MAX_SAMPLES = 1 << 28
"""Of a picture; beyond, buffers would take several GB. (PyBullet ends the process on sizes that it cannot draw.)"""


def check_setup(setup: RenderSetup) -> None:
    """Raise RenderError for a camera that cannot draw, or whose mount does not exist."""
    for camera in setup.cameras:
        _check_camera(camera, antialias=setup.antialias)
        if camera.mount != "world" and camera.mount not in setup.mounts:
            raise RenderError(
                f"The camera {camera.name!r} is mounted on the link {camera.mount!r}, which the robot does not have; "
                f"allowed are world, {', '.join(setup.mounts)}."
            )


def _check_camera(camera: SceneCamera, *, antialias: bool) -> None:
    """Raise RenderError for a camera that cannot draw: no pixels, too many, or clipping distances that cross."""
    if camera.width < 1 or camera.height < 1:
        raise RenderError(f"Camera {camera.name!r} is {camera.width}x{camera.height}: both sizes must be at least 1.")
    samples = camera.width * camera.height * (4 if antialias else 1)
    if samples > MAX_SAMPLES:
        raise RenderError(
            f"Camera {camera.name!r} is {camera.width}x{camera.height}, {samples} samples a picture; allowed are "
            f"{MAX_SAMPLES}: make it smaller{' or draw without antialiasing' if antialias else ''}."
        )
    if not 0 < camera.near < camera.far < math.inf:
        raise RenderError(
            f"Camera {camera.name!r} clips at near {camera.near} m and far {camera.far} m: 0 < near < far is needed."
        )
    if not 0 < camera.fov_y < math.pi:
        raise RenderError(f"Camera {camera.name!r} has a field of view of {camera.fov_y} rad: allowed is 0 to pi.")


def world_from_camera(setup: RenderSetup, camera: SceneCamera, poses: Array) -> Pose:
    """Pose of a camera, OpenCV axes, with `poses` as `Renderer.render` is given them."""
    if camera.mount == "world":
        return camera.mount_from_camera
    mount = setup.mounts[camera.mount]
    row = poses[first_rows(setup.bodies)[mount.body] + 1 + mount.link]
    world_from_link = Pose(position=row[:3], quat_xyzw=row[3:])
    world_from_mount = world_from_link if mount.link_from_mount is None else world_from_link @ mount.link_from_mount
    return world_from_mount @ camera.mount_from_camera
