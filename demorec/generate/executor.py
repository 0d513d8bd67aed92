"""What an executor is, and what it reports: the driver is the same for one process, one machine and a cluster."""

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
"""Makers are given by name and imported in the worker, so that the driver never loads a simulator."""

_THREAD_SETTINGS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
SINGLE_THREADED = dict.fromkeys(_THREAD_SETTINGS, "1")
"""Environment of a worker: a worker is one core, so that N workers take N cores and not N times N threads."""
CAPACITY_WAIT_S = 300.0
"""How long a run waits without room for any worker: a cloud takes 1 to 5 min to boot a machine for a lost one."""
POLL_S = 0.2
"""How often the caller of `Executor.carry_out` may look around, at Ctrl-C for example."""


@dataclass(frozen=True, kw_only=True)
class Made:
    """An attempt has come to its end, with a recording unless no scene was found for it."""

    plan: EpisodePlan
    attempt: Attempt
    peak_bytes: int


@dataclass(frozen=True, kw_only=True)
class Raised:
    """An attempt raised an exception. Told in words: an exception of somebody's task may not survive pickling.

    `errno` is that of the operating system's error in the chain, if any (ENOMEM for a MemoryError); `exit_code` that of
    a DemorecError, else 0; `own_line` the line of the user's own code, as `demorec.core.own_code.own_line`.
    """

    plan: EpisodePlan
    kind: str
    message: str
    traceback: str = ""
    errno: int | None
    exit_code: int = 0
    own_line: str = ""

    def error(self, sentence: str) -> DemorecError:
        """What the driver raises for it."""
        return (ConfigError if self.exit_code == ConfigError.exit_code else GenerationError)(sentence)


def lost(plan: EpisodePlan, reason: str) -> Raised:
    """The worker ended without a word (killed, its machine gone): mostly for lack of memory."""
    return Raised(plan=plan, kind="lost", message=f"{reason}.", errno=errno.ENOMEM)


Report = Made | Raised


class Executor(Protocol):
    """Carries out plans in other processes; a context manager, which is closed at its end."""

    @property
    def workers(self) -> int:
        """How many processes work at the same time."""

    @property
    def has_room(self) -> bool:
        """Whether `submit` may be called; bounds what is in flight."""
        return self.pending < self.workers

    @property
    def pending(self) -> int:
        """Plans submitted and not yet reported."""

    def submit(self, plan: EpisodePlan) -> None:
        """Start an attempt; returns at once."""

    def wait(self, timeout_s: float) -> list[Report]:
        """What has ended; waits up to `timeout_s` for the first."""

    def interrupt(self) -> None:
        """Ask every worker to leave its attempt where it is and end."""

    def close(self) -> None:
        """End every worker, whatever it does; harmless when called twice."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def carry_out(
        self, take: Callable[[], EpisodePlan | None], *, says: Callable[[str], None] = lambda message: None
    ) -> Iterator[list[Report]]:
        """Carry out plans until none is due and none is pending, as many at a time as there is room for.

        Args:
            take: Gives the next plan, or None when none is due now; asked again after each list of reports.
            says: Told when there is no room for any worker, which is waited for.

        Yields:
            What has ended; an empty list when nothing has for `POLL_S`.

        Raises:
            GenerationError: There was no room for `CAPACITY_WAIT_S`.
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
                says(f"There is no room for any worker now: waiting for it, at most {CAPACITY_WAIT_S:.0f} s.")
            elif time.monotonic() - lost_at > CAPACITY_WAIT_S:
                raise GenerationError(
                    f"There has been no room for any worker for {CAPACITY_WAIT_S:.0f} s: see whether the nodes of the "
                    "cluster are up, then run the same command again."
                )
            yield reports
            if plan is None:
                plan = take()


def attempt_episode(maker: str, plan: EpisodePlan, folder: Path) -> Made | Raised:
    """Run the maker of that name and turn what happens into a report; the same in every executor."""
    try:
        module, _, name = maker.partition(":")
        make: Maker = getattr(importlib.import_module(module), name)
        attempt = make(plan, folder)
    except Exception as error:
        # A library may wrap the operating system's error; the first one in the chain tells what to do.
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
    """Largest resident size of this process so far, bytes (the present one where the system does not keep it)."""
    with suppress(OSError):
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    return int(psutil.Process().memory_info().rss)
