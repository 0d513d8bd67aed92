"""Run episodes in tests, by default without images."""

from __future__ import annotations

from typing import Any

from demorec.core.config import EpisodePlan, GenerateConfig
from demorec.episode.episode import Frame, Outcome
from demorec.loop import PreparedEpisode, ScriptAgent, Session, SimulatorCache, prepare
from demorec.sim.world import World


def episode(index: int = 0, *, attempt: int = 0, **config: Any) -> PreparedEpisode:
    """Prepare an episode; no cameras by default."""
    config.setdefault("cameras", ())
    return prepare(EpisodePlan(config=GenerateConfig(**config), episode_index=index, attempt=attempt))


def first_frame(prepared: PreparedEpisode) -> Frame:
    """Observation before any motion; its images need no episode around them."""
    with SimulatorCache() as simulators:
        world, renderer = simulators.acquire(prepared.info)
        return next(Session.of_episode(world, prepared, renderer).run(ScriptAgent(prepared)))


def run(prepared: PreparedEpisode, world: World | None = None) -> tuple[list[Frame], Outcome]:
    with SimulatorCache() as simulators:
        fresh, renderer = simulators.acquire(prepared.info)
        session = Session.of_episode(fresh if world is None else world, prepared, renderer)
        frames = list(session.run(ScriptAgent(prepared)))
    return frames, session.outcome


def body_index(world: World, name: str) -> int:
    """PyBullet's index of a body: PyBullet numbers bodies in the order of loading, which is also that of the world."""
    return [body.name for body in world.visuals()].index(name)
