"""What an executor is, and what it reports: the driver is the same for one process, one machine and a cluster."""

from __future__ import annotations

import errno
import importlib
import traceback
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, Self

import psutil

from demorec.config import EpisodePlan
from demorec.errors import ConfigError, DemorecError, GenerationError, error_chain
from demorec.runs.run_file import Attempt

Maker = Callable[[EpisodePlan, Path], Attempt]
"""Makes one attempt in the run's folder: writes the recording to its place, then returns its line."""

MAKE_EPISODE = "demorec.generate.worker:make_episode"
"""Makers are given by name and imported in the worker, so that the driver never loads a simulator."""

_THREAD_SETTINGS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
SINGLE_THREADED = dict.fromkeys(_THREAD_SETTINGS, "1")
"""Environment of a worker: a worker is one core, so that N workers take N cores and not N times N threads."""
_POLL_S = 1.0


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
    a DemorecError, else 0.
    """

    plan: EpisodePlan
    kind: str
    message: str
    traceback: str
    errno: int | None
    exit_code: int

    def error(self, sentence: str) -> DemorecError:
        """What the driver raises for it."""
        return (ConfigError if self.exit_code == ConfigError.exit_code else GenerationError)(sentence)


@dataclass(frozen=True, kw_only=True)
class Lost:
    """The worker ended without a word (killed, out of memory, its machine gone)."""

    plan: EpisodePlan
    reason: str


Report = Made | Raised | Lost


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

    def carry_out(self, plans: Iterable[EpisodePlan]) -> Iterator[Report]:
        """Begin plans in their order, as many at a time as there is room for; gives reports in that of their ends."""
        waiting = deque(plans)
        while waiting or self.pending:
            while waiting and self.has_room:
                self.submit(waiting.popleft())
            yield from self.wait(_POLL_S)


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
        )
    return Made(plan=plan, attempt=attempt, peak_bytes=peak_memory())


def peak_memory() -> int:
    """Largest resident size of this process so far, bytes (the present one where the system does not keep it)."""
    with suppress(OSError):
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    return int(psutil.Process().memory_info().rss)
