"""`demorec check --deep`: remake a recording from its description, and compare every byte.

The script runs again from config and seed; for a derived recording (a render, a rollout) the commands are sent again.
Differences are reported by stream, field and frame. This finds every error in a recording of demorec except errors that
the program itself reproduces.
"""

from __future__ import annotations

import tempfile
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal

from demorec.check.report import Proof
from demorec.core.config import EpisodePlan, GenerateConfig, VideoConfig, cpu_type, deciding_versions
from demorec.core.errors import DemorecError, NotAllowedError, RecordingError, resource_error
from demorec.core.own_versions import version_differences
from demorec.core.plain import digest
from demorec.core.processes import in_turn
from demorec.core.tables import RENDERERS
from demorec.episode.info import EpisodeInfo
from demorec.episode.simulated import with_simulation
from demorec.extensions.remake.byte_comparison import Contents, RemakeDifference, content_differences
from demorec.extensions.remake.drive import replay
from demorec.extensions.remake.rerender import config_as, recorded_view, view_painter
from demorec.generate.worker import record_episode
from demorec.loop import SimulatorCache
from demorec.mcap import EpisodeWriter, Recording, open_simulated
from demorec.robots.assets import allow_models


@dataclass(frozen=True, kw_only=True)
class DeepReport:
    """Comparison of a recording with its remake.

    Attributes:
        path: The recording.
        versions: One line for each version, and the CPU type, that differs between the recording and this machine. If
        there are any, nothing is provable here, and differences are warnings.
        differences: Everything that differs, ordered by the first frame.
        error: Reason why it could not be remade; "" if it could.
        num_frames: Number of recorded frames.
    """

    path: Path
    versions: tuple[str, ...] = ()
    differences: tuple[RemakeDifference, ...] = ()
    error: str = ""
    num_frames: int = 0

    @property
    def level(self) -> Literal["pass", "warn", "fail"]:
        """Fail if it cannot be remade or differs, and neither versions nor the CPU explain it."""
        if self.versions:
            return "warn"
        return "fail" if self.error or self.differences else "pass"


_simulators = SimulatorCache()
"""Simulators of this process."""


def deep_check(path: Path, simulators: SimulatorCache = _simulators, allowed: Sequence[str] = ()) -> DeepReport:
    """Remake a recording and compare everything.

    Args:
        path: The recording.
        simulators: Provides world and renderer; by default one that stays warm during the process.
        allowed: The user's own modules that may be imported if the recording names them.

    Raises:
        ResourceError: This machine lacks resources; this implies nothing about the recording.
    """
    report = DeepReport(path=path)
    try:
        with (
            tempfile.TemporaryDirectory(prefix="demorec-deep-") as folder,
            open_simulated(path) as recording,
        ):
            info = recording.info
            report = replace(report, num_frames=recording.num_frames, versions=_unlike_here(info, allowed))
            again = Path(folder) / "again.mcap"
            remake(recording, again, simulators, allowed)
            found, made = Contents.of(path), Contents.of(again)
            if recording.is_recovered:
                made.cut_off(found)
            return replace(report, differences=tuple(content_differences(found, made, info.fps)))
    except DemorecError as error:
        return _impossible(report, error)


def _impossible(report: DeepReport, error: DemorecError) -> DeepReport:
    """Report that a remake is impossible; ResourceError if this machine lacks the resources."""
    lack = resource_error(error)
    if lack is error:
        raise error
    if lack is not None:
        raise lack from error
    if isinstance(error, NotAllowedError | RecordingError):  # neither versions nor the CPU explain it
        report = replace(report, versions=())
    return replace(report, error=str(error))


def _unlike_here(info: EpisodeInfo, allowed: Sequence[str]) -> tuple[str, ...]:
    """Describe the differences in versions and CPU type between an episode and this machine."""
    lines = list(version_differences(info.versions, _versions_here(info, allowed)))
    if info.simulated.cpu != cpu_type():
        lines.append(f"it was simulated on {info.simulated.cpu or 'an unknown CPU'}, this is {cpu_type()}")
    return tuple(lines)


def _versions_here(info: EpisodeInfo, allowed: Sequence[str]) -> Mapping[str, str]:
    """package -> version of the packages that would make such an episode here."""
    with suppress(DemorecError):
        return deciding_versions(_recorded_config(info, allowed))
    return deciding_versions()


def _recorded_config(info: EpisodeInfo, allowed: Collection[str]) -> GenerateConfig:
    """The recorded config of an episode.

    Raises:
        ConfigError: The config is not valid.
        NotAllowedError: It names an object of a module that is not in `allowed`.
    """
    config = config_as(info.simulated.config, GenerateConfig)
    config.check_names(allowed)
    config.validate()
    return config


def remake(recording: Recording, path: Path, simulators: SimulatorCache, allowed: Sequence[str]) -> None:
    """Remake the episode of a recording into a file.

    A generated one needs only its config, its number and its attempt. A derived one (`origin`) has no script: its
    commands are sent again in its recorded scene, and labels, phases and events are copied.

    Raises:
        ConfigError: Its config cannot be used.
        DemorecError: It cannot be simulated, drawn or written here.
    """
    info = recording.info
    if info.origin:
        _send_again(recording, path, simulators, allowed)
        return
    config = _recorded_config(info, allowed)
    plan = EpisodePlan(config=config, episode_index=info.episode_index, attempt=info.attempt)
    record_episode(plan, path, simulators)


def _send_again(recording: Recording, path: Path, simulators: SimulatorCache, allowed: Sequence[str]) -> None:
    """Replay the commands into a new recording, with images of the recorded cameras."""
    allow_models(allowed)
    info = with_simulation(recording.info, config_digest=digest(recording.info.simulated.config))
    config, recorded = info.simulated.config, recording.outcome
    RENDERERS.check_name(str(config.get("renderer", "raster")))
    world, renderer = simulators.acquire(info)
    painter = None if renderer is None else view_painter(renderer, recorded_view(info), config)
    video = config_as(config.get("video", {}), VideoConfig)
    with EpisodeWriter(path, info, video=video) as writer:
        _, outcome = replay(recording, world, allowed, painter=painter, sink=writer.write)
        if recorded is not None:  # a replay cannot reproduce the reason of a failure or the number of retries
            outcome = replace(
                outcome,
                failure_phase=recorded.failure_phase,
                failure_reason=recorded.failure_reason,
                num_retries=recorded.num_retries,
                success=all(check.passed for check in outcome.checks) and not recorded.failure_reason,
            )
        writer.finish(outcome)


def deep_checks(paths: Sequence[Path], *, workers: int = 1, allowed: Sequence[str] = ()) -> Iterator[DeepReport]:
    """One report per recording, in order."""
    if workers == 1 or len(paths) < 2:
        with closing(SimulatorCache()) as simulators:
            for path in paths:
                yield deep_check(path, simulators, allowed)
        return
    yield from in_turn(partial(deep_check, allowed=tuple(allowed)), paths, workers)


def proofs(paths: Sequence[Path], allowed: Sequence[str]) -> Iterator[Proof]:
    """Prove each recording by making it again; a row `proofs` of the extension."""
    for report in deep_checks(paths, allowed=allowed):
        problem = ""
        if report.level == "fail":
            problem = f"made again, it is not the same: {report.error or report.differences[0]}"
        yield Proof(path=report.path, level=report.level, problem=problem)
