"""How far a command is: a bar on a terminal, now and then a line in a log file (Slurm, nohup, CI)."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable
from typing import Any

from tqdm import tqdm

from demorec.cli.shared.output import tell
from demorec.core.files import Closing

_QUIET_S = 10.0
"""Time before the first line, and between the first ones: what is over by then needs none."""
_SHARE = 0.05
"""Share of the time that has passed after which the next line is due."""
_LONGEST_S = 300.0
"""Longest time without a line."""
_BAR = "{l_bar}{bar}| {n_fmt}/{total_fmt} [{elapsed}{postfix}]"
"""Without tqdm's own time that is left, which counts the start as work."""


class ProgressBar(Closing):
    """Counts what is done of one job; a context manager.

    On a terminal a bar. Elsewhere a line every ten seconds, in a long job every 5 % of the time that has passed, but
    at least every five minutes. The time that is left is counted from the first end on, when all that has to start has
    started, and shown after one more round.

    Args:
        title: What is being done, as in "exporting".
        total: How many things there are; 0 when it is not known yet.
        done: How many of them were done before.
        unit: What one of them is called.
        at_once: How many of them are worked on at the same time.
        is_terminal: Whether a person watches (default: whether standard error is a terminal).
        clock: Seconds, monotonic.
        quiet: Time before the first line, seconds.
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
        quiet: float = _QUIET_S,
    ) -> None:
        self._title, self._unit, self._clock, self._quiet = title, unit, clock, quiet
        self.done, self.total = done, total
        self._at_once = at_once
        self._first_end: tuple[float, int] | None = None  # when, and how many were done then
        self._note = ""
        self._started = self._last_line = clock()
        watched = sys.stderr.isatty() if is_terminal is None else is_terminal
        self._bar: tqdm[Any] | None = None
        self._closed = threading.Event()
        self._writer: threading.Thread | None = None
        if watched:
            self._bar = tqdm(desc=title, total=total, initial=done, unit=unit, dynamic_ncols=True)
        else:
            self._writer = threading.Thread(target=self._write_lines, daemon=True)
            self._writer.start()

    def close(self) -> None:
        """Take the bar off the terminal's last line, let no line follow; harmless when called twice."""
        self._closed.set()
        if self._writer is not None:
            self._writer.join()
        if self._bar is not None:
            self._bar.close()

    def advance(self) -> None:
        """One more is done."""
        self.set(self.done + 1)

    def set(self, done: int, total: int | None = None) -> None:
        """So many are done, of `total` if that is known only now."""
        if self._first_end is None and done > self.done:
            self._first_end = self._clock(), done
        self.done = done
        self.total = self.total if total is None else total
        if self._bar is not None:
            self._bar.total = self.total
            self._bar.bar_format = _BAR if self.total else None
            self._bar.set_postfix_str(self._last_words(), refresh=False)
            self._bar.update(done - self._bar.n)

    def note(self, text: str) -> None:
        """Something to be shown with the count from now on: "2 failed attempts"."""
        self._note = text
        if self._bar is not None:
            self._bar.set_postfix_str(self._last_words())

    def _write_lines(self) -> None:
        """However long one of the things takes: a thread of its own."""
        while not self._closed.wait(self._quiet / 9):  # so that a line is hardly later than it should be
            self.write_line_if_due()

    def write_line_if_due(self) -> None:
        """Write how far the job is, unless that was done a short time ago."""
        now = self._clock()
        if now - self._last_line < max(self._quiet, min(_LONGEST_S, _SHARE * (now - self._started))):
            return
        self._last_line = now
        how_far = f"{self.done}"
        if self.total:
            how_far = f"{self.done} of {self.total} {self._unit}s ({100 * self.done // self.total} %)"
        passed = f"{duration(now - self._started)} passed"
        tell(", ".join(filter(None, (f"{self._title}: {how_far}", passed, self._last_words()))))

    def _last_words(self) -> str:
        """How much time is left, if that can be estimated, and the note."""
        words = [self._note] if self._note else []
        if self._first_end is not None and self.done < self.total:
            began, done_then = self._first_end
            if (since := self.done - done_then) >= self._at_once:
                left = (self._clock() - began) * (self.total - self.done) / since
                words.insert(0, f"about {duration(left)} left")
        return ", ".join(words)


def duration(seconds: float) -> str:
    """Seconds in the unit that reads best."""
    for unit, factor in (("days", 86400.0), ("h", 3600.0), ("min", 60.0)):
        if seconds >= 2 * factor:
            return f"{seconds / factor:.1f} {unit}"
    return f"{seconds:.0f} s"
