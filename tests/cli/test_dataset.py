"""`demorec dataset` from the command line."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.check import edit_json
from support.commands import exit_code
from support.export import files_of
from support.foreign_dataset import write_foreign


@pytest.mark.parametrize(
    ("words", "flag"),
    [
        (("select", "a", "--head", "3", "--out", "b"), "--head"),
        (("diff", "a", "b", "--out", "c"), "--out"),
        (("merge", "a", "b", "--json", "--out", "c"), "--json"),
        (("trim", "a", "--idle", "--where", "success", "--out", "b"), "--where"),
    ],
)
def test_a_flag_of_another_command_is_refused(
    words: tuple[str, ...], flag: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert exit_code("dataset", *words) == 2
    assert flag in capsys.readouterr().err


def test_commands_are_listed_and_a_wrong_one_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_code("dataset", "--help") == 0
    assert "drop-features" in capsys.readouterr().out
    assert exit_code("dataset") == 2
    assert "drop-features" in capsys.readouterr().out
    assert exit_code("dataset", "trmi", "a") == 2
    assert "Unknown command 'trmi'. Did you mean 'trim'?" in capsys.readouterr().err


def test_a_run_stands_for_its_dataset(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = tmp_path / "run"
    run.mkdir()
    (run / "run.json").write_text("{}")
    assert exit_code("dataset", "select", run, "--where", "score > 0", "--out", tmp_path / "none") == 2
    assert "This run has no dataset in dataset/" in capsys.readouterr().err
    write_foreign(run / "dataset", episodes=3)
    assert exit_code("dataset", "select", run, "--episodes", "1", "--out", tmp_path / "one") == 0
    assert "1 of 3 episodes, 8 of 24 frames" in capsys.readouterr().out
    assert exit_code("dataset", "drop", run, "--episodes", "0,", "2", "--out", tmp_path / "rest") == 0
    assert "1 of 3 episodes, 8 of 24 frames" in capsys.readouterr().out
    assert exit_code("dataset", "drop", run, "--episodes", "2:2", "--out", tmp_path / "none") == 2
    assert "is '2:2', but 2:2 ends before it begins" in capsys.readouterr().err
    assert exit_code("dataset", "select", run / "run.json", "--episodes", "1", "--out", tmp_path / "two") == 2
    assert "The file is not a recording" in capsys.readouterr().err


@pytest.fixture
def cups(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Write a dataset `cups` of 5 episodes into the current folder."""
    monkeypatch.chdir(tmp_path)
    return write_foreign(tmp_path / "cups", episodes=5)


def test_parts_are_written_neither_into_the_source_nor_over_existing_files(
    cups: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = files_of(cups)
    words = ("dataset", "split", "cups", "--shares", "a=0.6,b=0.4", "--out")
    assert exit_code(*words, "cups") == 2
    assert "A new file inside a dataset would prevent" in capsys.readouterr().err
    write_foreign(cups.parent / "parts" / "b")
    assert exit_code(*words, "parts") == 2
    assert "choose --overwrite or another --out" in capsys.readouterr().err
    assert not (cups.parent / "parts" / "a").exists()
    assert files_of(cups) == before
    assert exit_code(*words, "parts", "--overwrite") == 0
    printed = capsys.readouterr().out
    assert "3 of 5 episodes, 24 of 40 frames: parts/a" in printed
    assert "2 of 5 episodes, 16 of 40 frames: parts/b" in printed
    assert exit_code("dataset", "select", "parts", "--episodes", "0", "--out", "x") == 2
    assert "it holds datasets: name one (a, b): parts" in capsys.readouterr().err


def test_a_dry_run_refuses_what_the_run_would(cups: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ("dataset", "select", "cups", "--episodes", "0", "--dry-run")
    assert exit_code(*words) == 0  # no --out
    assert capsys.readouterr().out == "episodes 0\nWould be 1 of 5 episodes, 8 of 40 frames\n"
    assert exit_code("dataset", "drop", "cups", "--episodes", "1", "--dry-run") == 0
    assert capsys.readouterr().out.startswith("episodes 0,2,3,4\n")
    assert exit_code(*words, "--out", "cups", "--overwrite") == 2
    assert "This is never replaced, since it is an input of this command" in capsys.readouterr().err
    assert exit_code(*words[:-1]) == 2
    assert "--dry-run" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("select", "--where", "success"), "Allowed: episode_index, num_frames, "),
        (("select", "--where", "num_frames = 8"), "compare by == "),
        (("select", "--where", 'task == "push it" or "pull it"'), "'pull it' alone is not one"),
        (("select", "more", "--episodes", "1"), "more"),
        (("trim", "--head", "5", "--tail", "3"), "drop them first: 0,1,2,3,4"),
        (("split",), "--shares train=0.8 val=0.2."),
        (("split", "--shares", "a=0.8", "b=0.3"), "whose sum is 1, not 1.1"),
        (("rename", "actoin=act"), "Did you mean 'action'?"),
        (("shuffle", "--seed=-1"), "--seed is -1, allowed are 0 to"),
        (("drop-features",), "Name the features to leave out"),
        (("set-task",), "--task 'pick up the cup'"),
        (("set-task", "--task", "pull it", "--where", "num_frames > 8"), "No episode is selected"),
    ],
)
def test_mistakes_are_named_with_a_remedy(
    cups: Path, capsys: pytest.CaptureFixture[str], words: tuple[str, ...], told: str
) -> None:
    assert exit_code("dataset", words[0], "cups", *words[1:], "--out", "new") == 2
    assert told in capsys.readouterr().err
    assert not (cups.parent / "new").exists()


def test_a_column_that_differs_from_info_json_ends_an_edit(cups: Path, capsys: pytest.CaptureFixture[str]) -> None:
    edit_json(cups / "meta/info.json", lambda info: info["features"]["action"].update(shape=[2]))
    assert exit_code("dataset", "shuffle", "cups", "--out", "new") == 1
    assert "The column action of the new episode 0 does not match meta/info.json" in capsys.readouterr().err
    assert not (cups.parent / "new").exists()


def test_a_quoted_tilde_is_the_home_folder(
    cups: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("HOME", str(cups.parent))
    assert exit_code("dataset", "select", "~/cups", "--episodes", "0", "--out=~/new") == 0
    assert (cups.parent / "new/meta/info.json").is_file()
    assert not Path("~").exists()
