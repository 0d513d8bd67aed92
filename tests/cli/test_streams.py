"""Standard streams that are closed, or whose reader has exited: commands stay silent and keep their exit code."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest

SAMPLE = next((Path(__file__).parents[2] / "recordings" / "sample").glob("*.mcap"))


class Ended(NamedTuple):
    code: int
    out: str
    err: str


def shell(words: str, redirections: str) -> Ended:
    """Run a command in a shell and return its result."""
    command = f'set -o pipefail; "{sys.executable}" -m demorec {words} {redirections}'
    ended = subprocess.run(["bash", "-c", command], capture_output=True, text=True, timeout=300, check=False)
    return Ended(ended.returncode, ended.stdout, ended.stderr)


CLOSED = {"<&- >&-": ("out",), "2>&-": ("err",), "<&- >&- 2>&-": ("out", "err")}
"""Redirections -> streams that are then lost."""


@pytest.mark.slow
@pytest.mark.parametrize(("words", "code"), [(f"info {SAMPLE}", 0), ("info nowhere", 2)], ids=["done", "refused"])
def test_closed_streams_change_nothing_else(words: str, code: int) -> None:
    heard = shell(words, "")
    assert heard.code == code
    assert bool(heard.out) == (code == 0)
    assert bool(heard.err) == (code != 0)
    for redirections, unheard in CLOSED.items():
        out = "" if "out" in unheard else heard.out
        err = "" if "err" in unheard else heard.err
        assert shell(words, redirections) == Ended(code, out, err), redirections


@pytest.mark.slow
@pytest.mark.parametrize("words", ["list --help", f"info {SAMPLE}"])
def test_a_reader_that_has_exited_is_a_silent_exit_code_1(words: str) -> None:
    assert shell(words, "| true") == Ended(1, "", "")


def test_a_file_does_not_reuse_the_number_of_a_closed_stream(tmp_path: Path) -> None:
    """Text that a library prints to a closed stream must not end up in the file that reuses its number."""
    code = (
        "from demorec.core.streams import open_closed_streams; open_closed_streams(); import os;"
        f"file = os.open({str(tmp_path / 'mine')!r}, os.O_WRONLY | os.O_CREAT); os.system('echo a word');"
        "os.write(file, str(file).encode())"
    )
    subprocess.run(["bash", "-c", f'"{sys.executable}" -c "{code}" <&- >&- 2>&-'], timeout=300, check=True)
    assert int((tmp_path / "mine").read_text()) > 2
