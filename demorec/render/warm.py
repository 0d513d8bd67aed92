"""Renderers that are ready: warmed up once on a machine, and kept warm from one recording to the next."""

from __future__ import annotations

from typing import Self

from demorec.core.tables import RENDERERS
from demorec.render import Renderer


class WarmRenderer:
    """Hands out one renderer again and again, and another only when another name is asked for; a context manager.

    What it has read of meshes and textures is not read again.
    """

    def __init__(self) -> None:
        self._name = ""
        self._renderer: Renderer | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

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


def warm_up_renderer(renderer: str) -> None:
    """Do what a renderer needs once on a machine, before several processes that use it start: compiling, for raster."""
    if renderer == "raster":
        from demorec.render.raster import warm_up

        warm_up()
