"""The world and the renderer of a process, kept warm from one episode to the next."""

from __future__ import annotations

from contextlib import AbstractContextManager

from demorec.loop.prepare import make_renderer, make_world
from demorec.render import Renderer
from demorec.scene.episode import EpisodeInfo
from demorec.sim.world import World


class Workshop:
    """Makes world and renderer for the first episode, and others only for one that needs others; `close` frees both."""

    def __init__(self) -> None:
        self._world: World | None = None
        self._renderer: AbstractContextManager[Renderer | None] | None = None
        self._entered: Renderer | None = None
        self._key: object = None

    @property
    def is_warm(self) -> bool:
        """Whether an episode was equipped before."""
        return self._world is not None

    def equip(self, info: EpisodeInfo) -> tuple[World, Renderer | None]:
        """A world and a renderer for episodes like this one; the present ones where they fit."""
        config = info.config
        key = (info.robot, info.fps, config.get("joint_rate"), config.get("renderer"), bool(info.scene.cameras))
        if self._world is None or key != self._key:
            self.close()
            self._world, self._renderer, self._key = make_world(info), make_renderer(info), key
            self._entered = self._renderer.__enter__()
        return self._world, self._entered

    def close(self) -> None:
        """Free both; harmless when called twice."""
        if self._renderer is not None:
            self._renderer.__exit__(None, None, None)
        if self._world is not None:
            self._world.close()
        self._world = self._renderer = self._entered = self._key = None
