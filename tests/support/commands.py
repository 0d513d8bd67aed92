"""Commands as a user types them, in this process; and the workers of those that run in one of their own."""

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
"""How every command that takes recordings, runs or datasets is called with a PATH; what it makes begins with NEW."""
ON_EVERYTHING = ("info", "check", "view", "report", "export")
"""Those that read bags and other formats, too."""
OTHERS = {"import", "dataset", "evaluate", "correct", "list", "explain"}
"""Commands that take other things."""


def words_of(call: str, path: object, new: object) -> list[str]:
    """The words of a call such as those of `ON_A_PATH`."""
    return [word.replace("PATH", str(path)).replace("NEW", str(new)) for word in call.split()]


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
