"""A complete run that is killed at random moments has the same data in the end."""

from __future__ import annotations

import itertools
import random
import subprocess
import sys
import time
from pathlib import Path

import pytest
from support.commands import workers_of
from support.generate import num_finished

from demorec.runs.run_file import load_run_file

pytestmark = pytest.mark.slow


def generation(out: Path, num_episodes: int, *more: str, workers: int = 2) -> list[str]:
    """Arguments of a program without LeRobot, whose verification of the dataset would take seconds."""
    entry = "import sys; sys.modules['lerobot'] = None; from demorec.cli import generate_dataset_main as main; main()"
    arguments = ["--out", str(out), "--num-episodes", str(num_episodes), "--workers", str(workers), "--no-check"]
    return [sys.executable, "-c", entry, *arguments, "--cameras", "wrist", "--width", "32", "--height", "32", *more]


def made_of(folder: Path) -> tuple[str, list[str], str]:
    """Digests of a run, of each of its recordings, and of its dataset."""
    run = load_run_file(folder)
    assert run.export is not None
    return run.digest, [attempt.sha256 for attempt in run.attempts], run.export.dataset_digest


def run_killed(out: Path, num_episodes: int, *, num_kills: int) -> None:
    """Generate, and kill driver and workers in turn, at moments spread over the run, including the start.

    Even if workers start slowly on a busy machine, between two kills of the driver there are fewer kills of workers
    than one episode survives (`MAX_LOSSES`).
    """
    chance, killed = random.Random(7), {"driver": 0, "worker": 0}
    victims = itertools.cycle(("driver", "worker", "driver", "worker", "worker"))
    process = _start(out, num_episodes)
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
            process = _start(out, num_episodes)
    _, errors = process.communicate()
    assert process.returncode == 0, errors
    assert sum(killed.values()) == num_kills, "the run ended before it was killed often enough"
    assert min(killed.values()) > 0


def _start(out: Path, num_episodes: int) -> subprocess.Popen[str]:
    return subprocess.Popen(generation(out, num_episodes), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)


@pytest.fixture(scope="module", params=[6, pytest.param(80, marks=pytest.mark.long)])
def reference(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run by one undisturbed worker."""
    out = tmp_path_factory.mktemp("reference") / "run"
    subprocess.run(generation(out, request.param, workers=1), check=True, stdout=subprocess.DEVNULL)
    return out


@pytest.mark.timeout(1800)
def test_sigkill_at_random_moments_does_not_change_the_dataset(tmp_path: Path, reference: Path) -> None:
    expected = load_run_file(reference)
    run_killed(tmp_path / "run", expected.num_episodes, num_kills=expected.num_episodes // 2)
    assert made_of(tmp_path / "run") == made_of(reference)
