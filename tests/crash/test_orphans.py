"""An export by several processes, killed with SIGKILL: no descendant survives, and no success is reported."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest
from support.commands import workers_of
from support.export import make_run

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_run(tmp_path_factory.mktemp("orphans") / "run", [30] * 12)


def busy(run: Path, out: Path) -> subprocess.Popen[str]:
    """Start the export and return once two of its workers run."""
    words = ["export", "lerobot", str(run), "--out", str(out), "--workers", "2"]
    command = [sys.executable, "-c", "from demorec.cli import main; main()", *words]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 120
    while len(workers_of(process)) < 2:
        assert process.poll() is None, "it ended before it could be killed"
        assert time.monotonic() < deadline
        time.sleep(0.01)
    return process


def test_a_killed_command_leaves_no_orphans(run: Path, tmp_path: Path) -> None:
    """The command is killed once two workers run: they are starting, working or waiting for work."""
    process = busy(run, tmp_path / "dataset")
    descendants = psutil.Process(process.pid).children(recursive=True)
    process.kill()
    process.wait()
    _, alive = psutil.wait_procs(descendants, timeout=60)
    assert not alive


def test_a_command_with_a_killed_worker_fails(run: Path, tmp_path: Path) -> None:
    process = busy(run, tmp_path / "dataset")
    workers_of(process)[0].kill()
    _, errors = process.communicate(timeout=240)
    assert process.returncode == 1
    assert "for lack of memory" in errors
    assert "please report" not in errors
