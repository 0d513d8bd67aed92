"""Driver of a run: plans to an executor, lines into run.json, until the requested successes exist.

The driver holds one line per episode and never an image. Every failure ends in one sentence with all finished episodes
kept; the same command continues from there.
"""

from __future__ import annotations

import errno
import os
import signal
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from types import FrameType

from demorec.core.config import EpisodePlan, GenerateConfig
from demorec.core.errors import ConfigError, GenerationError
from demorec.core.processes import available_cores, handled
from demorec.core.registry import split_name
from demorec.core.tables import EXECUTORS, RENDERERS, load_robot
from demorec.generate.contents import Inspector
from demorec.generate.executor import MAKE_EPISODE, POLL_S, Executor, LocalExecutor, Made, Raised, Report
from demorec.generate.folder import RunFolder, open_run
from demorec.generate.options import RunObserver, RunOptions, RunResult
from demorec.robots.assets import allow_models
from demorec.runs.recorded import inspect_recording
from demorec.runs.run_file import UNFINISHED, Attempt, GeneratedRun

MAX_LOSSES = 5
"""Number of workers that one attempt may lose before the run stops: chance takes few, too little memory takes all."""
GRACE_S = 3.0
"""Time, s, that current episodes may continue after the first Ctrl-C."""
_MORE_MEMORY = "try fewer --workers or a machine with more memory"
_SOUND_STORAGE = "check the storage of the output folder, then run the same command again"
_REFUSED = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EFBIG, errno.EACCES, errno.EPERM)
"""Errors of an output folder that stay until the user mends them."""
_MISSING_FILE = (errno.ENOENT, errno.ENOTDIR, errno.EISDIR)
"""Errors of the user's code when it names a file wrongly."""


def generate(
    config: GenerateConfig,
    options: RunOptions,
    *,
    progress: RunObserver | None = None,
    maker: str = MAKE_EPISODE,
    inspect: Inspector = inspect_recording,
    episodes: Iterable[int] | None = None,
) -> RunResult:
    """Make the missing episodes of a run.

    Args:
        config: Config that determines the data.
        options: Options of the execution; `out` must be set.
        progress: Receives the progress.
        maker: "module:function" that makes an attempt, imported in the workers.
        inspect: Reads a recording that run.json does not list.
        episodes: Order in which episodes are begun (default: ascending); the result does not depend on it.

    Raises:
        MissingDependencyError: The executor's package is not installed.
        ConfigError: The task cannot be loaded, the robot does not fit its URDF, the cluster cannot be reached, or the
            folder is in use, contains another run or is not writable.
        GenerationError: The run cannot continue; everything finished is kept.
        KeyboardInterrupt: At the second Ctrl-C.
    """
    progress = progress or RunObserver()
    _check_code(config)
    with ExitStack() as stack:
        connected: Callable[[str, Path], Executor] | None = None
        if options.executor != "local":
            connected = stack.enter_context(EXECUTORS.load(options.executor)(options))  # before anything is written
        folder = stack.enter_context(open_run(config, options, progress=progress, inspect=inspect))
        schedule = Schedule(folder.run, episodes=episodes)
        first = schedule.take()
        if first is None:
            return folder.result(interrupted=False)
        schedule.give_back(first)
        if config.cameras and connected is None:
            RENDERERS.load(config.renderer)().close()  # compiles the renderer before several processes would
        executor = stack.enter_context(
            connected(maker, folder.path) if connected else make_executor(options, folder.path, folder.run, maker)
        )
        progress.started(folder.run)
        try:
            interrupted = _Driver(folder, schedule, executor, progress).work()
        except BaseException:
            with suppress(GenerationError):  # the reason why it stopped is reported
                folder.save()
            raise
        folder.save()
        result = folder.result(interrupted=interrupted)
        # Whatever the executor, an incomplete run must not end as complete.
        if not interrupted and not result.run.is_complete:
            raise GenerationError(
                f"The run has ended before it was complete: run the same command again. {folder.kept}"
            )
        return result


def _check_code(config: GenerateConfig) -> None:
    """Raise the first worker's errors about the task and the robot, before anything is written."""
    from demorec.loop import load_task
    from demorec.tasks.robot_check import check_robot

    load_task(config)
    allow_models(config.modules)
    if split_name(config.robot) is not None:
        check_robot(load_robot(config.robot, config.modules), uses_workspace=split_name(config.task) is None)


def make_executor(options: RunOptions, folder: Path, run: GeneratedRun, maker: str) -> Executor:
    """Create the executor on this machine; a context manager."""
    missing = run.num_episodes - len(run.successes)
    workers = max(1, min(options.workers or available_cores(), missing))
    return LocalExecutor(maker, folder, workers=workers, recycle_after=options.recycle_after)


