"""A target that no file or folder can take is a wrong request: exit code 2 and one sentence, whatever the command."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.check import simulate
from support.commands import exit_code, words_of
from support.export import export

CALLS = {
    "generate": "generate --num-episodes 1 --cameras none --out NEW",
    "generate again": "generate --config RECORDING --out NEW",
    "export lerobot": "export lerobot RECORDING --out NEW --no-verify",
    "export hdf5": "export hdf5 RECORDING --out NEW.hdf5",
    "import": "import lerobot DATASET --out NEW",
    "dataset": "dataset select DATASET --episodes 0 --out NEW",
    "report": "report RECORDING --no-checks --out NEW.html",
    "view": "view RECORDING --save NEW.rrd",
    "replay": "replay RECORDING --out NEW",
    "render": "render RECORDING --out NEW --cameras front --workers 1",
    "render to a file": "render RECORDING --out NEW.mcap --cameras front --workers 1",
    "recover": "recover RECORDING --out NEW.mcap",
}
"""What makes each command write something whose name begins with NEW."""


@pytest.fixture(scope="module")
def sources(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("sources")
    recording = simulate(folder / "e.mcap", fps=10, max_episode_seconds=1.0)
    export([recording], folder / "dataset", include_failures=True)
    return {"RECORDING": recording, "DATASET": folder / "dataset"}


@pytest.mark.parametrize("place", ["below a file", "in /proc"])
@pytest.mark.parametrize("name", CALLS)
def test_an_unwritable_target_is_exit_code_2(
    name: str, place: str, sources: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("mine")
    new = tmp_path / "file" / "x" if place == "below a file" else Path("/proc/x")
    call = CALLS[name]
    for word, path in sources.items():
        call = call.replace(word, str(path))
    assert exit_code(*words_of(call, "", new)) == 2
    said = [line for line in capsys.readouterr().err.splitlines() if line.startswith("demorec ")]
    assert len(said) == 1, said
    assert str(new.parent) in said[0]
    assert (tmp_path / "file").read_text() == "mine"
