"""Limits on memory and CPU time for commands that read files of unknown origin.

Such a command runs in a child process, forked before any library is loaded. The parent waits for it, kills it if it
exceeds its limits, and reports its death in one sentence. Limits grow with the size of the files that the command line
names.

Memory means pages that the child has filled (resident and private), which the parent checks 20 to 100 times a second.
RLIMIT_DATA also counts memory that is only reserved: 1 GB each by PyArrow and Rerun, and thread stacks. It is therefore
set higher, as a limit that holds even when the parent is not scheduled in time.
"""

from __future__ import annotations

import os
import resource
import signal
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import NamedTuple, NoReturn

from demorec.core.extension import command_rows

VARIABLE = "DEMOREC_LIMITS"
"""Environment variable; "off" removes the limits, for trusted files."""
READING_MEMORY_BYTES = 500_000_000
DRAWING_MEMORY_BYTES = 4_000_000_000
"""For commands that simulate or render: their time and memory depend on frames and pixels, not on bytes. Rendering two
cameras at 1920x1080 to AV1 with depth takes 0.8 GB."""
MEMORY_RATIO = 20
"""Bytes of memory per byte of input."""
READING_CPU_S = 20
"""10 s for reading, and 10 s for loading libraries and compiling kernels on first use (LeRobot takes 5 s, kernels 4 s).
"""
CPU_S_PER_MB = 10
"""`check` takes 2 s per MB of a recording."""

RESERVED_BYTES = 6_000_000_000
"""Memory that libraries and their threads may reserve without filling it."""
RESERVED_BYTES_PER_CORE = 200_000_000
"""A thread has an 8 MB stack and a 64 MB arena; several libraries start one thread per core."""

_TICK_S = 0.05
"""Interval between two checks of the child's memory."""
_LARGE_TICK_S = 0.01
"""Interval above half of the limit."""
_MAX_FILES = 20_000
"""Maximum number of files whose sizes are summed; further files of a large folder do not raise the limits."""
_MAX_NAMES = 3
"""Maximum number of paths in a sentence."""
_FORWARDED = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_CRASHES = (signal.SIGSEGV, signal.SIGBUS, signal.SIGABRT, signal.SIGFPE, signal.SIGILL)
_SET_PDEATHSIG = 1
"""Option of prctl(2)."""


class Limits(NamedTuple):
    """Limits of one child process; `paths` are the existing files and folders on the command line."""

    paths: tuple[str, ...]
    input_bytes: int
    memory_bytes: int
    cpu_s: int | None

    @classmethod
    def of(cls, words: Sequence[str]) -> Limits | None:
        """Limits for a command line without the program's name; None for a command without limits."""
        command = words[0] if words else ""
        row = command_rows().get(command)
        if row is None or row.limits == "none":
            return None
        is_drawing = row.limits == "drawing" or any(flag in words for flag in row.drawing_flags)
        paths = tuple(_paths_in(words[1:]))
        size = sum(_sizes_below(paths))
        floor = DRAWING_MEMORY_BYTES if is_drawing else READING_MEMORY_BYTES
        cpu_s = None if is_drawing else READING_CPU_S + CPU_S_PER_MB * size // 1_000_000
        return cls(paths, size, floor + MEMORY_RATIO * size, cpu_s)


def continue_in_child(words: Sequence[str]) -> None:
    """Continue in a limited child process; the parent exits with the child's exit status.

    Signals sent to the parent alone are forwarded, and the child dies with the parent. Does not fork if there are no
    limits for these words, the command line without the program's name.
    """
    if os.environ.get(VARIABLE) == "off":
        return
    limits = Limits.of(words)
    if limits is None:
        return
    heard, hears = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
    usual = signal.pthread_sigmask(signal.SIG_BLOCK, (*_FORWARDED, signal.SIGCHLD))
    parent = os.getpid()
    child = os.fork()
    if child == 0:
        os.close(heard)
        _limit_this_process(parent, limits)
        signal.set_wakeup_fd(hears, warn_on_full_buffer=False)
        signal.pthread_sigmask(signal.SIG_SETMASK, usual)
        return
    code, is_too_large = _watch(child, heard, limits.memory_bytes)
    if code >= 0:
        os._exit(code)
    _tell_death(words[0], limits, signal.Signals(-code), is_too_large)


def remove_limits() -> None:
    """Lift the limits on CPU time and reserved memory for an interactive program (a viewer)."""
    for kind in (resource.RLIMIT_CPU, resource.RLIMIT_DATA):
        hard = resource.getrlimit(kind)[1]
        resource.setrlimit(kind, (hard, hard))


