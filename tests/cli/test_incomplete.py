"""Commands report incomplete and contradicting data, and a source that disappears while they read it."""

from __future__ import annotations

import os
import shutil
import signal
from pathlib import Path

import pytest
from support.check import edit_column, verdict_of
from support.commands import exit_code
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
def test_an_interrupted_import_is_not_a_complete_run(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["import", "lerobot", str(dataset), "--out", "new"]
    first = tmp_path / "new/episodes/episode_000000.mcap"

    def kill_after_the_first(number: int) -> None:
        if first.exists():
            os.kill(os.getpid(), signal.SIGKILL)

    assert run_command(words, tmp_path, at=1, act=kill_after_the_first).code == -signal.SIGKILL
    assert len(list(first.parent.glob("*.mcap"))) < NUM_EPISODES
    new = tmp_path / "new"
    for command in (["info", new], ["check", new], ["export", "hdf5", new, "--out", tmp_path / "new.hdf5"]):
        exit_code(*command)
        told = "".join(capsys.readouterr())
        assert "not imported yet; the command that began it continues it" in told, command
    assert verdict_of(new, "run_complete", "run") == "look"
    assert run_command(words, tmp_path).code == 0
    assert exit_code("info", new) == 0
    assert "not imported yet" not in capsys.readouterr().out


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


def test_an_index_of_rows_must_count_up(dataset: Path) -> None:
    edit_column(dataset, "index", lambda index: [*index[:5], 2**63 - 1, *index[6:]])
    assert verdict_of(dataset, "contradicting_counts", "dataset") == "broken"


def test_a_negative_seed_is_one_sentence(dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_code("dataset", "shuffle", dataset, "--seed=-1", "--out", tmp_path / "new") == 2
    assert "--seed is -1, allowed are 0 to 9,223,372,036,854,775,807" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()
