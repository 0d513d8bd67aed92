"""What a worker does with a plan: simulate, record, read back, put in place. The same for every executor.

An attempt is a pure function of its plan. It is recorded in a folder of this process's own below unfinished/ and
gets its name in episodes/ or failed/ in one step, when it is complete and has been read back. So what a crash
leaves is set aside already, and two workers on one plan (a lost one that was not dead) cannot mix.
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
from demorec.mcap import SimulatedWriter
from demorec.runs.run_file import (
    EPISODES,
    FAILED,
    STARTING,
    UNFINISHED,
    Attempt,
    inspect_recording,
    recording_name,
    sync_folder,
)

SIMULATION, RENDERING, RECORDING = "simulation", "rendering", "recording"
STAGES = (SIMULATION, RENDERING, RECORDING)
"""Of every attempt; the first one of a worker also has STARTING."""


def make_episode(plan: EpisodePlan, folder: Path) -> Attempt:
    """Make one attempt in the run's folder and return its line of run.json.

    No scene within the task's ranges is a failed attempt without a recording.

    Raises:
        DemorecError: No trustworthy recording could be made, for a reason that another attempt would not mend.
        OSError: The folder cannot be written to.
    """
    clock = _Stopwatch(SIMULATION if _simulators.is_warm else STARTING)
    with _scratch_folder(folder) as scratch:
        path = scratch / recording_name(plan.episode_index, plan.attempt, success=False)
        try:
            _record(plan, path, clock)
        except SceneError as error:
            for part in scratch.iterdir():
                part.unlink()
            return _without_scene(plan, str(error), clock.seconds())
        with clock.stage(RECORDING):
            attempt, *_ = inspect_recording(path)
            file = f"{EPISODES if attempt.success else FAILED}/" + recording_name(
                plan.episode_index, plan.attempt, success=attempt.success
            )
            path.replace(folder / file)
            sync_folder((folder / file).parent)
    return replace(attempt, file=file, seconds=clock.seconds())


def _record(plan: EpisodePlan, path: Path, clock: _Stopwatch) -> None:
    episode = prepare(plan)
    _check_versions(plan, episode.info.versions)
    world, renderer = _simulators.acquire(episode.info)
    timed: Any = _Timed(renderer, clock, RENDERING) if renderer else None
    session = Session.of_episode(world, episode, timed)
    with SimulatedWriter(path, episode.info, video=plan.config.video) as writer:
        recording = _Timed(writer, clock, RECORDING)
        for frame in session.run(ScriptAgent(episode)):
            recording.write(frame)
        recording.finish(session.outcome)


def _check_versions(plan: EpisodePlan, here: Mapping[str, str]) -> None:
    """A module of the user's own that was edited while the run goes on would be mixed into it by a fresh worker."""
    different = () if plan.versions is None else version_differences(plan.versions, here)
    if different:
        raise ConfigError(f"What decides the run's episodes is not what it was at its start: {'; '.join(different)}")


_simulators = SimulatorCache()
"""Of this process."""


class _Stopwatch:
    """CPU seconds by stage. What happens outside every `stage` belongs to the simulation once a frame was recorded.

    Args:
        before_first_frame: What it belongs to until then: SIMULATION, or STARTING, which includes the first drawing.
    """

    def __init__(self, before_first_frame: str) -> None:
        self._seconds = dict.fromkeys(STAGES, 0.0)
        self._stage = before_first_frame
        self._since = time.process_time()

    def seconds(self) -> dict[str, float]:
        """Stage -> seconds until now."""
        self._switch(self._stage)
        return dict(self._seconds)

    @contextmanager
    def stage(self, stage: str) -> Iterator[None]:
        """Count what is done within for another stage."""
        outer = self._switch(STARTING if (self._stage, stage) == (STARTING, RENDERING) else stage)
        try:
            yield
        finally:
            self._switch(SIMULATION if stage == RECORDING else outer)

    def _switch(self, stage: str) -> str:
        now = time.process_time()
        self._seconds[self._stage] = self._seconds.get(self._stage, 0.0) + now - self._since
        self._since, before, self._stage = now, self._stage, stage
        return before


class _Timed:
    """A renderer or writer whose methods count for a stage."""

    def __init__(self, timed: object, clock: _Stopwatch, stage: str) -> None:
        self._timed, self._counted = timed, clock.stage(stage)

    def __getattr__(self, name: str) -> Any:
        return self._counted(getattr(self._timed, name))

    def close(self) -> None:
        """Nothing: whoever made it does that."""


@contextmanager
def _scratch_folder(folder: Path) -> Iterator[Path]:
    """A folder that no other attempt uses; taken away when it is empty in the end."""
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


def _without_scene(plan: EpisodePlan, reason: str, seconds: dict[str, float]) -> Attempt:
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
        reason=reason,
        seconds=seconds,
    )
