"""Every command's help: what it says of defaults, and that it fits the terminal."""

from __future__ import annotations

import re
import unicodedata

import pytest

from demorec.cli import COMMANDS, generate_dataset_main, main
from demorec.core.tables import EXPORTERS

PROGRAMS = (
    "demorec",
    "generate-dataset",
    *(f"demorec {name}" for name in COMMANDS.names() if name != "generate"),
    *(f"demorec export {name}" for name in EXPORTERS.names()),
)


def help_of(program: str, width: int, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> list[str]:
    monkeypatch.setenv("COLUMNS", str(width))
    start, *command = program.split()
    with pytest.raises(SystemExit) as ended:
        (main if start == "demorec" else generate_dataset_main)([*command, "--help"])
    assert ended.value.code == 0
    return capsys.readouterr().out.splitlines()


def words(lines: list[str]) -> list[str]:
    """Of the text, without the boxes around it; a list such as {a,b,c} may be broken behind its commas."""
    return re.sub(r",(?=\S)", ", ", " ".join(line.strip("│ ") for line in lines)).split()


@pytest.mark.parametrize("width", [60, 80, 120])
@pytest.mark.parametrize("program", PROGRAMS)
def test_lines_fit_the_terminal(
    program: str, width: int, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    lines = help_of(program, width, capsys, monkeypatch)
    assert len(lines) > 8
    examples = [line for line in lines if line.startswith("  ") and program != "demorec"]
    assert max((len(line) for line in examples), default=0) <= 80
    assert max(len(line) for line in lines if line not in examples) <= width
    assert not any(unicodedata.category(char).startswith("C") for line in lines for char in line)


@pytest.mark.parametrize("program", PROGRAMS)
def test_no_word_is_cut(program: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever the width, the same words: in lines of 1000 columns nothing has to be broken."""
    known = set(words(help_of(program, 1000, capsys, monkeypatch)))
    found = words(help_of(program, 80, capsys, monkeypatch))
    assert [word for word in found if word not in known and not set(word) <= set("╭╮╰╯─")] == []


@pytest.mark.parametrize("program", PROGRAMS[1:])
def test_a_default_is_told_only_where_it_is_a_value(
    program: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    text = " ".join(words(help_of(program, 1000, capsys, monkeypatch)))
    told = re.findall(r"\(default:([^)]*)\)", text)
    assert told
    assert not {value.strip() for value in told} & {"", "''", "auto", "None"}
    assert "{None" not in text


@pytest.mark.parametrize("program", PROGRAMS[1:])
def test_every_flag_is_described(
    program: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = [line.strip("│ ") for line in help_of(program, 1000, capsys, monkeypatch) if line.startswith("│ ")]
    flags = [number for number, row in enumerate(rows) if row.startswith("-")]
    assert len(flags) > 1
    for number in flags:
        below = next(iter(rows[number + 1 :]), "-")
        assert "  " in rows[number] or not below.startswith("-"), rows[number]


def test_required_flags_say_so(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    lines = help_of("demorec export", 80, capsys, monkeypatch)
    assert any(line.startswith("│ --out PATH") and "(required)" in line for line in lines)
    text = " ".join(" ".join(lines).replace("│", " ").split())
    assert (
        "Runs, recordings, LeRobot datasets, HDF5 files, bags, or folders of recordings or of bags. (required)" in text
    )


@pytest.mark.parametrize("program", ["demorec export", *(f"demorec export {name}" for name in EXPORTERS.names())])
def test_the_usage_of_an_export_has_the_format(
    program: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert help_of(program, 120, capsys, monkeypatch)[0].endswith("FORMAT [[PATH [PATH ...]]]")


def test_an_empty_hint_leaves_no_empty_row(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    for width in range(70, 90):
        assert not [line for line in help_of("demorec view", width, capsys, monkeypatch) if re.fullmatch(r"│ +│", line)]
