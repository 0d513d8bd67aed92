"""`demorec dataset` as a user types it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from support.commands import exit_code
from support.foreign_dataset import write_foreign


@pytest.mark.parametrize(
    ("words", "flag"),
    [
        (("select", "a", "--head", "3", "--out", "b"), "--head means nothing to select: it is for trim."),
        (("diff", "a", "b", "--out", "c"), "--out means nothing to diff"),
        (("merge", "a", "b", "--json", "--out", "c"), "--json means nothing to merge: it is for diff, score."),
        (("trim", "a", "--idle", "--where", "success", "--out", "b"), "--where means nothing to trim"),
    ],
)
def test_a_flag_of_another_command_is_refused(
    words: tuple[str, ...], flag: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert exit_code("dataset", *words) == 2
    assert flag in capsys.readouterr().err


def test_a_run_stands_for_its_dataset(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = tmp_path / "run"
    run.mkdir()
    (run / "run.json").write_text("{}")
    assert exit_code("dataset", "score", run) == 2
    assert "This run has no dataset in dataset/" in capsys.readouterr().err
    write_foreign(run / "dataset", episodes=3)
    assert exit_code("dataset", "score", run, "--no-images", "--workers", "1", "--json") == 0
    assert len(json.loads(capsys.readouterr().out)["episodes"]) == 3
    assert exit_code("dataset", "select", run, "--episodes", "1", "--out", tmp_path / "one") == 0
    assert "1 episode, 8 frames" in capsys.readouterr().out
    assert exit_code("dataset", "drop", run, "--episodes", "0,", "2", "--out", tmp_path / "rest") == 0
    assert "1 episode, 8 frames" in capsys.readouterr().out
    assert exit_code("dataset", "drop", run, "--episodes", "2:2", "--out", tmp_path / "none") == 2
    assert "Episodes are numbers and ranges, such as 0,3,5:9, not '2:2'" in capsys.readouterr().err
    assert exit_code("dataset", "select", run / "run.json", "--episodes", "1", "--out", tmp_path / "two") == 2
    assert "The file is no recording" in capsys.readouterr().err
