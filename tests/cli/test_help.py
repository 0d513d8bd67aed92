"""Help of every command: the defaults it lists, and that it fits the terminal."""

from __future__ import annotations

import re
import unicodedata

import pytest

from demorec.cli import COMMANDS, generate_dataset_main, main
from demorec.core.tables import EXPORTERS
from demorec.extensions.datasets.command import DatasetCommand

PROGRAMS = (
    "demorec",
    "generate-dataset",
    *(f"demorec {name}" for name in COMMANDS.names() if name not in ("generate", "dataset")),
    *(f"demorec export {name}" for name in EXPORTERS.names()),
    *(f"demorec dataset {name}" for name in DatasetCommand.commands.names()),
)

GROUPS = ("demorec", "demorec dataset")
"""Programs whose help lists commands."""


def help_of(
    program: str,
    width: int,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    flag: str = "--help",
) -> list[str]:
    monkeypatch.setenv("COLUMNS", str(width))
    start, *command = program.split()
    with pytest.raises(SystemExit) as ended:
        (main if start == "demorec" else generate_dataset_main)([*command, flag])
    assert ended.value.code == 0
    return capsys.readouterr().out.splitlines()


@pytest.mark.parametrize("width", [60, 100])
@pytest.mark.parametrize("program", [*PROGRAMS, *GROUPS[1:]])
def test_lines_fit_the_terminal(
    program: str, width: int, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    lines = help_of(program, width, capsys, monkeypatch)
    assert len(lines) > 8
    examples = [line for line in lines if line.startswith("  ") and program not in GROUPS]
    assert max((len(line) for line in examples), default=0) <= 80
    assert max(len(line) for line in lines if line not in examples) <= width
    assert not any(unicodedata.category(char).startswith("C") for line in lines for char in line)


@pytest.mark.parametrize("program", PROGRAMS[1:])
def test_help_fits_a_page_and_the_rest_is_under_help_all(
    program: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    lines = help_of(program, 80, capsys, monkeypatch)
    assert len(lines) <= 80
    everything = help_of(program, 80, capsys, monkeypatch, "--help-all")
    flags, all_flags = (
        {found[1] for line in page if (found := re.match(r"│ (--[a-z0-9-]+)(?=[ ,])", line))}
        for page in (lines, everything)
    )
    assert flags <= all_flags
    hidden = [line for line in lines if line.endswith("more options.")]
    command = re.sub(r"(?<=demorec export) .*", "", program)
    assert hidden == [f"{command} --help-all shows {len(all_flags - flags)} more options."] * (flags != all_flags)


def test_hidden_options_are_accepted(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        generate_dataset_main(["--gop", "601", "--no-check"])
    assert ended.value.code == 2
    assert "--gop is 601" in capsys.readouterr().err


@pytest.mark.parametrize("program", PROGRAMS[1:])
def test_every_flag_is_described(
    program: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    lines = help_of(program, 1000, capsys, monkeypatch, "--help-all")
    rows = [line.strip("│ ") for line in lines if line.startswith("│ ")]
    flags = [number for number, row in enumerate(rows) if row.startswith("-")]
    assert flags
    for number in flags:
        below = next(iter(rows[number + 1 :]), "-")
        assert "  " in rows[number] or not below.startswith("-"), rows[number]
