"""One replay after the other, recorded if wanted."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

from demorec.config import VideoConfig
from demorec.errors import ConfigError
from demorec.plain import from_plain
from demorec.recording import EpisodeWriter
from demorec.render.warm import WarmRenderer
from demorec.replay.demonstration import Demonstration, ReplayOptions
from demorec.replay.drive import ReplayReport, replay
from demorec.replay.rerender import recorded_view, view_behaviour, view_painter
from demorec.safety.files import make_folder
from demorec.scene.assets import allow_models
from demorec.sim.world import World
from demorec.tables import TASKS


def replay_all(
    demonstrations: Iterable[Demonstration], options: ReplayOptions, *, out: Path | None = None, overwrite: bool = False
) -> Iterator[tuple[ReplayReport, tuple[Path, Path] | None]]:
    """Replay one after the other, in one world as long as robot and rate stay the same.

    Args:
        demonstrations: What to replay.
        options: How.
        out: Folder for recordings of the replays; None records nothing.
        overwrite: Whether recordings there may be replaced.

    Yields:
        The report, and (recording, recording of its replay) where one was made.

    Raises:
        NotAllowedError: A demonstration's task is of a module that `options` do not allow.
    """
    allow_models(options.allowed)
    world: World | None = None
    key: object = None
    renderers = WarmRenderer()
    try:
        for demonstration in demonstrations:
            info = demonstration.info
            if not options.states:
                TASKS.check_name(info.task, options.allowed)  # before anything is made
            sample_joints = out is not None and info.config.get("joint_rate") == "physics"
            if world is None or key != (info.robot, demonstration.fps, sample_joints):
                if world is not None:
                    world.close()
                world = World(info.robot, fps=demonstration.fps, sample_joints=sample_joints)
                key = (info.robot, demonstration.fps, sample_joints)
            if out is None:
                yield replay(demonstration, world, options)[0], None
            else:
                report, path = record_replay(demonstration, world, renderers, options, out, overwrite=overwrite)
                yield report, None if demonstration.source is None else (demonstration.source, path)
    finally:
        renderers.close()
        if world is not None:
            world.close()


def record_replay(
    demonstration: Demonstration,
    world: World,
    renderers: WarmRenderer,
    options: ReplayOptions,
    out: Path,
    *,
    overwrite: bool,
) -> tuple[ReplayReport, Path]:
    """Replay and record it, with pictures of the recording's cameras, into a file of the same name in `out`.

    Raises:
        ConfigError: The new recording would replace the one that is replayed, or one of that name is there already.
    """
    d = demonstration
    path = out / (d.name if d.source is not None else f"{d.name}.mcap")
    if d.source is not None and path.resolve() == d.source.resolve():
        raise ConfigError(f"The replay would replace the recording itself, choose another --out: {out}")
    config = d.info.config
    view = recorded_view(d.info, options.allowed)
    make_folder(out)
    behaviour = view_behaviour(d.info, view)
    info = replace(d.info, fps=d.fps, behaviour=behaviour, origin=f"replay of {d.digest[:16]}")
    video = from_plain(config.get("video", {}), VideoConfig)
    painter = None
    if info.scene.cameras:
        painter = view_painter(renderers.of(str(config.get("renderer", "raster"))), view, config)
    with EpisodeWriter(path, info, video=video, overwrite=overwrite) as writer:
        report, outcome = replay(d, world, options, painter=painter, sink=writer.write)
        writer.finish(outcome)
    return report, path
