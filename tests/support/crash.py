"""Run commands in forked children and kill them at any change of the file system, the same one on every machine."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import pytest

from demorec.cli import main

TIMEOUT_S = 600
"""A child that takes longer counts as hung, and is killed."""
_UNEXPECTED = 99
"""Exit code of a child whose command raised an exception."""
_CHANGES = ("os.mkdir", "os.rmdir", "os.remove", "os.rename", "os.link", "os.truncate")
_WRITING = os.O_WRONLY | os.O_RDWR


@dataclass(frozen=True, kw_only=True)
class Ended:
    """Result of a command: exit code (-N after signal N), its lines on standard error, number of file changes."""

    code: int
    said: tuple[str, ...]
    num_changes: int


class Running:
    """A command in a forked child, which shares the modules that this process has loaded.

    Args:
        words: The command line without the program's name.
        folder: Current folder of the command; changes of files below it are counted.
        program: Takes the command line, and ends by SystemExit.
        at: Number of a change, from 1; 0 for none.
        act: Called in the child before that change with 0, before the next one with 1, and so on.
    """

    def __init__(
        self,
        words: Sequence[str],
        folder: Path,
        *,
        program: Callable[[list[str]], object] = main,
        at: int = 0,
        act: Callable[[int], object] = lambda number: None,
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
                _count_changes(folder, at, act, counted)
                program(list(words))
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
        """Wait until the child has ended."""
        with os.fdopen(self._said, errors="replace") as said, os.fdopen(self._counted, "rb") as counted:
            lines, num_changes = said.read().splitlines(), len(counted.read())
        code = os.waitstatus_to_exitcode(os.waitpid(self._pid, 0)[1])
        assert code not in (_UNEXPECTED, -signal.SIGALRM), (code, lines)
        said_by_us = tuple(line for line in lines if line.startswith("demorec "))
        return Ended(code=code, said=said_by_us, num_changes=num_changes)


def run_command(words: Sequence[str], folder: Path, **arguments: object) -> Ended:
    """Run a command in a child to its end; arguments as of `Running`."""
    return Running(words, folder, **arguments).wait()  # type: ignore[arg-type]


class SmallDisk:
    """An empty file system in memory, of variable size, visible to this process alone.

    Args:
        folder: Where it is mounted.

    Raises:
        OSError: The kernel does not let this user mount it.
    """

    def __init__(self, folder: Path) -> None:
        self.folder, user, group = folder, os.getuid(), os.getgid()
        os.unshare(os.CLONE_NEWUSER | os.CLONE_NEWNS)
        for name, text in (("setgroups", "deny"), ("uid_map", f"0 {user} 1"), ("gid_map", f"0 {group} 1")):
            Path("/proc/self", name).write_text(text)
        self._mount("size=1g")

    def _mount(self, options: str) -> None:
        command = ["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(self.folder)]
        if subprocess.run(command, capture_output=True, check=False).returncode:
            raise OSError(f"mount -o {options} is refused")

    @property
    def num_used(self) -> int:
        """Used size, bytes."""
        status = os.statvfs(self.folder)
        return (status.f_blocks - status.f_bfree) * status.f_frsize

    def resize(self, num_bytes: int = 1 << 30) -> None:
        """Change the size, in bytes (default: 1 GB); the minimum is one page."""
        self._mount(f"remount,size={num_bytes or 1}")  # 0 means unlimited


def on_small_disk(folder: Path, work: Callable[[SmallDisk], object]) -> None:
    """Run `work` in a forked child with a small disk; its failure fails the test.

    The test is skipped where the kernel does not let this user mount one.
    """
    reading, writing = os.pipe()
    pid = os.fork()
    if pid == 0:
        told = b""
        try:
            disk = SmallDisk(folder)
        except OSError as error:
            told = f"skip: the kernel does not let this user mount a private file system ({error})".encode()
        else:
            try:
                work(disk)
            except BaseException:
                told = traceback.format_exc().encode()
        os.write(writing, told[-60_000:])
        os._exit(0)
    os.close(writing)
    with os.fdopen(reading, errors="replace") as file:
        said = file.read()
    os.waitpid(pid, 0)
    if said.startswith("skip: "):
        pytest.skip(said.removeprefix("skip: "))
    if said:
        pytest.fail(said, pytrace=False)


def _count_changes(folder: Path, at: int, act: Callable[[int], object], counted: int) -> None:
    """Note each change of the file system below a folder as a byte in a pipe, and call `act` before one of them."""
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
    """Whether a path is in the current folder; false for open descriptors."""
    if not isinstance(path, str | bytes | os.PathLike):
        return False
    name = os.fsdecode(path)
    return not name.startswith("/") or name.startswith(folder)
