"""An interrupted `demorec render` continues when the same command is repeated; a different command is refused."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from support.commands import exit_code
from support.export import files_of, make_run


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_run(tmp_path_factory.mktemp("render") / "run", (3, 4, 5), cameras=("front",))


def recordings(out: Path) -> dict[str, int]:
    """Name -> modification time of the recording, ns."""
    return {path.name: path.stat().st_mtime_ns for path in sorted((out / "episodes").glob("*.mcap"))}


@pytest.mark.parametrize("other", [("--looks", 2), ("--cameras", "wrist")])
def test_another_request_is_refused(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], other: tuple[object, ...]
) -> None:
    source, out = run / "episodes" / "episode_000000.mcap", tmp_path / "out"
    same = ("render", source, "--out", out, "--looks", 1)
    assert exit_code(*same) == 0
    before = files_of(out)
    capsys.readouterr()
    assert exit_code(*same, *other) == 2
    assert "exists already" in capsys.readouterr().err
    another = run / "episodes" / "episode_000001.mcap"
    assert exit_code("render", another, "--out", out / source.name, "--looks", 1) == 2
    assert files_of(out) == before
    assert exit_code(*same, *other, "--overwrite") == 0
    assert files_of(out) != before


def test_a_damaged_rendering_does_not_count_as_finished(run: Path, tmp_path: Path) -> None:
    source, target = run / "episodes" / "episode_000000.mcap", tmp_path / "new.mcap"
    command = ("render", source, "--out", target, "--looks", 1)
    assert exit_code(*command) == 0
    whole = target.read_bytes()
    middle = len(whole) // 2
    target.write_bytes(whole[:middle] + bytes([whole[middle] ^ 255]) + whole[middle + 1 :])
    assert exit_code(*command) == 2
    assert exit_code(*command, "--overwrite") == 0
    assert target.read_bytes() == whole


@pytest.mark.parametrize(
    "number", [signal.SIGINT, pytest.param(signal.SIGKILL, marks=[pytest.mark.slow, pytest.mark.long])]
)
def test_an_interrupted_command_is_quiet_and_continues(tmp_path: Path, number: signal.Signals) -> None:
    """Two workers hold semaphores, which Python might report as leaked. The last recording takes seconds."""
    run, out = make_run(tmp_path / "run", (3, 3, 40), cameras=("front",)), tmp_path / "out"
    options = ("--width", "512", "--height", "512", "--looks", "1", "--workers")
    command = [sys.executable, "-m", "demorec", "render", str(run), "--out", str(out), *options, "2"]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, start_new_session=True)
    deadline = time.monotonic() + 120
    while not list(out.glob("episodes/*.part")):
        assert process.poll() is None, "it ended before it was interrupted"
        assert time.monotonic() < deadline
        time.sleep(0.01)
    if number == signal.SIGINT:
        os.killpg(process.pid, number)  # as Ctrl-C does
    else:
        process.kill()
    _, errors = process.communicate(timeout=120)  # waits for Python's resource tracker, too
    lines = [line for line in errors.decode().splitlines() if "rendering" not in line]
    if number == signal.SIGINT:
        assert process.returncode == 130, errors.decode()
        assert len(lines) == 1
        assert "run the same command again" in lines[0]
    else:
        assert lines == []
    before = recordings(out)
    assert exit_code(*command[3:-1], 1) == 0
    assert before.items() <= recordings(out).items()
    assert not list((out / "episodes").glob("*.part"))
    assert exit_code("render", run, "--out", tmp_path / "once", *options, 1) == 0
    assert files_of(tmp_path / "once") == files_of(out)
