"""Progress of a command: a bar on a terminal, occasional lines in a log file (Slurm, nohup, CI)."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Any

from tqdm import tqdm

from demorec.cli.shared.output import tell
from demorec.core.files import Closing

_QUIET_S = 10.0
"""Minimum time before the first line and between lines; a shorter job prints none."""
_SHARE = 0.05
"""Part of the elapsed time after which the next line is due."""
_LONGEST_S = 300.0
"""Time after which the next line is due in any case."""
_BAR = "{l_bar}{bar}| {n_fmt}/{total_fmt} [{elapsed}{postfix}]"
"""Without tqdm's own estimate of the remaining time, which counts the start as work."""


class ProgressBar(Closing):
    """Progress counter of one job; a context manager.

    Shows a bar on a terminal. Elsewhere it prints a line when an item ends, at most every ten seconds, in a long job
    every five minutes. The remaining time is estimated from the first finished item on, because workers have started by
    then, and is shown after one more round.

    Args:
        title: Activity, as in "exporting".
        total: Number of items; 0 while unknown.
        done: Number of items finished before this call.
        unit: Noun for one item.
        at_once: Number of items processed at the same time.
        is_terminal: Whether to show a bar (default: whether standard error is a terminal).
        clock: Monotonic time in seconds.
    """

    def __init__(
        self,
        title: str,
        *,
        total: int = 0,
        done: int = 0,
        unit: str = "episode",
        at_once: int = 1,
        is_terminal: bool | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._title, self._unit, self._at_once, self._clock = title, unit, at_once, clock
        self.done, self.total = done, total
        self._first_end: tuple[float, int] | None = None  # time, and the number of finished items
        self._note = ""
        self._started = self._last_line = clock()
        self._bar: tqdm[Any] | None = None
        if sys.stderr.isatty() if is_terminal is None else is_terminal:
            self._bar = tqdm(desc=title, total=total, initial=done, unit=unit, dynamic_ncols=True)

    def close(self) -> None:
        """Remove the bar from the terminal; idempotent."""
        if self._bar is not None:
            self._bar.close()

    def advance(self) -> None:
        """Count one more finished item."""
        self.set(self.done + 1)

    def set(self, done: int, total: int | None = None) -> None:
        """Set the number of finished items, and `total` if only now known."""
        if self._first_end is None and done > self.done:
            self._first_end = self._clock(), done
        self.done = done
        self.total = self.total if total is None else total
        if self._bar is None:
            self._write_line_if_due()
            return
        self._bar.total = self.total
        self._bar.bar_format = _BAR if self.total else None
        self._bar.set_postfix_str(self._last_words(), refresh=False)
        self._bar.update(done - self._bar.n)

    def note(self, text: str) -> None:
        """Set the text shown with the count: "2 failed attempts"."""
        self._note = text
        if self._bar is not None:
            self._bar.set_postfix_str(self._last_words())

    def _write_line_if_due(self) -> None:
        now = self._clock()
        if now - self._last_line < max(_QUIET_S, min(_LONGEST_S, _SHARE * (now - self._started))):
            return
        self._last_line = now
        how_far = f"{self.done}"
        if self.total:
            how_far = f"{self.done} of {self.total} {self._unit}s ({100 * self.done // self.total} %)"
        passed = f"{duration(now - self._started)} passed"
        tell(", ".join(filter(None, (f"{self._title}: {how_far}", passed, self._last_words()))))

    def _last_words(self) -> str:
        """The estimated remaining time, if known, and the note."""
        words = [self._note] if self._note else []
        if self._first_end is not None and self.done < self.total:
            began, done_then = self._first_end
            if (since := self.done - done_then) >= self._at_once:
                left = (self._clock() - began) * (self.total - self.done) / since
                words.insert(0, f"about {duration(left)} left")
        return ", ".join(words)


def duration(seconds: float) -> str:
    """Format seconds in the most readable unit."""
    for unit, factor in (("days", 86400.0), ("h", 3600.0), ("min", 60.0)):
        if seconds >= 2 * factor:
            return f"{seconds / factor:.1f} {unit}"
    return f"{seconds:.0f} s"