def end_with_parent(parent: int) -> None:
    """Let the kernel kill this process when the parent's thread that started it ends."""
    import ctypes

    ctypes.CDLL(None).prctl(_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # the parent was killed before this call
        os._exit(1)


def _limit_this_process(parent: int, limits: Limits) -> None:
    end_with_parent(parent)
    reserved = RESERVED_BYTES + RESERVED_BYTES_PER_CORE * (os.cpu_count() or 1)
    _lower(resource.RLIMIT_DATA, limits.memory_bytes + reserved)
    if limits.cpu_s is not None:
        _lower(resource.RLIMIT_CPU, limits.cpu_s)


def _lower(kind: int, value: int) -> None:
    """Lower the soft limit of a resource unless it is already lower."""
    soft, hard = resource.getrlimit(kind)
    resource.setrlimit(kind, (value if soft == resource.RLIM_INFINITY else min(soft, value), hard))


def _watch(child: int, heard: int, memory_bytes: int) -> tuple[int, bool]:
    """Wait for the child; return its exit code (-N after signal N) and whether it was killed for its memory."""
    tick_s = _TICK_S
    while True:
        told = signal.sigtimedwait((*_FORWARDED, signal.SIGCHLD), tick_s)
        if told is None:
            started = _words_of(f"/proc/{child}/task/{child}/children")  # started by its main thread, such as workers
            family = [child, *map(int, started)]
            filled = max(map(_private_bytes, family))
            tick_s = _LARGE_TICK_S if filled > memory_bytes // 2 else _TICK_S
            if filled > memory_bytes:
                for pid in family:
                    with suppress(ProcessLookupError):
                        os.kill(pid, signal.SIGKILL)
                return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), True
        elif told.si_signo == signal.SIGCHLD:
            pid, status = os.waitpid(child, os.WNOHANG)
            if pid == child:
                return os.waitstatus_to_exitcode(status), False
        elif told.si_code <= 0:  # sent by a process; the terminal signals the whole group
            _pass_on(told.si_signo, child, heard)


def _pass_on(number: int, child: int, heard: int) -> None:
    """Forward a signal to the child unless the whole group received it: a second one would interrupt its clean-up."""
    time.sleep(_LARGE_TICK_S)
    try:
        numbers = os.read(heard, 4096)  # written by Python's own handler (signal.set_wakeup_fd)
    except BlockingIOError:
        numbers = b""
    if number not in numbers:
        os.kill(child, number)


def _private_bytes(pid: int) -> int:
    """Memory that a process has filled; 0 if it has ended."""
    _, resident, shared, *_ = _words_of(f"/proc/{pid}/statm") or ("0", "0", "0")
    return (int(resident) - int(shared)) * resource.getpagesize()


def _words_of(path: str) -> list[str]:
    """Read the words of a file in /proc; empty if the process has ended."""
    try:
        return Path(path).read_text().split()
    except OSError:
        return []


def _tell_death(command: str, limits: Limits, number: signal.Signals, is_too_large: bool) -> NoReturn:
    """Print why the child died, in one sentence, or die of the same signal if a person or program sent it."""
    from demorec.core.text import printable

    beyond = f"far more than its {limits.input_bytes / 1e6:,.1f} MB justify"
    remedy = f"It is damaged or made to exhaust this machine; {VARIABLE}=off reads it anyway"
    if is_too_large:
        reason = f"Reading this takes more than {limits.memory_bytes / 1e6:,.0f} MB of memory, {beyond}. {remedy}"
    elif number == signal.SIGXCPU:
        reason = f"Reading this takes more than {limits.cpu_s} s of CPU time, {beyond}. {remedy}"
    elif number in _CRASHES:
        reason = f"A library crashed while reading this ({number.name}). The file is damaged, or made to do that"
    elif number == signal.SIGKILL:
        reason = "This command was killed, perhaps for lack of memory. Free some memory and try again"
    else:
        signal.signal(number, signal.SIG_DFL)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, (number,))
        os.kill(os.getpid(), number)
        os._exit(128 + number)
    names = ", ".join(limits.paths[:_MAX_NAMES]) + ", ..." * (len(limits.paths) > _MAX_NAMES)
    begin = "\n" if os.isatty(2) else ""  # a progress bar may have left its line open
    with suppress(OSError):  # the terminal may be gone
        os.write(2, f"{begin}demorec {command}: {printable(f'{reason}: {names}')}\n".encode(errors="backslashreplace"))
    os._exit(1)


def _paths_in(words: Sequence[str]) -> Iterator[str]:
    """Existing files and folders among the words of a command line, also as --flag=PATH, each once."""
    for word in dict.fromkeys(words):
        path = word.partition("=")[2] if word.startswith("-") else word
        if path and "\0" not in path and os.path.lexists(Path(path).expanduser()):
            yield path


def _sizes_below(paths: Sequence[str]) -> Iterator[int]:
    """Sizes in bytes of files, including those in folders; links to folders are not followed."""
    places = (Path(path).expanduser() for path in paths)
    for file in islice((file for place in places for file in _files_below(place)), _MAX_FILES):
        with suppress(OSError):  # reported when the file is read
            yield file.stat().st_size


def _files_below(place: Path) -> Iterator[Path]:
    if not place.is_dir():
        yield place
    for folder, _, names in os.walk(place):
        for name in names:
            yield Path(folder, name)
