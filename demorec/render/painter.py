"""The only connection between a world and a renderer: bodies, cameras, and the recorded camera poses.

Generation, environments, replay and re-rendering draw through it, with a reused renderer.
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
    """A simulated world, or one at recorded states, that can be drawn."""

    @property
    def scene(self) -> Scene:
        """Scene with the light to draw and the recorded camera poses."""

    def visuals(self) -> tuple[VisualBody, ...]:
        """Return the visible bodies."""

    def mounts(self) -> Mapping[str, Mount]:
        """Return the links that can carry cameras."""

    def poses(self) -> Array:
        """Return the current (n, 7) poses, as `Renderer.render` takes them."""


class Painter:
    """Draws a sequence of worlds through a renderer, which it leaves open.

    Args:
        renderer: Entered renderer, reused from one world to the next.
        cameras: True camera poses.
        true_from_recorded: Camera name -> calibration error; only cameras that have one.
        depth, segmentation: Whether these are drawn in addition to colour.
        antialias: Whether edges are smoothed, if the renderer supports it.
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
        self._world: Drawable
        self._setup = RenderSetup(
            bodies=(),
            cameras=cameras,
            depth=depth,
            segmentation=segmentation,
            antialias=antialias,
        )

    def setup(self, world: Drawable) -> None:
        """Load a world with a new scene, to be drawn until the next call.

        Raises:
            RenderError: The renderer cannot draw a shape or camera.
        """
        self._world = world
        bodies, mounts, light = world.visuals(), world.mounts(), world.scene.light
        self._renderer.setup(replace(self._setup, bodies=bodies, mounts=mounts, light=light))

    def images(self) -> dict[str, CameraImages]:
        """Draw the state of the world of `setup`: camera name -> images, with the recorded poses of the cameras."""
        images = self._renderer.render(self._world.poses())
        for name, error in self._true_from_recorded.items():
            images[name] = replace(images[name], world_from_camera=images[name].world_from_camera @ error)
        return images


class WarmRenderer(Closing):
    """Context manager that returns the same renderer until another name is requested.

    Meshes and textures already read are not read again.
    """

    def __init__(self) -> None:
        self._name = ""
        self._renderer: Renderer | None = None

    def of(self, name: str) -> Renderer:
        """Return the entered renderer of a row in the renderers' table; closes one of another name.

        Raises:
            ConfigError: Unknown name.
            MissingDependencyError, RenderError: It does not work on this machine.
        """
        if self._renderer is None or name != self._name:
            self.close()
            self._renderer, self._name = RENDERERS.load(name)().__enter__(), name
        return self._renderer

    def close(self) -> None:
        """Free the renderer; safe to call twice."""
        renderer, self._renderer = self._renderer, None
        if renderer is not None:
            renderer.close()
