"""Processes of demorec do not run the user's script again, and find their functions by name."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

SCRIPT = """
import sys
from concurrent.futures import ProcessPoolExecutor
from math import sqrt

from demorec.core.processes import SPAWN

print("script")
with ProcessPoolExecutor(max_workers=2, mp_context=SPAWN) as pool:
    print(list(pool.map(sqrt, [4.0, 9.0])))
process = SPAWN.Process(target=print, args=("child",))
process.start()
process.join()
assert process.exitcode == 0
assert sys.modules["__main__"].__file__ == __file__
print("end")
"""


def told(*command: str, cwd: Path) -> list[str]:
    done = subprocess.run([sys.executable, *command], cwd=cwd, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


@pytest.mark.slow
def test_a_script_needs_no_main_guard(tmp_path: Path) -> None:
    (tmp_path / "script.py").write_text(SCRIPT)
    expected = ["[2.0, 3.0]", "child", "end", "script"]
    assert sorted(told("script.py", cwd=tmp_path)) == expected
    assert sorted(told("-m", "script", cwd=tmp_path)) == expected


SLEEPS = """
import time

def work(number):
    print("ready", flush=True)
    time.sleep(60)
"""
WAITS = """
from demorec.core.processes import in_turn
from work import work

try:
    list(in_turn(work, [1, 2], 2))
except KeyboardInterrupt:
    print("interrupted")
"""


@pytest.mark.slow
def test_a_second_ctrl_c_ends_the_wait_of_the_first(tmp_path: Path) -> None:
    """Only the parent receives it, so that nothing but the second one can end the workers."""
    (tmp_path / "work.py").write_text(SLEEPS)
    parent = subprocess.Popen(
        [sys.executable, "-c", WAITS], cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert parent.stdout is not None
    assert [parent.stdout.readline() for _ in range(2)] == ["ready\n"] * 2
    for _ in range(2):
        parent.send_signal(signal.SIGINT)
        time.sleep(1.0)
    out, errors = parent.communicate(timeout=40)
    assert (out, errors) == ("interrupted\n", "")


STARTS = """
import sys
from demorec.core.processes import start_program

process = start_program([sys.executable, "-c", "import time; print('ready', flush=True); time.sleep(600)"])
process.wait()
"""


@pytest.mark.slow
def test_a_program_ends_with_the_process_that_started_it(tmp_path: Path) -> None:
    parent = subprocess.Popen([sys.executable, "-c", STARTS], cwd=tmp_path, stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    assert parent.stdout.readline() == "ready\n"
    descendants = psutil.Process(parent.pid).children(recursive=True)
    assert len(descendants) == 1
    parent.kill()
    parent.wait()
    _, alive = psutil.wait_procs(descendants, timeout=20)
    assert not alive


def test_a_signal_during_exit_prints_no_traceback() -> None:
    """SIGTERM arrives while Python runs atexit callbacks, as the verifier of an export may receive it."""
    code = (
        "import atexit, os, signal, sys; from demorec.core.processes import exit_silently;"
        "atexit.register(lambda: os.kill(os.getpid(), signal.SIGTERM));"
        "signal.signal(signal.SIGTERM, {});"
    )
    for handler, is_printed in (("lambda number, frame: sys.exit(1)", True), ("exit_silently", False)):
        ended = subprocess.run(
            [sys.executable, "-c", code.format(handler)], capture_output=True, text=True, check=False
        )
        assert ("Traceback" in ended.stderr) == is_printed


def test_ctrl_c_in_a_destructor_ends_a_child_quietly(tmp_path: Path) -> None:
    """Python would print "Exception ignored in", and the child would go on."""
    (tmp_path / "work.py").write_text(
        "import signal\n\nclass Held:\n    def __del__(self):\n        signal.raise_signal(signal.SIGINT)\n\n"
        "def work():\n    Held()\n    print('it went on', flush=True)\n"
    )
    code = (
        "from work import work; from demorec.core.processes import SPAWN; child = SPAWN.Process(target=work);"
        "child.start(); child.join(); print(child.exitcode)"
    )
    ended = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (ended.stdout, ended.stderr) == ("130\n", "")
