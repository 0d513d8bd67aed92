"""Every option of every command, given a value that it cannot take: exit code 2, before anything is read or written.

The options are found by their types, so new commands are tested without a change here.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

import pytest
from support.commands import exit_code
from support.options import OPTIONS, TARGETS, Option, parts_of

READ_PATHS = {"a", "b", "bags", "calibration", "compare", "config", "dataset", "datasets", "file", "mapping", "path",
              "paths", "policy", "scores", "sources", "urdf"}  # fmt: skip
"""Paths that are read; every other path names a new file."""
WITHOUT_REASON = re.compile("Could not (find valid parse for|parse) arguments")
"""tyro's message for an option with several values."""


def words_with(option: Option, value: list[str]) -> list[str]:
    """Return a command line with a value for this option and for every required argument."""
    words = list(option.command)
    for other in OPTIONS:
        if other == option:
            words += value if option.is_positional else []
        elif other.is_required and other.command in (option.command, option.command[:1]):
            words += _example(other, is_named=other.name == "format" and len(option.command) > 1)
    return words if option.is_positional else [*words, f"--{option.name.replace('_', '-')}", *value]


def _example(option: Option, *, is_named: bool) -> list[str]:
    """Return a valid value for the option, or nothing if the command's own words already are one."""
    if option.name == "format":
        return [] if is_named else ["lerobot"]
    literals = [get_args(kind)[0] for kind in parts_of(option.type) if get_origin(kind) is Literal]
    return [*([] if option.is_positional else [f"--{option.name}"]), literals[0] if literals else "new.html"]


def once(options: list[Option]) -> list[Any]:
    """Keep one option of each name and type, from the command that has the fewest."""
    counts = {option.command: sum(other.command == option.command for other in OPTIONS) for option in OPTIONS}
    chosen: dict[tuple[str, str], Option] = {}
    for option in sorted(options, key=lambda option: counts[option.command]):
        chosen.setdefault((option.name, str(option.type)), option)
    return [pytest.param(option, id=f"{' '.join(option.command)} {option.name}") for option in chosen.values()]


def refusal(option: Option, value: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """Return the command's message about a value that it refuses."""
    assert exit_code(*words_with(option, value)) == 2
    told = capsys.readouterr()
    assert told.out == ""
    return " ".join(word for word in told.err.split() if word.strip("│╭╮╰╯─"))


@pytest.mark.parametrize("option", once([option for option in OPTIONS if option.takes(float)]))
def test_numbers_are_finite(option: Option, capsys: pytest.CaptureFixture[str]) -> None:
    value = ["0", "nan"] if option.is_pair else ["nan"]
    assert "nan is not a finite number" in refusal(option, value, capsys)


@pytest.mark.parametrize("option", once([option for option in OPTIONS if option.takes(int)]))
def test_whole_numbers_have_64_bits(option: Option, capsys: pytest.CaptureFixture[str]) -> None:
    value = ["0", str(10**30)] if option.is_pair else [str(10**30)]
    told = refusal(option, value, capsys)
    assert "is not a whole number of 64 bits" in told or WITHOUT_REASON.search(told)


@pytest.mark.parametrize("option", once([option for option in OPTIONS if option.takes(str)]))
@pytest.mark.parametrize("text", ["a\nb", "a\0b", "a\udcff"], ids=["line end", "zero byte", "not UTF-8"])
def test_texts_are_lines(option: Option, text: str, capsys: pytest.CaptureFixture[str]) -> None:
    told = refusal(option, [text], capsys)
    assert "is not one line of text" in told or WITHOUT_REASON.search(told)
    assert repr(text)[1:-1].replace("\\n", "") in told.replace("\\\\", "\\").replace("\\n", "")


def test_every_path_is_read_or_a_target() -> None:
    paths = {option.name for option in OPTIONS if option.takes(Path)}
    assert paths - READ_PATHS == {option.name for option in TARGETS} == {"out", "save"}


@pytest.mark.parametrize("option", [pytest.param(o, id=f"{' '.join(o.command)} {o.name}") for o in TARGETS])
def test_targets_that_cannot_be_made(
    option: Option, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("file").write_text("years of work")
    Path("link").symlink_to("nothing")
    reasons = {
        "": "One of the paths is empty",
        "link": "is a link whose target is missing",
        "x" * 300: "File name too long",
        "file/below": "Not a directory",
        "bytes\udcff": "has bytes that are not UTF-8",
    }
    for target, reason in reasons.items():
        assert reason in refusal(option, [target], capsys)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "link"]
    assert Path("file").read_text() == "years of work"
