"""An executor: attempts are made by the command itself, one at a time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from demorec.api import Executor, attempt_episode


class Bench(Executor):
    """Makes each attempt when it is submitted."""

    workers, pending = 1, 0

    def __init__(self, maker: str, folder: Path) -> None:
        self._maker, self._folder = maker, folder
        self._ended: list[Any] = []

    def submit(self, plan: Any) -> None:
        """Make an attempt."""
        self._ended.append(attempt_episode(self._maker, plan, self._folder))
        self.pending = len(self._ended)

    def wait(self, timeout_s: float) -> list[Any]:
        """Return the ended attempts."""
        ended, self._ended, self.pending = self._ended, [], 0
        return ended

    def close(self) -> None:
        """Do nothing: no process is left."""


@contextmanager
def bench(options: Any) -> Iterator[Callable[[str, Path], Executor]]:
    """Connect to nothing."""
    yield Bench
