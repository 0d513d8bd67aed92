"""Commands with several processes, killed with SIGKILL: no descendant survives, and no success is reported."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest
from support import bag_mappings, bags
from support.commands import workers_of
from support.export import make_run

pytestmark = pytest.mark.slow

COMMANDS = ["export", "import"]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run and, next to it, bags to be imported."""
    run = make_run(tmp_path_factory.mktemp("orphans") / "run", [30] * 12)
    bag_mappings.write_mapping(bag_mappings.SO101, run.with_name("robot.toml"))
    run.with_name("bags").mkdir()
    for number in range(8):
        bags.write_mcap(bags.in_order(bags.so101(1.6)), run.with_name("bags") / f"{number}.mcap")
    return run


def command(run: Path, out: Path, name: str) -> list[str]:
    arguments = {
        "export": ["export", "lerobot", run, "--out", out / "d"],
        "import": ["import", run.with_name("bags"), "--mapping", run.with_name("robot.toml"), "--out", out / "i"],
    }[name]
    return [sys.executable, "-c", "from demorec.cli import main; main()", *map(str, arguments), "--workers", "2"]


def busy(run: Path, out: Path, name: str) -> subprocess.Popen[str]:
    """Start the command and return once two of its workers run."""
    process = subprocess.Popen(
        command(run, out, name), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, env={**os.environ}
    )
    deadline = time.monotonic() + 120
    while len(workers_of(process)) < 2:
        assert process.poll() is None, "it ended before it could be killed"
        assert time.monotonic() < deadline
        time.sleep(0.01)
    return process


@pytest.mark.parametrize("name", COMMANDS)
def test_a_killed_command_leaves_no_orphans(run: Path, tmp_path: Path, name: str) -> None:
    """The command is killed once two workers run: they are starting, working or waiting for work."""
    process = busy(run, tmp_path, name)
    descendants = psutil.Process(process.pid).children(recursive=True)
    process.kill()
    process.wait()
    _, alive = psutil.wait_procs(descendants, timeout=60)
    assert not alive


@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_with_a_killed_worker_fails(run: Path, tmp_path: Path, name: str) -> None:
    process = busy(run, tmp_path, name)
    workers_of(process)[0].kill()
    _, errors = process.communicate(timeout=240)
    assert process.returncode == 1
    assert "for lack of memory" in errors
    assert "please report" not in errors
