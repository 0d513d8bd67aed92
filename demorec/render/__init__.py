"""Images of bodies from shapes and poses as plain data: colour, depth and segmentation, by any of several renderers.

A renderer does not depend on the source of shapes and poses: the simulator (`demorec.sim.world.World`) provides them,
and `demorec.render.painter` connects the two.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import accumulate
from typing import Literal, Protocol

from demorec.core.errors import RenderError
from demorec.core.geometry import Array, Pose
from demorec.episode.episode import CameraImages
from demorec.episode.scene import Light, Rgba, SceneCamera, Texture

VisualKind = Literal["box", "sphere", "cylinder", "capsule", "mesh"]


@dataclass(frozen=True, kw_only=True)
class Visual:
    """One visible shape.

    Attributes:
        link: Number of the link that carries it; the body's base is -1.
        kind: Geometry; decides the meaning of `size`.
        size: box: (x, y, z) full extents, metres; sphere: (radius,); cylinder and capsule: (radius, length) along z;
            mesh: (x, y, z) scale factors of the file.
        file: mesh: path of an OBJ, STL or COLLADA file; otherwise "".
        link_from_shape: Pose in the link frame of `Renderer.render`.
        rgba: Colour, 0..1; alpha 0 is invisible.
    """

    link: int
    kind: VisualKind
    size: tuple[float, ...]
    file: str = ""
    link_from_shape: Pose
    rgba: Rgba


@dataclass(frozen=True, kw_only=True)
class VisualBody:
    """All visible shapes of one body.

    Attributes:
        name: Name for messages.
        num_links: Number of links, base excluded.
        is_fixed: Whether physics cannot move its base.
        visuals: Its shapes.
        texture: Procedural texture that covers them, or None.
    """

    name: str
    num_links: int
    is_fixed: bool
    visuals: tuple[Visual, ...]
    texture: Texture | None = None


@dataclass(frozen=True, kw_only=True)
class Mount:
    """A link that can carry cameras.

    Attributes:
        body, link: Numbers of the body and of its link; the base is -1.
        link_from_mount: Pose of the mount's frame in the link frame of `Renderer.render`; None: identity.
    """

    body: int
    link: int
    link_from_mount: Pose | None = None


@dataclass(frozen=True, kw_only=True)
class RenderSetup:
    """Description of a scene for a renderer, without poses.

    Attributes:
        bodies: Visible bodies. Segmentation images number a body by its index here.
        cameras: The cameras to draw, in order.
        mounts: Mount name -> the link that carries its cameras.
        light: Light and sky.
        depth, segmentation: Whether these are drawn in addition to colour.
        antialias: Whether edges are smoothed, if the renderer supports it.
    """

    bodies: tuple[VisualBody, ...]
    cameras: tuple[SceneCamera, ...]
    mounts: Mapping[str, Mount] = field(default_factory=dict)
    light: Light = field(default_factory=Light)
    depth: bool = False
    segmentation: bool = False
    antialias: bool = True


class Renderer(Protocol):
    """Interface of renderers: context managers that are reused across scenes.

    `setup` is called for each scene, `render` at each frame. Images are a function of setup and poses alone, on one
    type of machine.
    """

    def setup(self, setup: RenderSetup) -> None:
        """Load a scene; RenderError names a shape, mesh or camera that cannot be drawn."""

    def render(self, poses: Array) -> dict[str, CameraImages]:
        """Draw camera name -> images, in the order of the cameras.

        Args:
            poses: (n, 7) position (metres) and quaternion xyzw in the world: for each body its base, then its links;
                `first_rows` returns where each body begins.
        """

    def close(self) -> None:
        """Free all resources; safe to call twice."""

    def __enter__(self) -> Renderer: ...

    def __exit__(self, *exc: object) -> None: ...


def first_rows(bodies: Sequence[VisualBody]) -> list[int]:
    """Compute the row of each body's base in the poses of `Renderer.render`; link n is n + 1 rows below it."""
    return list(accumulate((1 + body.num_links for body in bodies), initial=0))[:-1]


MAX_SAMPLES = 1 << 28
"""Maximum samples of an image; beyond it, buffers would take several GB. (PyBullet aborts the process at sizes it
cannot draw.)"""


def check_setup(setup: RenderSetup) -> None:
    """Raise RenderError if a camera cannot be drawn or its mount does not exist."""
    for camera in setup.cameras:
        name, size = f"Camera {camera.name!r}", f"{camera.width}x{camera.height}"
        if camera.width < 1 or camera.height < 1:
            raise RenderError(f"{name} is {size}: both sizes must be at least 1.")
        samples = camera.width * camera.height * (4 if setup.antialias else 1)
        if samples > MAX_SAMPLES:
            raise RenderError(
                f"{name} is {size}, {samples} samples per image; the maximum is {MAX_SAMPLES}: make it smaller"
                f"{' or draw without antialiasing' if setup.antialias else ''}."
            )
        if not 0 < camera.near < camera.far < math.inf:
            raise RenderError(f"{name} clips at near {camera.near} m and far {camera.far} m: choose 0 < near < far.")
        if not 0 < camera.fov_y < math.pi:
            raise RenderError(f"{name} has a field of view of {camera.fov_y} rad: choose one between 0 and pi.")
        if camera.mount != "world" and camera.mount not in setup.mounts:
            raise RenderError(
                f"{name} is mounted on the link {camera.mount!r}, which the robot does not have; use world, "
                f"{', '.join(setup.mounts)}."
            )


def world_from_camera(setup: RenderSetup, camera: SceneCamera, poses: Array) -> Pose:
    """Compute the pose of a camera, OpenCV axes, from the `poses` of `Renderer.render`."""
    if camera.mount == "world":
        return camera.mount_from_camera
    mount = setup.mounts[camera.mount]
    row = poses[first_rows(setup.bodies)[mount.body] + 1 + mount.link]
    world_from_link = Pose(position=row[:3], quat_xyzw=row[3:])
    world_from_mount = world_from_link if mount.link_from_mount is None else world_from_link @ mount.link_from_mount
    return world_from_mount @ camera.mount_from_camera
