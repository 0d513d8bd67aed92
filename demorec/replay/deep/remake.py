"""A recording made again: the script run again from config and seed, or the commands of a derived one sent again."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path

from demorec.core.config import EpisodePlan, GenerateConfig, VideoConfig
from demorec.core.plain import digest
from demorec.core.tables import RENDERERS
from demorec.episode.info import EpisodeInfo
from demorec.loop import ScriptAgent, Session, SimulatorCache, prepare
from demorec.mcap import EpisodeWriter, Recording
from demorec.render import Renderer
from demorec.render.painter import Painter
from demorec.replay.demonstration import ReplayOptions, open_demonstration
from demorec.replay.drive import replay
from demorec.replay.rerender import config_as, recorded_view, view_painter
from demorec.robots.assets import allow_models


def recorded_config(info: EpisodeInfo, allowed: Collection[str]) -> GenerateConfig:
    """The config that an episode says it was made with.

    Raises:
        ConfigError: It is none.
        NotAllowedError: It names something of a module that is not among those `allowed`.
    """
    config = config_as(info.config, GenerateConfig)
    config.check_names(allowed)
    config.validate()
    return config


def remake(recording: Recording, path: Path, simulators: SimulatorCache, allowed: Sequence[str] = ()) -> None:
    """Make the episode of a recording again, as a recording of the same format version.

    A generated one needs nothing but its config, its number and its attempt. A derived one (`origin`) has no script:
    its commands are sent again in its recorded scene, and labels, phases and events are taken over.

    Args:
        recording: The original.
        path: The file to be made.
        simulators: Gives world and renderer.
        allowed: The user's own modules that may be imported for what the recording names.

    Raises:
        ConfigError: Its config cannot be used.
        DemorecError: It cannot be simulated, drawn or written here.
    """
    if recording.info.origin:
        _send_again(recording, path, simulators, allowed)
    else:
        generate_again(recording.info, path, simulators, allowed)


def generate_again(recorded: EpisodeInfo, path: Path, simulators: SimulatorCache, allowed: Sequence[str] = ()) -> None:
    """`remake` of a generated episode, of which nothing but its description is needed; errors as there."""
    config = recorded_config(recorded, allowed)
    episode = prepare(EpisodePlan(config=config, episode_index=recorded.episode_index, attempt=recorded.attempt))
    info = replace(episode.info, format_version=recorded.format_version)
    world, renderer = simulators.acquire(info)
    session = Session.of_episode(world, episode, renderer)
    with EpisodeWriter(path, info, video=config.video) as writer:
        for frame in session.run(ScriptAgent(episode)):
            writer.write(frame)
        writer.finish(session.outcome)


def _send_again(recording: Recording, path: Path, simulators: SimulatorCache, allowed: Sequence[str]) -> None:
    allow_models(allowed)
    options = ReplayOptions(allowed=tuple(allowed))
    demonstration = open_demonstration(recording, options)
    info = recording.info.with_simulation(config_digest=digest(recording.info.config))
    RENDERERS.check_name(str(info.config.get("renderer", "raster")))
    world, renderer = simulators.acquire(info)
    painter = recorded_painter(info, renderer, allowed)
    with EpisodeWriter(path, info, video=config_as(info.config.get("video", {}), VideoConfig)) as writer:
        _, outcome = replay(demonstration, world, options, painter=painter, sink=writer.write)
        if recording.outcome is not None:  # why it failed, and after how many tries, no replay can tell
            recorded = recording.outcome
            outcome = replace(
                outcome,
                failure_phase=recorded.failure_phase,
                failure_reason=recorded.failure_reason,
                num_retries=recorded.num_retries,
                success=all(check.passed for check in outcome.checks) and not recorded.failure_reason,
            )
        writer.finish(outcome)


def recorded_painter(info: EpisodeInfo, renderer: Renderer | None, allowed: Collection[str]) -> Painter | None:
    """Draws what the recording shows, from where its cameras really were; None without cameras."""
    if renderer is None:
        return None
    return view_painter(renderer, recorded_view(info, allowed), info.config)
