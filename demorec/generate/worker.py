"""Worker of every executor: simulate, record, verify, and move into place.

An attempt is a pure function of its plan. It is recorded in a separate folder of this process below unfinished/. It is
moved to episodes/ or failed/ atomically, when it is complete and has been read back. So the remains of a crash are
already set aside, and two workers on one plan (a lost one that was still alive) cannot mix.
"""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any

from demorec.core.config import EpisodePlan
from demorec.core.errors import ConfigError, SceneError
from demorec.core.own_versions import version_differences
from demorec.loop import ScriptAgent, Session, SimulatorCache, prepare
from demorec.mcap import EpisodeWriter
from demorec.runs.recorded import inspect_recording, place_recording
from demorec.runs.run_file import EPISODES, FAILED, STARTING, UNFINISHED, Attempt, recording_name

SIMULATION, RENDERING, RECORDING = "simulation", "rendering", "recording"
STAGES = (SIMULATION, RENDERING, RECORDING)
"""Stages of every attempt; a worker's first one also has STARTING."""


def make_episode(plan: EpisodePlan, folder: Path) -> Attempt:
    """Make one attempt in the run's folder and return its line of run.json.

    If the task's ranges contain no scene, the attempt failed without a recording.

    Raises:
        DemorecError: No trustworthy recording could be made, for a reason that another attempt would not fix.
        OSError: The folder cannot be written to.
    """
    began, seconds = time.process_time(), dict.fromkeys(STAGES, 0.0)
    with _scratch_folder(folder) as scratch:
        path = scratch / recording_name(plan.episode_index, plan.attempt, success=False)
        try:
            _record(plan, path, began, seconds)
        except SceneError as error:
            for part in scratch.iterdir():
                part.unlink()
            return Attempt(
                episode_index=plan.episode_index,
                attempt=plan.attempt,
                seed=plan.config.seed,
                success=False,
                file="",
                sha256="",
                digest="",
                num_frames=0,
                num_bytes=0,
                phase="scene",
                reason=str(error),
                seconds=_with_rest(seconds, began),
            )
        with _counted(seconds, RECORDING):
            attempt, *_ = inspect_recording(path)
            file = f"{EPISODES if attempt.success else FAILED}/" + recording_name(
                plan.episode_index, plan.attempt, success=attempt.success
            )
            place_recording(path, folder / file)
    return replace(attempt, file=file, seconds=_with_rest(seconds, began))


def _record(plan: EpisodePlan, path: Path, began: float, seconds: dict[str, float]) -> None:
    starts = not _simulators.is_warm
    episode = prepare(plan)
    _check_versions(plan, episode.info.versions)
    world, renderer = _simulators.acquire(episode.info)
    timed: Any = _Timed(renderer, seconds, RENDERING) if renderer else None
    session = Session.of_episode(world, episode, timed)
    with EpisodeWriter(path, episode.info, video=plan.config.video) as writer:
        recording = _Timed(writer, seconds, RECORDING)
        for frame in session.run(ScriptAgent(episode)):
            if starts:  # including the first frame's images: a worker's first drawing compiles
                seconds |= {STARTING: time.process_time() - began, RENDERING: 0.0}
                starts = False
            recording.write(frame)
        recording.finish(session.outcome)


def _check_versions(plan: EpisodePlan, here: Mapping[str, str]) -> None:
    """Raise if the user's modules were edited during the run: a fresh worker would mix versions."""
    different = () if plan.versions is None else version_differences(plan.versions, here)
    if different:
        raise ConfigError(f"The inputs of the run's episodes have changed since its start: {'; '.join(different)}")


_simulators = SimulatorCache()
"""Simulators of this process."""


@contextmanager
def _counted(seconds: dict[str, float], stage: str) -> Iterator[None]:
    """Count the CPU seconds of the context for a stage."""
    began = time.process_time()
    try:
        yield
    finally:
        seconds[stage] += time.process_time() - began


def _with_rest(seconds: dict[str, float], began: float) -> dict[str, float]:
    """Compute stage -> CPU seconds of an attempt that ends now; time outside other stages is simulation."""
    return seconds | {SIMULATION: time.process_time() - began - sum(seconds.values())}


class _Timed:
    """A renderer or writer with its methods' time counted for a stage."""

    def __init__(self, timed: object, seconds: dict[str, float], stage: str) -> None:
        self._timed, self._counted = timed, _counted(seconds, stage)

    def __getattr__(self, name: str) -> Any:
        return self._counted(getattr(self._timed, name))

    def close(self) -> None:
        """Do nothing; the owner closes the wrapped object."""


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
