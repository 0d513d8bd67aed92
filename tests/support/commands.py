"""Commands as a user types them: in this process for their exit code, or in one of their own with what they took.

Starting Python and its libraries takes longer than refusing a file, so one process serves a whole test module. It runs
this file as a script.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import subprocess
import sys
import traceback
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, Self

import psutil

from demorec.cli import COMMANDS, main

MOST_BYTES = 500_000_000
_PATIENCE_SECONDS = 240.0


def exit_code(*arguments: object, program: Callable[[list[str]], object] = main) -> int:
    """The exit code of a command that is run in this process: `demorec ARGUMENTS...`."""
    try:
        program([str(argument) for argument in arguments])
    except SystemExit as ended:
        return int(ended.code or 0)
    raise AssertionError("a command ends by SystemExit")


def workers_of(process: subprocess.Popen[Any]) -> list[psutil.Process]:
    """The worker processes below a command that runs; none when it has ended."""
    try:
        below = psutil.Process(process.pid).children(recursive=True)
        return [child for child in below if "spawn_main" in " ".join(child.cmdline())]
    except psutil.Error:
        return []


class Told(NamedTuple):
    """What a command answered: exit code (None for an exception that left it), both outputs, memory, CPU seconds."""

    code: int | None
    text: str
    peak_bytes: int
    seconds: float


class Commands:
    """Context manager over the process."""

    def __enter__(self) -> Self:
        # As a module: as a script its folder would come first, and `support/mcap.py` would be what `import mcap` finds.
        self._process = subprocess.Popen(
            # -P: the modules beside this file (mcap, docs ...) must not stand before the libraries of their names.
            [sys.executable, "-P", __file__],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        return self

    def __exit__(
        self, exc_type: type[BaseException] | None, exc: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._process.kill()
        self._process.communicate()

    def run(self, *arguments: str | Path) -> Told:
        """Run a command; a hang ends the process, and so the test."""
        import threading

        assert self._process.stdin is not None
        assert self._process.stdout is not None
        alarm = threading.Timer(_PATIENCE_SECONDS, self._process.kill)
        alarm.start()
        try:
            self._process.stdin.write(json.dumps([str(argument) for argument in arguments]) + "\n")
            self._process.stdin.flush()
            line = self._process.stdout.readline()
        finally:
            alarm.cancel()
        assert line, f"no answer within {_PATIENCE_SECONDS} s, or the process died: {arguments}"
        return Told(*json.loads(line))

    def refused(self, *arguments: str | Path) -> str:
        """What a command says that must refuse: a sentence, with little memory."""
        told = self.run(*arguments)
        assert told.code in (1, 2), told.text
        assert told.peak_bytes < MOST_BYTES, told
        return told.text


def _serve() -> None:
    import time

    for name in COMMANDS.names():
        COMMANDS.load(name)
    answers = os.fdopen(os.dup(1), "w")
    for line in sys.stdin:
        Path("/proc/self/clear_refs").write_text("5")  # the largest memory is measured anew
        said = io.StringIO()
        code: int | None = 0
        started = time.process_time()
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
            try:
                main(json.loads(line))
            except SystemExit as end:
                code = int(end.code or 0)
            except BaseException:
                code = None
                said.write(traceback.format_exc())
        status = dict(row.split(":", 1) for row in Path("/proc/self/status").read_text().splitlines())
        peak = 1024 * int(status["VmHWM"].split()[0])
        answers.write(json.dumps([code, said.getvalue(), peak, time.process_time() - started]) + "\n")
        answers.flush()


if __name__ == "__main__":
    _serve()
