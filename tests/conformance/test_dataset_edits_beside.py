"""`demorec dataset` carries the files next to a dataset's rows along, or names those that it leaves out, with the
reason.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
from support.check import checked
from support.commands import exit_code
from support.export import export, make_run

BOXES = "demorec/boxes/observation.images.front.json"


def edit(*words: object) -> None:
    assert exit_code("dataset", *words) == 0


def table(root: Path, name: str) -> list[dict[str, Any]]:
    return [row for path in sorted((root / name).glob("*/*.parquet")) for row in pq.read_table(path).to_pylist()]


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("simulated")
    run = make_run(folder / "run", (12, 10, 11), segmentation=True)
    export(run, folder / "d", boxes=True, progress=True, language=("task_aug", "subtask"))
    return folder / "d"


def failing(root: Path) -> set[str]:
    """Return the failed dataset checks; motion and images are synthetic, so their checks do not count."""
    results = checked(root, "dataset", images=False).results
    assert {result.check: result.verdict for result in results}["dataset_sidecar"] == "good"
    return {result.check for result in results if result.verdict == "broken" and result.check.startswith("dataset")}


@pytest.mark.slow
def test_rows_follow_their_episodes_and_boxes_and_progress_are_named(
    simulated: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    edit("reorder", simulated, "--order", "2,0,1", "--out", tmp_path / "r")
    printed = capsys.readouterr().out
    assert BOXES in printed
    assert "sarm_progress.parquet" in printed
    assert "(its values hold for the episodes of the source)" in printed
    edit("select", tmp_path / "r", "--episodes", "0,2", "--out", tmp_path / "s")
    edit("trim", tmp_path / "s", "--head", 3, "--tail", 2, "--out", tmp_path / "t")
    for root in (tmp_path / "s", tmp_path / "t"):
        assert not (root / BOXES).exists()
        assert [row["run_episode_index"] for row in table(root, "demorec/episodes")] == [2, 1]
        assert failing(root) <= failing(simulated)


def test_a_new_instruction_keeps_the_scene(simulated: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    edit("set-task", simulated, "--task", "do it", "--episodes", "1", "--out", tmp_path / "d")
    assert "other wordings (task_aug) in episodes: 1 (" in capsys.readouterr().out
    old, new = table(simulated, "demorec/episodes"), table(tmp_path / "d", "demorec/episodes")
    was, now = (json.loads(rows[1]["episode_info"]) for rows in (old, new))
    assert was.pop("instruction") != now.pop("instruction") == "do it"
    assert was == now
    assert [old[n] for n in (0, 2)] == [new[n] for n in (0, 2)]
    assert failing(tmp_path / "d") <= failing(simulated)


def test_omissions_are_named_before_and_after(
    simulated: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for flags in (("--dry-run",), ()):
        edit("trim", simulated, "--head", 2, "--out", tmp_path / "d", *flags)
        told = capsys.readouterr().out
        assert "eft out: scenes of simulated episodes: 3 (" in told
        assert (tmp_path / "d").exists() == (flags == ())
