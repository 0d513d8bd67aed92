"""Commands in limited children, as the program runs them, with their memory and CPU time measured.

Starting Python and its libraries takes longer than refusing a file. So one process loads them, and every command runs
in a fork of it: a fuzz of thousands of cases starts Python once.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import json
import os
import random
import resource
import subprocess
import sys
import tempfile
import traceback
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, NamedTuple, Self

from demorec.cli import COMMANDS, main
from demorec.cli.shared.flags import parse
from demorec.core import limited
from demorec.core.errors import DemorecError
from demorec.core.text import printable

if TYPE_CHECKING:
    from support.fuzz_data import Fuzzed

MAX_BYTES = 600_000_000
"""Private memory for an input of less than a megabyte: 500 MB, 20 MB, and growth until the parent measures again."""
READING_CPU_S = 6
"""Limit of these commands, whose libraries are loaded: an attack that computes without end costs less time here."""
MAX_CPU_S = 18.0
"""The limit, 10 s for a megabyte, and the processes around the command."""


class Told(NamedTuple):
    """Result of a command: exit code (None after a signal or an exception), outputs, private memory, CPU seconds."""

    code: int | None
    text: str
    peak_bytes: int
    seconds: float


class LimitedCommands:
    """Context manager over the process that runs commands in forks.

    Args:
        modules: Loaded before the first command, so that no case pays for them.
    """

    def __init__(self, modules: Sequence[str] = ()) -> None:
        self._modules = modules

    def __enter__(self) -> Self:
        # -P: the modules in this folder (mcap, docs ...) must not shadow libraries of the same name.
        command = [sys.executable, "-P", __file__, *self._modules]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        return self

    def __exit__(
        self, exc_type: type[BaseException] | None, exc: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._process.kill()
        self._process.communicate()

    def run(self, *arguments: str | Path) -> Told:
        """Run `demorec ARGUMENTS...`; the code is None when the command was ended by a signal or an exception."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps([str(argument) for argument in arguments]) + "\n")
        self._process.stdin.flush()
        line = self._process.stdout.readline()
        assert line, "the process that runs commands has ended"
        return Told(*json.loads(line))

    def refused(self, *arguments: str | Path) -> str:
        """Check that a command refuses its input with one sentence, within the limits, and return the sentence."""
        told = self.run(*arguments)
        assert told.code in (1, 2), told
        assert problem_of(told) == "", told
        return told.text


def problem_of(told: Told) -> str:
    """Describe the fault of a command's reaction to any input; "" if there is none.

    Accepted are success, and exit code 1 or 2 with a sentence: no traceback, no bug report, bounded memory and time.
    """
    if told.code not in (0, 1, 2):
        return f"exit code {told.code} after {told.seconds:.1f} s"
    for words in ("please report it", "Traceback (most recent call last)"):
        if words in told.text:
            return f"says {words!r}"
    if told.code and not told.text.strip():
        return "fails without a word"
    if told.peak_bytes > MAX_BYTES:
        return f"takes {told.peak_bytes / 1e6:.0f} MB"
    return f"takes {told.seconds:.1f} s" if told.seconds > MAX_CPU_S else ""


def changed_bytes(data: bytes, chance: random.Random) -> bytes:
    """Copy with some bytes exchanged, removed, doubled or cut off."""
    changed = bytearray(data)
    for _ in range(chance.choice((1, 1, 2, 4, 16))):
        at = chance.randrange(max(1, len(changed)))
        match chance.randrange(6):
            case 0:
                changed[at : at + 1] = bytes([chance.randrange(256)])
            case 1:
                changed[at : at + 1] = bytes([chance.choice((0, 1, 127, 128, 255))])
            case 2:
                size = chance.choice((2, 4, 8))
                number = chance.choice((0, 1, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, 2**63, 2**64 - 1)) % 256**size
                changed[at : at + size] = number.to_bytes(size, "little")
            case 3:
                del changed[at : at + chance.choice((1, 4, 64))]
            case 4:
                changed[at:at] = changed[at : at + chance.choice((1, 16, 256))]
            case _:
                if chance.random() < 0.3:
                    del changed[at:]
    return bytes(changed)


def results_here(fuzzed: Fuzzed, numbers: Iterable[int]) -> Counter[str]:
    """Run commands in this process, inside the handler of unexpected errors: any other exception fails the test."""
    results: Counter[str] = Counter()
    for number in numbers:
        what, (name, *arguments) = fuzzed.case(number)
        said = io.StringIO()
        try:
            with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
                parse(COMMANDS.load(name), arguments, prog=f"demorec {name}").run()
            results["done"] += 1
        except DemorecError as error:
            results["refused" if 0 < len(str(error)) < 4000 else "refused without words, or with too many"] += 1
        except Exception as error:
            raise AssertionError(f"case {number}, {what}: demorec {name} {' '.join(arguments)}") from error
        assert all(printable(line) == line for line in said.getvalue().split("\n")), said.getvalue()
        fuzzed.clear()
    assert results.keys() <= {"done", "refused"}, results
    return results


def problems_within_limits(fuzzed: Fuzzed, numbers: Iterable[int], modules: Sequence[str]) -> list[str]:
    """Run commands in separate processes with little memory and time."""
    found = []
    with LimitedCommands(modules) as commands:
        for number in numbers:
            what, arguments = fuzzed.case(number)
            told = commands.run(*arguments)
            if problem := problem_of(told):
                found.append(f"case {number}, {what}: {problem}: {told.text[-300:]}")
            fuzzed.clear()
    return found


def _serve(modules: Sequence[str]) -> None:
    for name in COMMANDS.names():
        COMMANDS.load(name)
    for name in modules:
        importlib.import_module(name)
    limited.READING_CPU_S = READING_CPU_S
    answers = os.fdopen(os.dup(1), "w")
    libraries = resource.getpagesize() * int(Path("/proc/self/statm").read_text().split()[2])
    for line in sys.stdin:
        with tempfile.TemporaryFile("w+") as said:
            child = os.fork()
            if child == 0:
                _run(json.loads(line), said.fileno())
            _, status, used = os.wait4(child, 0)
            said.seek(0)
            code = os.waitstatus_to_exitcode(status)
            answer = (
                code if 0 <= code < 100 else None,
                said.read(),
                1024 * used.ru_maxrss - libraries,
                used.ru_utime + used.ru_stime,
            )
        answers.write(json.dumps(answer) + "\n")
        answers.flush()


def _run(arguments: list[str], output: int) -> None:
    """Run a command in this process, a fork, which ends with it."""
    code = 100
    try:
        os.dup2(output, 1)
        os.dup2(output, 2)
        sys.stdin = io.StringIO()
        sys.stdout = sys.stderr = open(output, "w", closefd=False)  # noqa: SIM115
        limited.continue_in_child(arguments)
        main(arguments)
    except SystemExit as end:
        code = int(end.code or 0)
    except BaseException:
        traceback.print_exc()
    finally:
        with contextlib.suppress(OSError, ValueError):
            sys.stdout.flush()
        os._exit(code)


if __name__ == "__main__":
    _serve(sys.argv[1:])
