"""Targets that cannot be written: every command prints one sentence, and the exit code is that of docs/README.md."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.check import simulate
from support.commands import exit_code, words_of
from support.export import export

CALLS = {
    "generate": "generate --num-episodes 1 --cameras none --out NEW",
    "generate again": "generate --config RECORDING --out NEW",
    "export lerobot": "export lerobot RECORDING --out NEW --no-verify --include-failures",
    "export hdf5": "export hdf5 RECORDING --out NEW.hdf5 --include-failures",
    "import": "import lerobot DATASET --out NEW",
    "dataset": "dataset select DATASET --episodes 0 --out NEW",
    "dataset split": "dataset split DATASET --shares a=0.5 b=0.5 --out NEW",
    "report": "report RECORDING --no-checks --out NEW.html",
    "view": "view RECORDING --save NEW.rrd",
    "replay": "replay RECORDING --out NEW",
    "render": "render RECORDING --out NEW --cameras front --workers 1",
    "render to a file": "render RECORDING --out NEW.mcap --cameras front --workers 1",
    "recover": "recover RECORDING --out NEW.mcap",
}
"""Calls that make each command write a file whose name begins with NEW."""


@pytest.fixture(scope="module")
def sources(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("sources")
    recording = simulate(folder / "e.mcap", fps=10, max_episode_seconds=1.0)
    export([recording], folder / "one", include_failures=True)
    both = [folder / "one", folder / "one"]
    assert exit_code("dataset", "merge", *both, "--out", folder / "dataset") == 0
    return {"RECORDING": recording, "DATASET": folder / "dataset"}


def call(name: str, sources: dict[str, Path], new: Path) -> list[str]:
    """Return the arguments of a call that writes `new`, or names that begin with it."""
    words = CALLS[name]
    for word, path in sources.items():
        words = words.replace(word, str(path))
    return words_of(words, "", new)


def said(capsys: pytest.CaptureFixture[str]) -> str:
    """Return the error message, which must be one sentence."""
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("demorec ")]
    assert len(lines) == 1, lines
    return lines[0]


PLACES = {"in /proc": Path("/proc/x"), "below a link to nothing": Path("link/x")}
"""Tests of options have names that are too long, not UTF-8 or below a file."""


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("name", CALLS)
def test_an_unwritable_target_is_exit_code_2(
    name: str, place: str, sources: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "link").symlink_to("nothing")
    new = tmp_path / PLACES[place]
    assert exit_code(*call(name, sources, new)) == 2
    assert "/".join(new.parts[-2:])[1:] in said(capsys)
    assert [path.name for path in tmp_path.iterdir()] == ["link"]


@pytest.mark.parametrize("name", CALLS)
def test_an_existing_file_is_exit_code_2(
    name: str, sources: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = call(name, sources, tmp_path / "thesis")
    target = Path(words[words.index("--save" if name == "view" else "--out") + 1])
    target.write_text("years of work")
    assert exit_code(*words) == 2
    assert str(tmp_path) in said(capsys)
    assert target.read_text() == "years of work"
    assert list(tmp_path.iterdir()) == [target]
