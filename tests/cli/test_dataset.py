"""`demorec dataset` as a user types it."""

from __future__ import annotations

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