class Schedule:
    """Due attempts and their order, determined only by the run's config and its known attempts.

    An episode's attempts are sequential (attempt n + 1 if n failed); episodes do not wait for each other. The result
    does not depend on the order of `episodes`, in which they are begun.
    """

    def __init__(self, run: GeneratedRun, *, episodes: Iterable[int] | None = None) -> None:
        self._run = run
        self._known = {(a.episode_index, a.attempt): a.success for a in run.attempts}
        self._success = {a.episode_index: a.attempt for a in run.successes}
        self._episodes = iter(range(run.num_episodes) if episodes is None else episodes)
        self._waiting: deque[EpisodePlan] = deque()

    def take(self) -> EpisodePlan | None:
        """Return the next attempt, or None if none is due now (one may become due after a failure)."""
        while not self._waiting:
            index = next(self._episodes, None)
            if index is None:
                return None
            self._waiting.extend(self._due(index))
        return self._waiting.popleft()

    def give_back(self, plan: EpisodePlan) -> None:
        """Return an attempt that was not run: it comes next."""
        self._waiting.appendleft(plan)

    def report(self, attempt: Attempt) -> None:
        """Record the end of an attempt; after a failure the next one is due, up to the limit."""
        index = attempt.episode_index
        self._known[index, attempt.attempt] = attempt.success
        if not attempt.success and index not in self._success:
            self._waiting.extend(self._due(index))

    def _due(self, index: int) -> Iterator[EpisodePlan]:
        """Yield the attempts to make now: the first unknown one, or those missing before a known success."""
        success = self._success.get(index)
        config, versions = self._run.config, self._run.versions
        for number in range(config.max_attempts if success is None else success):
            if (index, number) not in self._known:
                yield EpisodePlan(config=config, episode_index=index, attempt=number, versions=versions)
                if success is None:
                    return


class _Driver:
    """The loop between schedule, executor and run.json."""

    def __init__(self, folder: RunFolder, schedule: Schedule, executor: Executor, progress: RunObserver) -> None:
        self._folder = folder
        self._schedule = schedule
        self._executor = executor
        self._progress = progress
        self._losses: Counter[tuple[int, int]] = Counter()

    def work(self) -> bool:
        """Work until nothing is due; returns whether the user has interrupted it."""
        with _catch_interrupts() as interrupts:
            for reports in self._reports():
                for report in reports:
                    if isinstance(report, Made):
                        self._made(report)
                    else:
                        self._raised(report)
                if interrupts:
                    break
            else:
                return False
            self._progress.says(
                f"Interrupted: the current episodes may end within {GRACE_S:.0f} s (Ctrl-C again ends at once)."
            )
            deadline = time.monotonic() + GRACE_S
            while self._executor.pending and time.monotonic() < deadline:
                for report in self._executor.wait(POLL_S):
                    if isinstance(report, Made):
                        self._made(report)
            return True

    def _reports(self) -> Iterator[list[Report]]:
        try:
            yield from self._executor.carry_out(self._schedule.take, says=self._progress.says)
        except GenerationError as error:  # the executor does not know the run
            raise GenerationError(f"{error} {self._folder.kept}") from error

    def _made(self, report: Made) -> None:
        self._schedule.report(report.attempt)
        self._folder.add(report.attempt)
        self._progress.ended(report.attempt)

    def _again(self, plan: EpisodePlan, reason: str, advice: str) -> None:
        key = (plan.episode_index, plan.attempt)
        self._losses[key] += 1
        if self._losses[key] >= MAX_LOSSES:
            raise GenerationError(
                f"Episode {plan.episode_index} failed to be made {MAX_LOSSES} times, the last time because {reason}: "
                f"{advice}. {self._folder.kept}"
            )
        self._progress.says(f"Episode {plan.episode_index} is made again: {reason}.")
        self._schedule.give_back(plan)

    def _raised(self, report: Raised) -> None:
        self._folder.check_alive()
        if report.errno is not None and report.errno in _REFUSED:
            raise GenerationError(
                f"The output folder cannot take another episode ({os.strerror(report.errno)}): fix that and run the "
                f"same command again. {self._folder.kept}"
            )
        is_own_bug = bool(report.own_line) and report.errno in _MISSING_FILE
        if report.errno is not None and report.exit_code != ConfigError.exit_code and not is_own_bug:
            advice = _MORE_MEMORY if report.errno == errno.ENOMEM else _SOUND_STORAGE
            self._again(report.plan, report.message.rstrip(".") or report.kind, advice)
            return
        if report.exit_code:
            raise report.error(
                f"Episode {report.plan.episode_index} cannot be made: {report.message.rstrip('.')}. {self._folder.kept}"
            )
        place = self._folder.path / UNFINISHED / f"error_episode_{report.plan.episode_index:06d}.txt"
        place.write_text(report.traceback)
        raise GenerationError(
            f"Episode {report.plan.episode_index} raised {report.kind}: {report.message or 'no message'} "
            f"(the traceback is in {place}). {self._folder.kept}"
            + (f"; raised at {report.own_line}" if report.own_line else "")
        )


@contextmanager
def _catch_interrupts() -> Iterator[list[int]]:
    """Catch SIGINT and SIGTERM in the context: the first is listed, the second raises KeyboardInterrupt."""
    caught: list[int] = []

    def handle(number: int, frame: FrameType | None) -> None:
        caught.append(number)
        if len(caught) > 1:
            raise KeyboardInterrupt

    with handled(handle, signal.SIGINT, signal.SIGTERM):
        yield caught
