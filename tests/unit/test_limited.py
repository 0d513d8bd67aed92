"""The child process in which files are read: its limits, and the state that it passes on."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import psutil
import pytest

from demorec.core import limited
from demorec.core.limited import Limits

# A small program in between measures the peak: a child that Python starts by vfork inherits the peak of its parent,
# here pytest's own.
MEASURE = """
import resource, subprocess, sys
code = subprocess.run(sys.argv[2:]).returncode
open(sys.argv[1], "w").write(str(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss))
raise SystemExit(code if code >= 0 else 128 - code)
"""
START = """
import os, signal, sys, time
from demorec.core import limited
signal.signal(signal.SIGHUP, signal.SIG_DFL)  # ignored under nohup
limited.READING_CPU_S, limited.CPU_S_PER_MB = int(os.environ.get("TEST_CPU_S", 20)), 1
limited.continue_in_child(sys.argv[1:])
"""
FILL = "content = bytearray(1 << 30)\nprint('filled', flush=True)\n"
FILL_AND_WAIT = FILL + "time.sleep(60)\n"
FILL_SLOWLY = "content = []\nfor _ in range(400): content.append(bytes(range(250)) * 40_000); time.sleep(0.02)\n"
RESERVE = "import mmap\nheld = [mmap.mmap(-1, 1 << 30, mmap.MAP_PRIVATE) for _ in range(16)]\n"
SPIN = "while True: pass\n"
WAIT = "print('ready', os.getpid(), flush=True)\ntime.sleep(60)\n"
COUNT = """
heard = []
signal.signal(signal.SIGINT, lambda number, frame: heard.append(number))
print("ready", os.getpid(), flush=True)
end = time.monotonic() + 1
while time.monotonic() < end:
    time.sleep(0.01)
raise SystemExit(len(heard))
"""
WORKER = """
import subprocess
print(subprocess.run([sys.executable, "-c", "content = bytearray(1 << 30); input()"], stdin=0).returncode)
"""


class Ended(NamedTuple):
    """How a program ended."""

    code: int
    output: str
    errors: str
    peak_bytes: int


def run(work: str, *words: object, environment: Mapping[str, str] | None = None) -> Ended:
    """Run some lines in a limited child."""
    with tempfile.NamedTemporaryFile("r") as peak_kb:
        ended = subprocess.run(
            [sys.executable, "-c", MEASURE, peak_kb.name, sys.executable, "-c", START + work, *map(str, words)],
            capture_output=True,
            text=True,
            check=False,
            env=os.environ | (environment or {}),
        )
        return Ended(ended.returncode, ended.stdout, ended.stderr, 1024 * int(peak_kb.read()))


def started(work: str, *words: object) -> tuple[subprocess.Popen[str], psutil.Process]:
    """Start a program that reports readiness, and find its child."""
    command = [sys.executable, "-c", START + work, *map(str, words)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, start_new_session=True)
    assert process.stdout is not None
    ready, pid = process.stdout.readline().split()
    assert ready == "ready"
    return process, psutil.Process(int(pid))


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "given.mcap"
    path.write_bytes(bytes(400_000))
    return path


@pytest.mark.parametrize("code", [1, 130])
def test_the_exit_code_is_that_of_the_child(code: int, file: Path) -> None:
    assert run(f"print(os.getppid()); raise SystemExit({code})", "info", file).code == code


@pytest.mark.slow
@pytest.mark.parametrize("work", [FILL_AND_WAIT, FILL_SLOWLY])
def test_too_much_memory_is_one_sentence(work: str, file: Path) -> None:
    ended = run(work, "info", file)
    assert ended.code == 1
    assert ended.errors == (
        "demorec info: Reading this takes more than 508 MB of memory, far more than its 0.4 MB justify. It is damaged "
        f"or made to exhaust this machine; DEMOREC_LIMITS=off reads it anyway: {file}\n"
    )
    assert 500_000_000 < ended.peak_bytes < 2_000_000_000  # of 4 GB; a busy machine measures later


def test_memory_is_reserved_within_bounds(file: Path) -> None:
    """Reservations beyond those of libraries fail in the child itself."""
    assert "Cannot allocate memory" in run(RESERVE, "info", file).errors
    assert run(RESERVE, "info", file, environment={"DEMOREC_LIMITS": "off"}).code == 0


def test_memory_of_a_worker_counts(file: Path) -> None:
    ended = run(WORKER, "check", file)
    assert (ended.code, ended.output) == (1, "")
    assert "takes more than 508 MB of memory" in ended.errors


@pytest.mark.slow
@pytest.mark.parametrize("words", [["generate"], ["render"], ["check", "--deep"]])
def test_commands_that_render_may_take_more(words: list[str], file: Path) -> None:
    assert run(FILL, *words, file).output == "filled\n"


@pytest.mark.slow
def test_too_much_cpu_time_is_one_sentence(file: Path) -> None:
    ended = run(SPIN, "info", file, environment={"TEST_CPU_S": "1"})
    assert ended.code == 1
    assert ended.errors.startswith("demorec info: Reading this takes more than 1 s of CPU time")
    assert ended.errors.count("\n") == 1


def test_a_crash_is_one_sentence(file: Path) -> None:
    ended = run("os.kill(os.getpid(), signal.SIGSEGV)", "info", file)
    assert (ended.code, ended.errors.count("\n")) == (1, 1)
    assert "A library crashed while reading this (SIGSEGV)" in ended.errors
    assert str(file) in ended.errors


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_to_the_parent_is_passed_on(number: signal.Signals, file: Path) -> None:
    process, child = started(WAIT, "info", file)
    assert child.pid != process.pid
    process.send_signal(number)
    assert process.wait(20) == -number
    assert not child.is_running()


@pytest.mark.slow
def test_a_signal_to_both_reaches_the_child_once(file: Path) -> None:
    process, _ = started(COUNT, "info", file)
    os.killpg(process.pid, signal.SIGINT)
    assert process.wait(20) == 1


@pytest.mark.slow
def test_the_child_dies_with_its_parent(file: Path) -> None:
    process, child = started(WAIT, "info", file)
    process.kill()
    process.wait()
    _, alive = psutil.wait_procs([child], timeout=20)
    assert not alive


def test_limits_grow_with_the_named_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "run"
    (folder / "episodes").mkdir(parents=True)
    for number in range(3):
        (folder / "episodes" / f"{number}.mcap").write_bytes(bytes(1_000_000))
    (folder / "itself").symlink_to(folder)
    (folder / "nowhere").symlink_to(tmp_path / "missing")
    mapping = tmp_path / "mapping.toml"
    mapping.write_bytes(bytes(1_000_000))
    monkeypatch.chdir(tmp_path)
    words = ["import", "run", "run", f"--mapping={mapping}", "--out", "new", "--fps", "30", "a\0b"]
    limits = Limits.of(words)
    assert limits is not None
    assert limits.paths == ("run", str(mapping))
    assert limits.input_bytes == 4_000_000
    assert limits.memory_bytes == limited.READING_MEMORY_BYTES + 80_000_000
    assert limits.cpu_s == limited.READING_CPU_S + 40
    assert Limits.of(["generate", "--config", "mapping.toml"]) is None
    drawing = Limits.of(["render", "run"])
    assert drawing is not None
    assert drawing.cpu_s is None
