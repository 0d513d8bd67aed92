"""Pictures of a world's state: colour, depth, segmentation, through any of several renderers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

from demorec.episode import CameraImages
from demorec.scene import Camera, Light, Texture


@dataclass(frozen=True, kw_only=True)
class RenderSetup:
    """What a renderer needs to know about a freshly built world.

    Attributes:
        client: The PyBullet client (`BulletClient`) that holds the scene.
        cameras: The cameras to draw, in order.
        mounts: mount name -> (body index, link index) of the links that carry cameras; base link is -1.
        light: Light and sky.
        depth, segmentation: Whether these are drawn beside colour.
        antialias: Whether edges are smoothed, where the renderer can.
        textures: body index -> procedural texture, of the bodies that have one (`World.textures`): PyBullet cannot
            be asked for the pixels of a texture that was set on a shape.
    """

    client: Any
    cameras: tuple[Camera, ...]
    mounts: Mapping[str, tuple[int, int]] = field(default_factory=dict)
    light: Light = field(default_factory=Light)
    depth: bool = False
    segmentation: bool = False
    antialias: bool = True
    textures: Mapping[int, Texture] = field(default_factory=dict)


class Renderer(Protocol):
    """Draws the present state of a PyBullet client; a context manager, warm across scenes.

    `setup` is called after each reset of the scene, `render` at each frame. Pictures are a function of the
    client's state, the light and the cameras alone, on one type of machine.
    """

    def setup(self, setup: RenderSetup) -> None:
        """Take over a freshly built scene; RenderError names a shape or mesh that cannot be drawn."""

    def render(self) -> dict[str, CameraImages]:
        """Camera name -> images of the present state, in the order of the cameras."""

    def close(self) -> None:
        """Free what is held; harmless when called twice."""

    def __enter__(self) -> Renderer: ...

    def __exit__(self, *exc: object) -> None: ...


def prepare(renderer: str) -> None:
    """Do what a renderer needs once on a machine, before several processes that use it start: compiling, for raster."""
    if renderer == "raster":
        from demorec.render.raster import warm_up

        warm_up()
