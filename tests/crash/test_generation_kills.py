"""The real job killed at random moments, and on a disk that fills up: the same data in the end."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from support.kills import generation, made_of, run_killed

from demorec.runs.run_file import load_run_file

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module", params=[6, pytest.param(80, marks=pytest.mark.long)])
def reference(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Made by one worker without any trouble."""
    out = tmp_path_factory.mktemp("reference") / "run"
    subprocess.run(generation(out, request.param, workers=1), check=True, stdout=subprocess.DEVNULL)
    return out


@pytest.mark.timeout(1800)
def test_sigkill_at_random_moments_does_not_change_the_dataset(tmp_path: Path, reference: Path) -> None:
    expected = load_run_file(reference)
    run_killed(tmp_path / "run", expected.num_episodes, num_kills=expected.num_episodes // 2)
    assert made_of(tmp_path / "run") == made_of(reference)


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
    done = subprocess.run(generation(out, num_episodes, "--no-export"), capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "the disk is full" in done.stderr
    assert "Traceback" not in done.stderr
    finished = sorted((out / "episodes").glob("*.mcap"))
    assert 0 < len(finished) < num_episodes
    for path in finished:
        assert path.read_bytes() == (reference / "episodes" / path.name).read_bytes()
