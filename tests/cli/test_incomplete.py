"""Commands report incomplete and contradicting data, and a source that disappears while they read it."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from support.check import verdict_of
from support.crash import run_command
from support.crash_rows import without_lerobot
from support.export import export, make_run
from support.mcap import rewritten

from demorec.core.limited import VARIABLE

NUM_EPISODES = 3
pytestmark = pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_run(tmp_path_factory.mktemp("incomplete") / "run", [8] * NUM_EPISODES, cameras=("front",))


@pytest.fixture
def dataset(run: Path, tmp_path: Path) -> Path:
    export(run, tmp_path / "dataset")
    return tmp_path / "dataset"


@pytest.fixture
def in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """The command does not fork once more."""
    monkeypatch.setenv(VARIABLE, "off")


@pytest.mark.slow
@pytest.mark.usefixtures("in_this_process")
@pytest.mark.parametrize("form", ["lerobot", "hdf5"])
def test_recordings_that_disappear_during_an_export_are_one_sentence(form: str, run: Path, tmp_path: Path) -> None:
    words = ["export", form, "source", "--out", "new"] + ["--no-verify"] * (form == "lerobot")
    shutil.copytree(run, tmp_path / "source")
    whole = run_command(words, tmp_path, program=without_lerobot)
    assert whole.code == 0
    shutil.rmtree(tmp_path / "new") if form == "lerobot" else (tmp_path / "new").unlink()

    def remove(number: int) -> None:
        if number == 0:
            shutil.rmtree(tmp_path / "source/episodes")

    ended = run_command(words, tmp_path, program=without_lerobot, at=2, act=remove)
    assert ended.code == 1
    assert len(ended.said) == 1
    assert "episode_00000" in ended.said[0]
    assert "unexpected" not in ended.said[0]
    assert [path.name for path in tmp_path.iterdir()] == ["source"]


def test_a_count_in_the_index_of_a_recording_must_be_true(run: Path, tmp_path: Path) -> None:
    source = run / "episodes/episode_000000.mcap"
    (tmp_path / "same.mcap").write_bytes(rewritten(source))
    (tmp_path / "other.mcap").write_bytes(rewritten(source, counts=lambda topic, count: 2**63 - 1))
    assert verdict_of(tmp_path / "same.mcap", "checksums") == "good"
    assert verdict_of(tmp_path / "other.mcap", "checksums") == "broken"
