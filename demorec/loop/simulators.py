"""The world and the renderer of a process, kept warm from one episode to the next."""

from __future__ import annotations

from demorec.episode.episode import SimulatedInfo
from demorec.loop.prepare import make_world
from demorec.render import Renderer
from demorec.render.warm import WarmRenderer
from demorec.sim.world import World


class SimulatorCache:
    """Makes world and renderer for the first episode, and others only for one that needs others; `close` frees both."""

    def __init__(self) -> None:
        self._world: World | None = None
        self._renderers = WarmRenderer()
        self._key: object = None

    @property
    def is_warm(self) -> bool:
        """Whether an episode was simulated before."""
        return self._world is not None

    def acquire(self, info: SimulatedInfo) -> tuple[World, Renderer | None]:
        """A world and a renderer (None without cameras) for episodes like this one; the present ones where they fit.

        Raises:
            ConfigError: An unknown renderer.
            MissingDependencyError, RenderError: It cannot work on this machine.
        """
        key = (info.robot, info.fps, info.config.get("joint_rate"))
        if self._world is None or key != self._key:
            self.close()
            self._world, self._key = make_world(info), key
        name = str(info.config.get("renderer", "raster"))
        renderer = self._renderers.of(name) if info.scene.cameras else None
        return self._world, renderer

    def close(self) -> None:
        """Free both; harmless when called twice."""
        self._renderers.close()
        if self._world is not None:
            self._world.close()
        self._world = self._key = None
