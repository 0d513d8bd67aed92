"""The only output of commands to a terminal: lines and tables in which foreign text cannot act, and progress.

A file name, a task or a message of a recording may contain escape codes or line ends; `printable` escapes them in every
line that is written here. `print` is forbidden in the package (ruff's T20).
"""

from __future__ import annotations

import contextlib
import json
import logging
import re
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, TextIO

from tqdm import tqdm

from demorec.core.errors import DemorecError
from demorec.core.files import Closing
from demorec.core.streams import drop_output
from demorec.core.text import printable


class OutputError(DemorecError):
    """Standard output cannot take the answer: the disk behind it is full, for example."""


_names: dict[str, str] = {}
"""Path of a temporary run -> the user's name for it, while such runs are read."""
_EPISODE_FILE = r"(?:/episodes/episode_0*(\d+)\.mcap)?"


@contextlib.contextmanager
def renamed(names: Mapping[str, str]) -> Iterator[Callable[[Any], Any]]:
    """Print `names[path]` for a path, and "NAME: episode 3" for a recording in it.

    Yields the function that renames, in texts and in nested lists and dicts of texts.
    """
    _names.update(names)
    try:
        yield _in_users_words
    finally:
        for path in names:
            del _names[path]


def _in_users_words(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _in_users_words(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_in_users_words(item) for item in value]
    if isinstance(value, str):
        for path, name in _names.items():
            if path in value:
                value = re.sub(
                    re.escape(path) + _EPISODE_FILE,
                    lambda found, name=name: f"{name}: episode {found[1]}" if found[1] else name,  # type: ignore[misc]
                    value,
                )
    return value


def say(*lines: str) -> None:
    """Write lines to standard output, which is for the command's answer.

    Raises:
        OutputError: They cannot be written.
        BrokenPipeError: The reader has left (`| head`).
    """
    _write(sys.stdout, lines)


def say_json(value: object) -> None:
    """Write a value as JSON to standard output; non-ASCII characters are escaped by JSON."""
    say(*json.dumps(_in_users_words(value), indent=2).splitlines())


def tell(*lines: str) -> None:
    """Write lines to standard error: notes besides the answer. Never fails."""
    with contextlib.suppress(OSError, OutputError):  # when the terminal is closed
        _write(sys.stderr, lines)


def counted(count: int, noun: str) -> str:
    """Count with a noun: "1 episode", "2 episodes"."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def _write(stream: TextIO, lines: tuple[str, ...]) -> None:
    text = "".join(f"{printable(_in_users_words(line))}\n" for line in lines)
    encoding = stream.encoding or "utf-8"
    text = text.encode(encoding, "backslashreplace").decode(encoding)  # the terminal has another encoding
    try:
        with tqdm.external_write_mode(file=stream):  # clears progress bars while writing
            stream.write(text)
            stream.flush()
    except OSError as error:
        drop_output(stream.fileno())
        if isinstance(error, BrokenPipeError):
            raise
        raise OutputError(f"The answer cannot be written ({error.strerror}): {stream.name}") from error


class PrintableFormatter(logging.Formatter):
    """Formatter that escapes log lines; those of libraries begin with their level, demorec's are sentences."""

    def format(self, record: logging.LogRecord) -> str:
        """One line, or several for a traceback, each made printable."""
        level = "" if record.name.startswith("demorec.") else f"{record.levelname}: "
        return "\n".join(printable(line) for line in f"{level}{super().format(record)}".splitlines())


def aligned(rows: Iterable[Sequence[str]]) -> list[str]:
    """Join columns of equal width by two spaces, for a terminal that shows `printable` text."""
    table = [[printable(cell) for cell in row] for row in rows]
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    return ["  ".join(map(str.ljust, row, widths)).rstrip() for row in table]


def size_in_words(num_bytes: float) -> str:
    """Format bytes in the most readable unit."""
    for unit, factor in (("TB", 1e12), ("GB", 1e9), ("MB", 1e6)):
        if num_bytes >= factor:
            return f"{num_bytes / factor:.1f} {unit}"
    return f"{num_bytes / 1e3:.0f} kB"


_QUIET_S = 60.0
"""Minimum time before the first line of progress and between lines, seconds; a shorter job prints none."""


class ProgressBar(Closing):
    """Progress counter of one job; a context manager.

    Shows a bar on a terminal. Elsewhere it prints a line when an item ends, at most one a minute.

    Args:
        title: Activity, as in "exporting".
        total: Number of items; 0 while unknown.
        done: Number of items finished before this call.
        unit: Noun for one item.
        clock: Monotonic time in seconds.
    """

    def __init__(
        self,
        title: str,
        *,
        total: int = 0,
        done: int = 0,
        unit: str = "episode",
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._title, self._unit, self._clock = title, unit, clock
        self.done, self.total = done, total
        self._note = ""
        self._started = self._last_line = clock()
        self._bar: tqdm[Any] | None = None
        if sys.stderr.isatty():
            self._bar = tqdm(desc=title, total=total or None, initial=done, unit=unit, dynamic_ncols=True)

    def close(self) -> None:
        """Remove the bar from the terminal; idempotent."""
        if self._bar is not None:
            self._bar.close()

    def advance(self) -> None:
        """Count one more finished item."""
        self.set(self.done + 1)

    def set(self, done: int, total: int | None = None) -> None:
        """Set the number of finished items, and `total` if only now known."""
        self.done = done
        self.total = self.total if total is None else total
        if self._bar is None:
            self._write_line_if_due()
            return
        self._bar.total = self.total or None
        self._bar.update(done - self._bar.n)

    def note(self, text: str) -> None:
        """Set the text shown with the count: "2 failed attempts"."""
        self._note = text
        if self._bar is not None:
            self._bar.set_postfix_str(text)

    def _write_line_if_due(self) -> None:
        now = self._clock()
        if now - self._last_line < _QUIET_S:
            return
        self._last_line = now
        share = f" of {self.total} {self._unit}s ({100 * self.done // self.total} %)" if self.total else ""
        passed = tqdm.format_interval(now - self._started)
        words = [f"{self._title}: {self.done}{share}", f"{passed} passed", self._note]
        tell(", ".join(filter(None, words)))
