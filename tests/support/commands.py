"""Run commands in this process as from the command line; find the workers of commands that run in another process."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from typing import Any

import psutil

from demorec.cli import main

ON_A_PATH = {
    "info": "info PATH",
    "check": "check PATH --no-images",
    "view": "view PATH --save NEW.rrd",
    "report": "report PATH --out NEW.html",
    "export": "export lerobot PATH --out NEW --no-verify",
    "replay": "replay PATH",
    "render": "render PATH --out NEW --workers 1",
    "generate": "generate --config PATH --out NEW --workers 1 --no-check --no-export",
    "recover": "recover PATH --out NEW.mcap",
}
"""Calls of every command that takes recordings, runs or datasets, with a PATH; names of outputs begin with NEW."""
ON_EVERYTHING = ("info", "check", "view", "report", "export")
"""Calls of commands that also read bags and other formats."""
OTHERS = {"import", "dataset", "evaluate", "correct", "list", "explain"}
"""Commands with other inputs."""


def words_of(call: str, path: object, new: object) -> list[str]:
    """Return the arguments of a call such as those of `ON_A_PATH`."""
    return [word.replace("PATH", str(path)).replace("NEW", str(new)) for word in call.split()]


def exit_code(*arguments: object, program: Callable[[list[str]], object] = main) -> int:
    """Run `demorec ARGUMENTS...` in this process and return its exit code."""
    try:
        program([str(argument) for argument in arguments])
    except SystemExit as ended:
        return int(ended.code or 0)
    raise AssertionError("a command ends by SystemExit")


def workers_of(process: subprocess.Popen[Any]) -> list[psutil.Process]:
    """Worker processes of a running command; empty when it has ended."""
    try:
        below = psutil.Process(process.pid).children(recursive=True)
        return [child for child in below if "spawn_main" in " ".join(child.cmdline())]
    except psutil.Error:
        return []
