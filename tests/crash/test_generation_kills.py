"""The real job killed at random moments, and on a disk that fills up: the same data in the end."""

from __future__ import annotations

import itertools
import os
import random
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from support.commands import workers_of
from support.generate import num_finished

from demorec.runs.run_file import load_run_file

pytestmark = pytest.mark.slow


def command(out: Path, num_episodes: int, *more: str, workers: int = 2) -> list[str]:
    """Of a program without LeRobot, which would verify the dataset in the end, for seconds."""
    entry = "import sys; sys.modules['lerobot'] = None; from demorec.cli import generate_dataset_main as main; main()"
    arguments = ["--out", str(out), "--num-episodes", str(num_episodes), "--workers", str(workers), "--no-check"]
    return [sys.executable, "-c", entry, *arguments, "--cameras", "wrist", "--width", "32", "--height", "32", *more]


def start(out: Path, num_episodes: int) -> subprocess.Popen[str]:
    return subprocess.Popen(command(out, num_episodes), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)


@pytest.fixture(scope="module", params=[6, pytest.param(80, marks=pytest.mark.long)])
def reference(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Made by one worker without any trouble."""
    out = tmp_path_factory.mktemp("reference") / "run"
    subprocess.run(command(out, request.param, workers=1), check=True, stdout=subprocess.DEVNULL)
    return out


@pytest.mark.timeout(1800)
def test_sigkill_at_random_moments_does_not_change_the_dataset(tmp_path: Path, reference: Path) -> None:
    """Driver and workers in turn, at moments spread over the run, the start of a driver included.

    However slowly workers start on a busy machine, between two kills of the driver there are fewer kills of workers
    than one episode survives (`MAX_LOSSES`).
    """
    expected = load_run_file(reference)
    num_kills = expected.num_episodes // 2
    chance, out, killed = random.Random(7), tmp_path / "run", {"driver": 0, "worker": 0}
    victims = itertools.cycle(("driver", "worker", "driver", "worker", "worker"))
    process = start(out, expected.num_episodes)
    while sum(killed.values()) < num_kills:
        enough = num_finished(out) + chance.choice((0, 0, 1, 2))
        while num_finished(out) < enough and process.poll() is None:
            time.sleep(0.01)
        time.sleep(chance.random() * 0.4)
        victim, workers = next(victims), workers_of(process)
        while victim == "worker" and not workers and process.poll() is None:
            time.sleep(0.01)
            workers = workers_of(process)
        if process.poll() is not None:
            break
        killed[victim] += 1
        if victim == "worker":
            chance.choice(workers).kill()
        else:
            process.kill()
            process.communicate()
            process = start(out, expected.num_episodes)
    _, errors = process.communicate()
    assert process.returncode == 0, errors
    assert sum(killed.values()) == num_kills, "the run ended before it was killed often enough"
    assert min(killed.values()) > 0
    run = load_run_file(out)
    assert run.digest == expected.digest
    assert [a.sha256 for a in run.attempts] == [a.sha256 for a in expected.attempts]
    assert run.export is not None
    assert expected.export is not None
    assert run.export.dataset_digest == expected.export.dataset_digest


@pytest.fixture
def small_disk(tmp_path: Path, reference: Path) -> Iterator[Path]:
    """A file system that has room for about half of the recordings."""
    folder = tmp_path / "disk"
    folder.mkdir()
    num_bytes = sum(attempt.num_bytes for attempt in load_run_file(reference).attempts)
    mount = ["mount", "-t", "tmpfs", "-o", f"size={num_bytes // 2}", "tmpfs", str(folder)]
    if os.getuid() != 0 or subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("a small file system cannot be mounted here")
    yield folder
    subprocess.run(["umount", str(folder)], check=True)


def test_a_full_disk_is_told_and_nothing_finished_is_lost(small_disk: Path, reference: Path) -> None:
    out, num_episodes = small_disk / "run", load_run_file(reference).num_episodes
    done = subprocess.run(command(out, num_episodes, "--no-export"), capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "the disk is full" in done.stderr
    assert "Traceback" not in done.stderr
    finished = sorted((out / "episodes").glob("*.mcap"))
    assert 0 < len(finished) < num_episodes
    for path in finished:
        assert path.read_bytes() == (reference / "episodes" / path.name).read_bytes()
