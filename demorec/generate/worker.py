"""Worker of every executor: simulate, record, verify, and move into place.

An attempt is a pure function of its plan. It is recorded in a separate folder of this process below unfinished/. It is
moved to episodes/ or failed/ atomically, when it is complete and has been read back. So the remains of a crash are
already set aside, and two workers on one plan (a lost one that was still alive) cannot mix.
"""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from itertools import count
from pathlib import Path

from demorec.core.config import EpisodePlan
from demorec.core.errors import ConfigError, SceneError
from demorec.core.own_versions import version_differences
from demorec.loop import ScriptAgent, Session, SimulatorCache, prepare
from demorec.mcap import EpisodeWriter
from demorec.runs.recorded import inspect_recording, place_recording
from demorec.runs.run_file import EPISODES, FAILED, UNFINISHED, Attempt, recording_name


def make_episode(plan: EpisodePlan, folder: Path) -> Attempt:
    """Make one attempt in the run's folder and return its line of run.json.

    If the task's ranges contain no scene, the attempt failed without a recording.

    Raises:
        DemorecError: No trustworthy recording could be made, for a reason that another attempt would not fix.
        OSError: The folder cannot be written to.
    """
    began = time.process_time()
    with _scratch_folder(folder) as scratch:
        path = scratch / recording_name(plan.episode_index, plan.attempt, success=False)
        try:
            record_episode(plan, path, _simulators)
        except SceneError as error:
            for part in scratch.iterdir():
                part.unlink()
            return Attempt(
                episode_index=plan.episode_index,
                attempt=plan.attempt,
                seed=plan.config.seed,
                success=False,
                phase="scene",
                reason=str(error),
                seconds=time.process_time() - began,
            )
        attempt, *_ = inspect_recording(path)
        name = recording_name(plan.episode_index, plan.attempt, success=attempt.success)
        file = f"{EPISODES if attempt.success else FAILED}/{name}"
        place_recording(path, folder / file)
    return replace(attempt, file=file, seconds=time.process_time() - began)


def record_episode(plan: EpisodePlan, path: Path, simulators: SimulatorCache) -> None:
    """Simulate an attempt and record it.

    Raises:
        ConfigError: The user's modules were edited since the start of the run: a fresh worker would mix versions.
        DemorecError: It cannot be simulated, drawn or written here.
    """
    episode = prepare(plan)
    here = episode.info.versions
    if different := () if plan.versions is None else version_differences(plan.versions, here):
        raise ConfigError(f"The inputs of the run's episodes have changed since its start: {'; '.join(different)}")
    world, renderer = simulators.acquire(episode.info)
    session = Session.of_episode(world, episode, renderer)
    with EpisodeWriter(path, episode.info, video=plan.config.video) as writer:
        for frame in session.run(ScriptAgent(episode)):
            writer.write(frame)
        writer.finish(session.outcome)


_simulators = SimulatorCache()
"""Simulators of this process."""


@contextmanager
def _scratch_folder(folder: Path) -> Iterator[Path]:
    """Create a folder that no other attempt uses; removed at the end if empty."""
    for number in count():
        scratch = folder / UNFINISHED / f"{platform.node()}-{os.getpid()}-{number}"
        with suppress(FileExistsError):  # left by a dead process of the same number
            scratch.mkdir()
            break
    try:
        yield scratch
    finally:
        with suppress(OSError):
            scratch.rmdir()
