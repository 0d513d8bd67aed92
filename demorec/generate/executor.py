"""Interface and reports of executors: the driver is the same for one process, one machine and a cluster."""

from __future__ import annotations

import errno
import importlib
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, Self

import psutil

from demorec.core.config import EpisodePlan
from demorec.core.errors import ConfigError, DemorecError, GenerationError, error_chain
from demorec.core.own_code import own_line
from demorec.runs.run_file import Attempt

Maker = Callable[[EpisodePlan, Path], Attempt]
"""Makes one attempt in the run's folder: writes the recording to its place, then returns its line."""

MAKE_EPISODE = "demorec.generate.worker:make_episode"
"""Makers are named and imported in the worker, so that the driver never loads a simulator."""

_THREAD_SETTINGS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
SINGLE_THREADED = dict.fromkeys(_THREAD_SETTINGS, "1")
"""Environment of a worker: a worker uses one core, so that N workers use N cores and not N times N threads."""
CAPACITY_WAIT_S = 300.0
"""Maximum wait, s, without room for any worker: a cloud takes 1 to 5 min to boot a replacement for a lost machine."""
POLL_S = 0.2
"""Interval, s, at which the caller of `Executor.carry_out` regains control, for example to handle Ctrl-C."""


@dataclass(frozen=True, kw_only=True)
class Made:
    """An attempt has ended, with a recording unless no scene was found for it."""

    plan: EpisodePlan
    attempt: Attempt
    peak_bytes: int


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

    def interrupt(self) -> None:
        """Ask every worker to abandon its attempt and end."""

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
    return Made(plan=plan, attempt=attempt, peak_bytes=peak_memory())


def peak_memory() -> int:
    """Return the largest resident size of this process, bytes (the current one if the system does not store it)."""
    with suppress(OSError):
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    return int(psutil.Process().memory_info().rss)
