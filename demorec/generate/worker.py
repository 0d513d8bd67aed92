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
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import replace
from pathlib import Path

from demorec.config import EpisodePlan
from demorec.episode import CameraImages, EpisodeInfo
from demorec.errors import ConfigError, SceneError
from demorec.generate.recordings import inspect_recording
from demorec.generate.run_file import EPISODES, FAILED, STARTING, UNFINISHED, Attempt, recording_name, sync_folder
from demorec.geometry import Array
from demorec.own_versions import version_differences
from demorec.recording import EpisodeWriter
from demorec.render import Renderer, RenderSetup
from demorec.rollout import Rollout, make_renderer, make_world, prepare
from demorec.sim.world import World

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
    seconds = dict.fromkeys(STAGES, 0.0)
    with _scratch_folder(folder) as scratch:
        path = scratch / recording_name(plan.episode_index, plan.attempt, success=False)
        try:
            _record(plan, path, seconds)
        except SceneError as error:
            for part in scratch.iterdir():
                part.unlink()
            return _without_scene(plan, str(error), seconds)
        with _measured(seconds, RECORDING):
            attempt = inspect_recording(path).attempt
            file = f"{EPISODES if attempt.success else FAILED}/" + recording_name(
                plan.episode_index, plan.attempt, success=attempt.success
            )
            path.replace(folder / file)
            sync_folder((folder / file).parent)
    return replace(attempt, file=file, seconds=seconds)


def _record(plan: EpisodePlan, path: Path, seconds: dict[str, float]) -> None:
    before_first_frame = SIMULATION if _workshop.is_warm else STARTING
    with _measured(seconds, before_first_frame):
        episode = prepare(plan)
        _check_versions(plan, episode.info.versions)
        world, renderer = _workshop.equip(episode.info)
    rollout = Rollout(world, episode, _Stopwatch(renderer, seconds) if renderer else None)
    with EpisodeWriter(path, episode.info, video=plan.config.video) as recording:
        frames = iter(rollout)
        stage = before_first_frame
        while True:
            rendering_before = seconds[RENDERING]
            with _measured(seconds, stage):
                frame = next(frames, None)
            if stage == STARTING:
                seconds[RENDERING] = rendering_before
            else:
                seconds[stage] -= seconds[RENDERING] - rendering_before
            stage = SIMULATION
            if frame is None:
                break
            with _measured(seconds, RECORDING):
                recording.write(frame)
        assert rollout.outcome is not None  # set when the frames are exhausted
        with _measured(seconds, RECORDING):
            recording.finish(rollout.outcome)


def _check_versions(plan: EpisodePlan, here: Mapping[str, str]) -> None:
    """A module of the user's own that was edited while the run goes on would be mixed into it by a fresh worker."""
    different = () if plan.versions is None else version_differences(plan.versions, here)
    if different:
        raise ConfigError(f"What decides the run's episodes is not what it was at its start: {'; '.join(different)}")


class _Workshop:
    """The world and the renderer of this process, kept warm from one episode to the next."""

    def __init__(self) -> None:
        self._world: World | None = None
        self._renderer: AbstractContextManager[Renderer | None] | None = None
        self._entered: Renderer | None = None
        self._key: object = None

    @property
    def is_warm(self) -> bool:
        """Whether this process has made an episode before."""
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


_workshop = _Workshop()


class _Stopwatch:
    """A renderer whose CPU seconds are counted."""

    def __init__(self, renderer: Renderer, seconds: dict[str, float]) -> None:
        self._renderer = renderer
        self._seconds = seconds

    def setup(self, setup: RenderSetup) -> None:
        with _measured(self._seconds, RENDERING):
            self._renderer.setup(setup)

    def render(self, poses: Array) -> dict[str, CameraImages]:
        with _measured(self._seconds, RENDERING):
            return self._renderer.render(poses)

    def close(self) -> None:
        """Left to the workshop, which owns the renderer."""

    def __enter__(self) -> Renderer:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()


@contextmanager
def _scratch_folder(folder: Path) -> Iterator[Path]:
    """A folder that no other attempt uses; taken away when it is empty in the end."""
    base = f"{platform.node()}-{os.getpid()}"
    number = 0
    while True:
        scratch = folder / UNFINISHED / f"{base}-{number}"
        try:
            scratch.mkdir()
            break
        except FileExistsError:  # left by a dead process of the same number
            number += 1
    try:
        yield scratch
    finally:
        with suppress(OSError):
            scratch.rmdir()


@contextmanager
def _measured(seconds: dict[str, float], stage: str) -> Iterator[None]:
    start = time.process_time()
    try:
        yield
    finally:
        seconds[stage] = seconds.get(stage, 0.0) + time.process_time() - start


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
