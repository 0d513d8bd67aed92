"""One replay after the other, recorded if wanted."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

from demorec.core.config import VideoConfig
from demorec.core.errors import ConfigError
from demorec.core.files import make_folder
from demorec.core.plain import from_plain
from demorec.core.tables import TASKS
from demorec.loop import SimulatorCache
from demorec.mcap import SimulatedWriter
from demorec.replay.demonstration import Demonstration, ReplayOptions
from demorec.replay.drive import ReplayReport, replay
from demorec.replay.rerender import recorded_view, view_behaviour, view_painter
from demorec.robots.assets import allow_models


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
    with closing(SimulatorCache()) as simulators:
        for demonstration in demonstrations:
            if not options.states:
                TASKS.check_name(demonstration.info.task, options.allowed)  # before anything is made
            if out is not None:
                yield record_replay(demonstration, simulators, options, out, overwrite=overwrite)
                continue
            blind = replace(demonstration.info.scene, cameras=())
            world, _ = simulators.acquire(replace(demonstration.info, fps=demonstration.fps, scene=blind, config={}))
            yield replay(demonstration, world, options)[0], None


def record_replay(
    demonstration: Demonstration, simulators: SimulatorCache, options: ReplayOptions, out: Path, *, overwrite: bool
) -> tuple[ReplayReport, tuple[Path, Path] | None]:
    """Replay and record it, with pictures of the recording's cameras, into a file of the same name in `out`.

    Returns:
        As `replay_all` yields.

    Raises:
        ConfigError: The new recording would replace the one that is replayed, or one of that name is there already.
    """
    d = demonstration
    path = out / (d.name if d.source is not None else f"{d.name}.mcap")
    if d.source is not None and path.resolve() == d.source.resolve():
        raise ConfigError(f"The replay would replace the recording itself, choose another --out: {out}")
    view = recorded_view(d.info, options.allowed)
    make_folder(out)
    behaviour = view_behaviour(d.info, view)
    info = replace(d.info, fps=d.fps, behaviour=behaviour, origin=f"replay of {d.digest[:16]}")
    video = from_plain(d.info.config.get("video", {}), VideoConfig)
    world, renderer = simulators.acquire(info)
    painter = view_painter(renderer, view, d.info.config) if renderer else None
    with SimulatedWriter(path, info, video=video, overwrite=overwrite) as writer:
        report, outcome = replay(d, world, options, painter=painter, sink=writer.write)
        writer.finish(outcome)
    return report, None if d.source is None else (d.source, path)
