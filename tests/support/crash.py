"""Commands that die, in a child of this process: at any change of the file system, which is the same on any machine."""

from __future__ import annotations

import os
import resource
import signal
import sys
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from demorec.cli import main

TIMEOUT_S = 60
"""After this a child counts as hung, and is killed."""
_UNEXPECTED = 99
"""Exit code of a child whose command raised something."""
_CHANGES = ("os.mkdir", "os.rmdir", "os.remove", "os.rename", "os.link", "os.truncate")
_WRITING = os.O_WRONLY | os.O_RDWR


@dataclass(frozen=True, kw_only=True)
class Ended:
    """How a command ended: exit code (-N after signal N), its own lines of standard error, changes of files."""

    code: int
    said: tuple[str, ...]
    num_changes: int


class Running:
    """A command in a forked child, which has loaded what this process has loaded.

    Args:
        words: The command line without the program's name.
        folder: Current folder of the command; changes of files below it are counted.
        at: Number of a change, from 1; 0 for none.
        act: Called in the child before that change with 0, before the next one with 1, and so on.
        max_bytes: Size that no file may exceed, as on a full disk; 0 for any.
    """

    def __init__(
        self,
        words: Sequence[str],
        folder: Path,
        *,
        at: int = 0,
        act: Callable[[int], object] = lambda number: None,
        max_bytes: int = 0,
    ) -> None:
        self._said, said = os.pipe()
        self._counted, counted = os.pipe()
        self._pid = os.fork()
        if self._pid == 0:
            try:
                signal.alarm(TIMEOUT_S)
                os.chdir(folder)
                os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
                os.dup2(said, 2)
                sys.stdout, sys.stderr = os.fdopen(1, "w"), os.fdopen(2, "w")
                if max_bytes:
                    resource.setrlimit(resource.RLIMIT_FSIZE, (max_bytes, max_bytes))
                _count_changes(folder, at, act, counted)
                main(list(words))
            except SystemExit as ended:
                sys.stderr.flush()
                os._exit(int(ended.code or 0))
            except BaseException:
                traceback.print_exc()
                sys.stderr.flush()
            os._exit(_UNEXPECTED)
        os.close(said)
        os.close(counted)

    def wait(self) -> Ended:
        """Wait until it has ended."""
        with os.fdopen(self._said, errors="replace") as said, os.fdopen(self._counted, "rb") as counted:
            lines, num_changes = said.read().splitlines(), len(counted.read())
        code = os.waitstatus_to_exitcode(os.waitpid(self._pid, 0)[1])
        assert code not in (_UNEXPECTED, -signal.SIGALRM), (code, lines)
        said_by_us = tuple(line for line in lines if line.startswith("demorec "))
        return Ended(code=code, said=said_by_us, num_changes=num_changes)


def run_command(words: Sequence[str], folder: Path, **arguments: object) -> Ended:
    """Run a command in a child to its end; arguments as of `Running`."""
    return Running(words, folder, **arguments).wait()  # type: ignore[arg-type]


def _count_changes(folder: Path, at: int, act: Callable[[int], object], counted: int) -> None:
    """Note each change of the file system below a folder as a byte in a pipe, and act before one of them."""
    count, pid = 0, os.getpid()

    def note(event: str, arguments: tuple[object, ...]) -> None:
        nonlocal count
        if not _is_change(event, arguments, str(folder)) or os.getpid() != pid:
            return
        count += 1
        os.write(counted, b"x")
        if count >= at > 0:
            act(count - at)

    sys.addaudithook(note)


def _is_change(event: str, arguments: tuple[object, ...], folder: str) -> bool:
    if event == "ctypes.dlsym":
        return arguments[1] == "renameat2"
    if event == "open":
        flags = arguments[2]
        return isinstance(flags, int) and bool(flags & _WRITING) and _is_below(arguments[0], folder)
    return event in _CHANGES and (_is_below(arguments[0], folder) or arguments[-1] != -1)  # the last is a descriptor


def _is_below(path: object, folder: str) -> bool:
    """Whether a path is in the folder, which is the current one; not of an open descriptor."""
    if not isinstance(path, str | bytes | os.PathLike):
        return False
    name = os.fsdecode(path)
    return not name.startswith("/") or name.startswith(folder)
