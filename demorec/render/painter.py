"""The one place where a world and a renderer meet: what is drawn, by which cameras, and where these are believed to be.

Generation, environments, replay and re-rendering draw through it, with a renderer that is kept warm.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Protocol

from demorec.core.files import Closing
from demorec.core.geometry import Array, Pose
from demorec.core.tables import RENDERERS
from demorec.episode.episode import CameraImages
from demorec.episode.scene import Scene, SceneCamera
from demorec.render import Mount, Renderer, RenderSetup, VisualBody


class Drawable(Protocol):
    """What can be drawn: a simulated world, or one at recorded states."""

    @property
    def scene(self) -> Scene:
        """Its light is drawn; its cameras are where they are believed to be."""

    def visuals(self) -> tuple[VisualBody, ...]:
        """What can be seen at present."""

    def mounts(self) -> Mapping[str, Mount]:
        """The links that can carry cameras."""

    def poses(self) -> Array:
        """(n, 7) where everything is at present, as `Renderer.render` takes it."""


class Painter:
    """Draws worlds, one after the other, through a renderer, which it leaves open.

    Args:
        renderer: Entered; kept warm from one world to the next.
        cameras: Where the cameras really are.
        true_from_recorded: Camera name -> calibration error, of the cameras that have one.
        depth, segmentation: Whether these are drawn beside colour.
        antialias: Whether edges are smoothed, where the renderer can.
    """

    def __init__(
        self,
        renderer: Renderer,
        cameras: tuple[SceneCamera, ...],
        *,
        true_from_recorded: Mapping[str, Pose] | None = None,
        depth: bool = False,
        segmentation: bool = False,
        antialias: bool = True,
    ) -> None:
        self._renderer = renderer
        self._true_from_recorded = true_from_recorded or {}
        self._world: Drawable | None = None
        self._setup = RenderSetup(
            bodies=(),
            cameras=cameras,
            depth=depth,
            segmentation=segmentation,
            antialias=antialias,
        )

    def setup(self, world: Drawable) -> None:
        """Take over a world in a new scene; it is drawn from now on.

        Raises:
            RenderError: The renderer cannot draw a shape or camera.
        """
        self._world = world
        self._setup = replace(self._setup, bodies=world.visuals(), mounts=world.mounts(), light=world.scene.light)
        self._renderer.setup(self._setup)

    def images(self) -> dict[str, CameraImages]:
        """Camera name -> images of the world's present state, with the poses at which the cameras are believed to be.

        Raises:
            RuntimeError: `setup` was not called.
            RenderError: A shape that was changed since cannot be drawn.
        """
        if self._world is None:
            raise RuntimeError("the painter has no world: call setup first")
        bodies = self._world.visuals()
        if bodies != self._setup.bodies:  # a colour or shape was changed
            self._setup = replace(self._setup, bodies=bodies)
            self._renderer.setup(self._setup)
        images = self._renderer.render(self._world.poses())
        for name, error in self._true_from_recorded.items():
            images[name] = replace(images[name], world_from_camera=images[name].world_from_camera @ error)
        return images


class WarmRenderer(Closing):
    """Hands out one renderer again and again, and another only when another name is asked for; a context manager.

    What it has read of meshes and textures is not read again.
    """

    def __init__(self) -> None:
        self._name = ""
        self._renderer: Renderer | None = None

    def of(self, name: str) -> Renderer:
        """The entered renderer of a row of the renderers' table; it stays open, one of another name is closed.

        Raises:
            ConfigError: There is none of that name.
            MissingDependencyError, RenderError: It cannot work on this machine.
        """
        if self._renderer is None or name != self._name:
            self.close()
            self._renderer, self._name = RENDERERS.load(name)().__enter__(), name
        return self._renderer

    def close(self) -> None:
        """Free the renderer; harmless when called twice."""
        renderer, self._renderer = self._renderer, None
        if renderer is not None:
            renderer.close()
