"""`demorec dataset diff` on a dataset that LeRobot wrote: it names each change, and nothing else."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from support.check import change_table, edit_json, edit_parquet
from support.commands import exit_code
from support.datasets import TOP, write_with_lerobot
from support.export import export, make_run, recode

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("hf_datasets_cache")]
DATA, EPISODES = "data/chunk-000/file-000.parquet", "meta/episodes/chunk-000/file-000.parquet"
VIDEO = f"videos/{TOP}/chunk-000/file-000.mp4"
LENGTHS = (12, 13, 14, 15)
run = partial(exit_code, "dataset")


def compared(a: Path, b: Path, capsys: pytest.CaptureFixture[str]) -> list[str]:
    """Return the differences that `diff` prints, after comparing them with the exit code."""
    capsys.readouterr()
    code = run("diff", a, b)
    *found, summary = capsys.readouterr().out.splitlines()
    assert code == (1 if found else 0)
    assert summary.startswith("No difference" if not found else f"{len(found)} difference")
    return found


def info(change: Callable[[dict[str, Any]], object]) -> Callable[[Path], None]:
    return lambda root: edit_json(root / "meta/info.json", change)


def paint(root: Path) -> None:
    """Change a pixel in frame 4 of episode 1."""

    def changed(images: list[Any]) -> None:
        images[LENGTHS[0] + 4][40, 50] ^= 1

    recode(root / VIDEO, changed)


def act(root: Path) -> None:
    """Change an element of the action in frame 5 of episode 1."""

    def changed(values: list[Any]) -> list[Any]:
        values[LENGTHS[0] + 5][2] = 0.25
        return values

    edit_parquet(root / DATA, "action", changed)


def cut_last_row(root: Path) -> None:
    change_table(root, "data", lambda table: table.slice(0, len(table) - 1))
    edit_parquet(root / EPISODES, "length", lambda lengths: [*lengths[:3], 14])
    info(lambda data: data.update(total_frames=data["total_frames"] - 1))(root)


def reword(root: Path) -> None:
    """Reword one task everywhere."""
    words = {"put it here": "put it away"}
    edit_parquet(root / "meta/tasks.parquet", "task", lambda tasks: [words.get(task, task) for task in tasks])
    edit_parquet(root / EPISODES, "tasks", lambda rows: [[words.get(task, task) for task in tasks] for tasks in rows])


INJECTED: dict[str, tuple[Callable[[Path], None], str]] = {
    "robot": (info(lambda d: d.update(robot_type="so101")), "robot_type is "),
    "names": (info(lambda d: d["features"]["action"].update(names=["x", "y", "w"])),
              "the feature action has the names "),
    "feature missing": (info(lambda d: d["features"].pop("action")), "the feature action is not in "),
    "task reworded": (reword, "episodes 1, 3: the task 'put it "),
    "a frame less": (cut_last_row, "episode 3: 1"),
    "one value": (act, "episode 1: action differs in 1 of 13 frames, first in frame 5"),
    "one pixel": (paint, f"episode 1: the encoded images of {TOP} differ"),
}  # fmt: skip


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four episodes; each differs from the others."""
    root = write_with_lerobot(tmp_path_factory.mktemp("base") / "d", episodes=len(LENGTHS))
    recode(root / VIDEO)  # so that encoding it again changes no other image
    return root


@pytest.mark.parametrize("case", INJECTED)
def test_each_difference_is_named_and_nothing_else(
    case: str, base: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = Path(shutil.copytree(base, tmp_path / "changed"))
    inject, text = INJECTED[case]
    inject(root)
    for found in (compared(base, root, capsys), compared(root, base, capsys)):
        (difference,) = found
        assert difference.startswith(text)


def test_episodes_are_found_by_their_content(base: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    other = tmp_path / "other"
    assert run("reorder", base, "--order", "2,0,3,1", "--out", tmp_path / "moved") == 0
    assert run("reorder", base, "--order", "0,1,2,3", "--out", tmp_path / "copy") == 0
    assert compared(tmp_path / "copy", tmp_path / "moved", capsys) == []
    assert run("drop", tmp_path / "moved", "--episodes", 3, "--out", other) == 0
    edit_parquet(other / DATA, "action", lambda rows: [*rows[:20], [9.0, *rows[20][1:]], *rows[21:]])
    base = tmp_path / "copy"  # the former episode 0 is episode 1 in `other`, and changed
    assert compared(base, other, capsys) == ["episodes only in A: 0", "episode 1: 13 frames, 12 in B"]
    assert compared(other, base, capsys) == ["episodes only in B: 0", "episode 1: 12 frames, 13 in B"]


def test_datasets_of_demorec(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    export(make_run(tmp_path / "run", (20, 15, 17)), tmp_path / "d")
    export(make_run(tmp_path / "again", (20, 15, 17)), tmp_path / "e")
    assert compared(tmp_path / "d", tmp_path / "e", capsys) == []
    assert run("drop", tmp_path / "d", "--episodes", 1, "--out", tmp_path / "less") == 0
    assert compared(tmp_path / "d", tmp_path / "less", capsys) == ["episodes only in A: 1"]


def test_incomparable_paths_are_an_error(base: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root = Path(shutil.copytree(base, tmp_path / "d"))
    (root / VIDEO).write_bytes((root / VIDEO).read_bytes()[:900])
    for other, told in {root: "video", tmp_path / "none": "No such file or folder"}.items():
        assert run("diff", base, other) == 2
        assert told in capsys.readouterr().err
    assert run("diff", root) == 2
    assert "required" in capsys.readouterr().err
