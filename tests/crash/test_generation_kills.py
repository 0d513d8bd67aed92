"""A complete run that is killed at random moments has the same data in the end."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest
from support.kills import generation, made_of, run_killed

from demorec.runs.run_file import load_run_file

pytestmark = pytest.mark.slow


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
