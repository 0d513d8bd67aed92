"""Commands as a user types them, in this process; and the workers of those that run in one of their own."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from typing import Any

import psutil

from demorec.cli import main


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
