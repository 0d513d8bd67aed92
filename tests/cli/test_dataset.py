"""`demorec dataset` as a user types it."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.commands import exit_code


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


def test_a_run_is_no_dataset_but_names_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "run.json").write_text("{}")
    for words in (("drop", "run", "--episodes", "0", "--out", "b"), ("score", "run"), ("diff", "run", "run")):
        assert exit_code("dataset", *words) == 2
        assert "found a run; demorec export makes one of it: run" in capsys.readouterr().err
    (tmp_path / "run" / "dataset" / "meta").mkdir(parents=True)
    (tmp_path / "run" / "dataset" / "meta" / "info.json").write_text("{}")
    assert exit_code("dataset", "drop", "run", "--episodes", "0", "--out", "b") == 2
    assert "found a run; its dataset is run/dataset: run" in capsys.readouterr().err
    assert exit_code("dataset", "drop", "nothing", "--episodes", "0", "--out", "b") == 2
    assert "There is no such file or folder: nothing" in capsys.readouterr().err
