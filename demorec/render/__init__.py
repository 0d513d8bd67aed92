"""Images of bodies whose shapes and poses are plain data: colour, depth, segmentation, by any of several renderers.

Where shapes and poses come from does not matter to a renderer: the simulator (`demorec.sim.world.World`) provides them,
and `demorec.render.painter` brings the two together.
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

VisualKind = Literal["box", "sphere", "cylinder", "capsule", "mesh", "plane"]


@dataclass(frozen=True, kw_only=True)
class Visual:
    """One shape that can be seen.

    Attributes:
        link: Number of the link that carries it; the body's base is -1.
        kind: Which geometry; decides what `size` means.
        size: box: (x, y, z) full extents, metres; sphere: (radius,); cylinder and capsule: (radius, length) along z;
            mesh: (x, y, z) factors by which the file is scaled; plane (z = 0, without end): ().
        file: mesh: path of an OBJ, STL or COLLADA file; otherwise "".
        link_from_shape: Pose in the frame whose pose `Renderer.render` is given for the link.
        rgba: Colour, 0..1; nothing is drawn with alpha 0.
    """

    link: int
    kind: VisualKind
    size: tuple[float, ...]
    file: str = ""
    link_from_shape: Pose
    rgba: Rgba


@dataclass(frozen=True, kw_only=True)
class VisualBody:
    """All that can be seen of one body.

    Attributes:
        name: For messages.
        num_links: Beside the base.
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
        link_from_mount: Pose of the mount's frame in the one whose pose `Renderer.render` is given; None: the same.
    """

    body: int
    link: int
    link_from_mount: Pose | None = None


@dataclass(frozen=True, kw_only=True)
class RenderSetup:
    """What a renderer needs to know about a scene, but for where things are.

    Attributes:
        bodies: What can be seen. Segmentation images number a body by its place here.
        cameras: The cameras to draw, in order.
        mounts: Mount name -> the link that carries its cameras.
        light: Light and sky.
        depth, segmentation: Whether these are drawn beside colour.
        antialias: Whether edges are smoothed, where the renderer can.
    """

    bodies: tuple[VisualBody, ...]
    cameras: tuple[SceneCamera, ...]
    mounts: Mapping[str, Mount] = field(default_factory=dict)
    light: Light = field(default_factory=Light)
    depth: bool = False
    segmentation: bool = False
    antialias: bool = True


class Renderer(Protocol):
    """Draws bodies; a context manager, warm across scenes.

    `setup` is called for each scene and whenever its looks change, `render` at each frame. Images are a function of
    setup and poses alone, on one type of machine.
    """

    def setup(self, setup: RenderSetup) -> None:
        """Take over a scene; RenderError names a shape, mesh or camera that cannot be drawn."""

    def render(self, poses: Array) -> dict[str, CameraImages]:
        """Camera name -> images, in the order of the cameras.

        Args:
            poses: (n, 7) position (metres) and quaternion xyzw in the world: of each body in turn its base, then its
                links; `first_rows` tells where each body begins.
        """

    def close(self) -> None:
        """Free what is held; harmless when called twice."""

    def __enter__(self) -> Renderer: ...

    def __exit__(self, *exc: object) -> None: ...


def first_rows(bodies: Sequence[VisualBody]) -> list[int]:
    """Row of each body's base in the poses that `Renderer.render` is given; link n is n + 1 rows below it."""
    return list(accumulate((1 + body.num_links for body in bodies), initial=0))[:-1]


MAX_SAMPLES = 1 << 28
"""Of an image; beyond, buffers would take several GB. (PyBullet ends the process on sizes that it cannot draw.)"""


def check_setup(setup: RenderSetup) -> None:
    """Raise RenderError for a camera that cannot draw, or whose mount does not exist."""
    for camera in setup.cameras:
        name, size = f"Camera {camera.name!r}", f"{camera.width}x{camera.height}"
        if camera.width < 1 or camera.height < 1:
            raise RenderError(f"{name} is {size}: both sizes must be at least 1.")
        samples = camera.width * camera.height * (4 if setup.antialias else 1)
        if samples > MAX_SAMPLES:
            raise RenderError(
                f"{name} is {size}, {samples} samples an image; allowed are {MAX_SAMPLES}: make it smaller"
                f"{' or draw without antialiasing' if setup.antialias else ''}."
            )
        if not 0 < camera.near < camera.far < math.inf:
            raise RenderError(f"{name} clips at near {camera.near} m and far {camera.far} m: 0 < near < far is needed.")
        if not 0 < camera.fov_y < math.pi:
            raise RenderError(f"{name} has a field of view of {camera.fov_y} rad: allowed is 0 to pi.")
        if camera.mount != "world" and camera.mount not in setup.mounts:
            raise RenderError(
                f"{name} is mounted on the link {camera.mount!r}, which the robot does not have; allowed are world, "
                f"{', '.join(setup.mounts)}."
            )


def world_from_camera(setup: RenderSetup, camera: SceneCamera, poses: Array) -> Pose:
    """Pose of a camera, OpenCV axes, with `poses` as `Renderer.render` is given them."""
    if camera.mount == "world":
        return camera.mount_from_camera
    mount = setup.mounts[camera.mount]
    row = poses[first_rows(setup.bodies)[mount.body] + 1 + mount.link]
    world_from_link = Pose(position=row[:3], quat_xyzw=row[3:])
    world_from_mount = world_from_link if mount.link_from_mount is None else world_from_link @ mount.link_from_mount
    return world_from_mount @ camera.mount_from_camera
