"""Executors run attempts in other processes; the driver is the same for one machine and a cluster.

The workers of this machine are spawned processes with one pipe each, so that killing one cannot harm the others: a
shared queue (multiprocessing.Queue, ProcessPoolExecutor) has locks that a killed worker never releases; with a separate
pipe a worker's death is just an end-of-file.
"""

from __future__ import annotations

import errno
import importlib
import os
import signal
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing import connection
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from pathlib import Path
from typing import Protocol, Self

from demorec.core.config import EpisodePlan
from demorec.core.errors import ConfigError, DemorecError, GenerationError, error_chain
from demorec.core.own_code import own_line
from demorec.core.processes import SPAWN, blocked, environment
from demorec.runs.run_file import Attempt

Maker = Callable[[EpisodePlan, Path], Attempt]
"""Makes one attempt in the run's folder: writes the recording to its place, then returns its line."""

MAKE_EPISODE = "demorec.generate.worker:make_episode"
"""Makers are named and imported in the worker, so that the driver never loads a simulator."""

SINGLE_THREADED = {f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL", "NUMBA")}
"""Environment of a worker: a worker uses one core, so that N workers use N cores and not N times N threads."""
CAPACITY_WAIT_S = 300.0
"""Maximum wait, s, without room for any worker: a cloud takes 1 to 5 min to boot a replacement for a lost machine."""
POLL_S = 0.2
"""Interval, s, at which the caller of `Executor.carry_out` regains control, for example to handle Ctrl-C."""
_OF_THE_GROUP = frozenset({signal.SIGINT, signal.SIGTERM})


@dataclass(frozen=True, kw_only=True)
class Made:
    """An attempt has ended, with a recording unless no scene was found for it."""

    plan: EpisodePlan
    attempt: Attempt


@dataclass(frozen=True, kw_only=True)
class Raised:
    """An attempt raised an exception, described in words: an exception of a user's task may not survive pickling.

    `errno` is that of the operating system's error in the chain, if any (ENOMEM for a MemoryError). `exit_code` is that
    of a DemorecError, else 0. `own_line` is the line of the user's code, as `demorec.core.own_code.own_line`.
    """

    plan: EpisodePlan
    kind: str
    message: str
    traceback: str = ""
    errno: int | None
    exit_code: int = 0
    own_line: str = ""

    def error(self, sentence: str) -> DemorecError:
        """Build the error that the driver raises."""
        return (ConfigError if self.exit_code == ConfigError.exit_code else GenerationError)(sentence)


def lost(plan: EpisodePlan, reason: str) -> Raised:
    """Report a worker that ended silently (killed, its machine gone): mostly for lack of memory."""
    return Raised(plan=plan, kind="lost", message=f"{reason}.", errno=errno.ENOMEM)


Report = Made | Raised


class Executor(Protocol):
    """Runs plans in other processes; a context manager that closes itself at exit."""

    @property
    def workers(self) -> int:
        """Number of processes that work at the same time."""

    @property
    def has_room(self) -> bool:
        """Whether `submit` may be called; bounds the number of running plans."""
        return self.pending < self.workers

    @property
    def pending(self) -> int:
        """Plans submitted and not yet reported."""

    def submit(self, plan: EpisodePlan) -> None:
        """Start an attempt; returns immediately."""

    def wait(self, timeout_s: float) -> list[Report]:
        """Return the attempts that have ended; waits up to `timeout_s` for the first."""

    def close(self) -> None:
        """End every worker, even a busy one; safe to call twice."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def carry_out(
        self, take: Callable[[], EpisodePlan | None], *, says: Callable[[str], None] = lambda message: None
    ) -> Iterator[list[Report]]:
        """Run plans until none is due and none is pending, as many at a time as there is room for.

        Args:
            take: Returns the next plan, or None if none is due now; called again after each list of reports.
            says: Receives a message while the run waits for room for any worker.

        Yields:
            Reports of ended attempts; an empty list if none has ended for `POLL_S`.

        Raises:
            GenerationError: No room was available for `CAPACITY_WAIT_S`.
        """
        lost_at: float | None = None
        plan = take()
        while plan is not None or self.pending:
            while plan is not None and self.has_room:
                self.submit(plan)
                plan = take()
            if self.pending:
                reports = self.wait(POLL_S)
            else:
                reports = []
                time.sleep(POLL_S)
            if reports or (self.workers and (self.pending or self.has_room)):
                lost_at = None
            elif lost_at is None:
                lost_at = time.monotonic()
                says(f"The cluster has no room for any worker now: waiting up to {CAPACITY_WAIT_S:.0f} s.")
            elif time.monotonic() - lost_at > CAPACITY_WAIT_S:
                raise GenerationError(
                    f"The cluster has had no room for any worker for {CAPACITY_WAIT_S:.0f} s: check that its nodes "
                    "are up, then run the same command again."
                )
            yield reports
            if plan is None:
                plan = take()


def attempt_episode(maker: str, plan: EpisodePlan, folder: Path) -> Made | Raised:
    """Run the named maker and convert its result to a report; the same in every executor."""
    try:
        module, _, name = maker.partition(":")
        make: Maker = getattr(importlib.import_module(module), name)
        attempt = make(plan, folder)
    except Exception as error:
        # A library may wrap the operating system's error; the first one in the chain determines the fix.
        cause = next((c for c in error_chain(error) if isinstance(c, OSError | MemoryError)), None)
        number = errno.ENOMEM if isinstance(cause, MemoryError) else getattr(cause, "errno", None)
        return Raised(
            plan=plan,
            kind=type(error).__name__,
            message=str(error),
            traceback=traceback.format_exc(),
            errno=number,
            exit_code=error.exit_code if isinstance(error, DemorecError) else 0,
            own_line=own_line(error),
        )
    return Made(plan=plan, attempt=attempt)


@dataclass(eq=False)
class _Worker:
    process: SpawnProcess
    pipe: Connection[EpisodePlan | None, Report]
    plan: EpisodePlan | None = None
    given: int = 0


class LocalExecutor(Executor):
    """A fixed number of processes, started on demand, replaced when they die or after `recycle_after` attempts."""

    def __init__(self, maker: str, folder: Path, *, workers: int, recycle_after: int) -> None:
        self._maker = maker
        self._folder = folder
        self._num_workers = workers
        self._recycle_after = recycle_after
        self._live: list[_Worker] = []
        self._retired: list[_Worker] = []

    @property
    def workers(self) -> int:
        """See `Executor`."""
        return self._num_workers

    @property
    def pending(self) -> int:
        """See `Executor`."""
        return sum(worker.plan is not None for worker in self._live)

    def submit(self, plan: EpisodePlan) -> None:
        """See `Executor`."""
        worker = next((w for w in self._live if w.plan is None), None)
        if worker is None:
            worker = self._start()
        worker.plan = plan
        worker.given += 1
        # A worker that died while idle is detected at the next wait: the plan is then reported as lost.
        with suppress(OSError):
            worker.pipe.send(plan)

    def wait(self, timeout_s: float) -> list[Report]:
        """See `Executor`."""
        reports: list[Report] = []
        by_pipe = {worker.pipe: worker for worker in self._live}
        for pipe in connection.wait(list(by_pipe), timeout_s):
            worker = by_pipe[pipe]  # type: ignore[index]
            plan, worker.plan = worker.plan, None
            try:
                reports.append(worker.pipe.recv())
                if worker.given >= self._recycle_after:
                    self._retire(worker)
            except (EOFError, OSError):
                self._live.remove(worker)
                worker.process.join()
                worker.pipe.close()
                if plan is not None:
                    reports.append(lost(plan, _death(worker.process.exitcode)))
        return reports

    def close(self) -> None:
        """End every worker: idle ones by message, busy ones by SIGKILL (their part files stay)."""
        for worker in list(self._live):
            if worker.plan is None:
                self._retire(worker)
            else:
                worker.process.kill()
        for worker in self._live + self._retired:
            worker.process.join(timeout=5.0)
            if worker.process.exitcode is None:
                worker.process.kill()
                worker.process.join()
            worker.pipe.close()
        self._live.clear()
        self._retired.clear()

    def _start(self) -> _Worker:
        ours, theirs = SPAWN.Pipe()
        process = SPAWN.Process(
            target=_worker_main, args=(theirs, self._maker, self._folder), name="demorec-worker", daemon=True
        )
        with environment(SINGLE_THREADED), blocked(*_OF_THE_GROUP):
            process.start()
        theirs.close()  # otherwise the pipe would never report that the worker is gone
        worker = _Worker(process=process, pipe=ours)
        self._live.append(worker)
        return worker

    def _retire(self, worker: _Worker) -> None:
        self._live.remove(worker)
        self._retired = [w for w in self._retired if w.process.exitcode is None]
        self._retired.append(worker)
        with suppress(OSError):
            worker.pipe.send(None)


def _worker_main(pipe: Connection[Report, EpisodePlan | None], maker: str, folder: Path) -> None:
    """Run a worker: plans in, reports out, until None or the driver's death."""
    # Both may reach the whole process group (Ctrl-C, timeout); the driver decides their meaning.
    for number in _OF_THE_GROUP:
        signal.signal(number, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _OF_THE_GROUP)
    try:
        while (plan := pipe.recv()) is not None:
            pipe.send(attempt_episode(maker, plan, folder))
    except (EOFError, OSError):
        pass
    # Nothing is left to flush, and native libraries may crash or stall during teardown.
    sys.stderr.flush()
    os._exit(0)


def _death(exitcode: int | None) -> str:
    if exitcode is not None and exitcode < 0:
        name = signal.Signals(-exitcode).name
        return f"its worker was ended by {name}" + (" (out of memory?)" if exitcode == -signal.SIGKILL else "")
    return f"its worker ended with exit code {exitcode}"
