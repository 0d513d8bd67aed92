"""`demorec dataset diff` on a dataset that LeRobot wrote: it names each change, and nothing else."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from support.commands import exit_code
from support.datasets import TOP, write_with_lerobot
from support.export import export, files_of, make_run, recode

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("hf_datasets_cache")]
DATA, EPISODES = "data/chunk-000/file-000.parquet", "meta/episodes/chunk-000/file-000.parquet"
TASKS, INFO, STATS = "meta/tasks.parquet", "meta/info.json", "meta/stats.json"
TASK_COLUMN = "task"
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


def edit_json(path: str, change: Callable[[dict[str, Any]], object]) -> Callable[[Path], None]:
    def edited(root: Path) -> None:
        data = json.loads((root / path).read_text())
        change(data)
        (root / path).write_text(json.dumps(data))

    return edited


def edit_table(path: str, change: Callable[[pa.Table], pa.Table]) -> Callable[[Path], None]:
    def edited(root: Path) -> None:
        pq.write_table(change(pq.read_table(root / path)), root / path)

    return edited


def edit_column(path: str, name: str, change: Callable[[list[Any]], object]) -> Callable[[Path], None]:
    def edited(table: pa.Table) -> pa.Table:
        place, values = table.column_names.index(name), table.column(name).to_pylist()
        change(values)
        kind = table.schema.field(name)
        return table.set_column(place, kind, pa.array(values, kind.type))

    return edit_table(path, edited)


def row(episode: int, frame: int) -> int:
    return sum(LENGTHS[:episode]) + frame


def put(episode: int, frame: int, value: float, element: int) -> Callable[[list[Any]], None]:
    """Set an element of a column's value."""
    return lambda values: values[row(episode, frame)].__setitem__(element, value)


def paint(episode: int, frame: int, change: Callable[[Any], Any]) -> Callable[[Path], None]:
    """Replace an image of a video."""

    def changed(images: list[Any]) -> None:
        images[row(episode, frame)] = change(images[row(episode, frame)].copy())

    return lambda root: recode(root / VIDEO, changed)


def dot(image: Any) -> Any:
    image[40, 50] ^= 1
    return image


def cut_last_row(root: Path) -> None:
    edit_table(DATA, lambda table: table.slice(0, len(table) - 1))(root)
    edit_column(EPISODES, "length", lambda values: values.__setitem__(3, 14))(root)
    edit_json(INFO, lambda data: data.update(total_frames=data["total_frames"] - 1))(root)


def forget(values: list[Any]) -> None:
    values[:] = ["put it away" if value == "put it here" else value for value in values]


def forget_lists(values: list[Any]) -> None:
    for tasks in values:
        forget(tasks)


def reword(root: Path) -> None:
    """Reword one task everywhere."""
    edit_column(TASKS, TASK_COLUMN, forget)(root)
    edit_column(EPISODES, "tasks", forget_lists)(root)


def rewrite(root: Path) -> None:
    """Rewrite every table and JSON file unchanged: after that, bytes change only with content."""
    for path in (DATA, EPISODES, TASKS):
        edit_table(path, lambda table: table)(root)
    for path in (INFO, STATS):
        edit_json(path, lambda data: None)(root)
    recode(root / VIDEO)


INJECTED: dict[str, tuple[Callable[[Path], None], str]] = {
    "robot": (edit_json(INFO, lambda d: d.update(robot_type="so101")), "robot_type is "),
    "names": (edit_json(INFO, lambda d: d["features"]["action"].update(names=["x", "y", "w"])),
              "the feature action has the names "),
    "feature missing": (edit_json(INFO, lambda d: d["features"].pop("action")), "the feature action is not in "),
    "task reworded": (reword, "episodes 1, 3: the task 'put it "),
    "a frame less": (cut_last_row, "episode 3: 1"),
    "one value": (edit_column(DATA, "action", put(1, 5, 0.25, 2)),
                  "episode 1: action differs in 1 of 13 frames, first in frame 5"),
    "one pixel": (paint(1, 4, dot), f"episode 1: the encoded images of {TOP} differ"),
}  # fmt: skip


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four episodes; each differs from the others."""
    root = write_with_lerobot(tmp_path_factory.mktemp("base") / "d", episodes=len(LENGTHS))
    edit_table(EPISODES, lambda t: t.append_column("quality", pa.array([0.9, 0.8, 0.7, 0.6])))(root)
    rewrite(root)
    before = files_of(root)
    rewrite(root)
    assert files_of(root) == before
    return root


@pytest.mark.parametrize("case", INJECTED)
def test_each_difference_is_named_and_nothing_else(
    case: str, base: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = Path(shutil.copytree(base, tmp_path / "changed"))
    inject, text = INJECTED[case]
    inject(root)
    assert files_of(root) != files_of(base)
    for found in (compared(base, root, capsys), compared(root, base, capsys)):
        (difference,) = found
        assert difference.startswith(text)


def test_episodes_are_found_by_their_content(base: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    other = tmp_path / "other"
    assert run("reorder", base, "--order", "2,0,3,1", "--out", tmp_path / "moved") == 0
    assert run("reorder", base, "--order", "0,1,2,3", "--out", tmp_path / "copy") == 0
    assert compared(tmp_path / "copy", tmp_path / "moved", capsys) == []
    assert run("drop", tmp_path / "moved", "--episodes", 3, "--out", other) == 0
    edit_column(DATA, "action", lambda values: values[20].__setitem__(0, 9.0))(other)  # frame 6 of the former episode 0
    base = tmp_path / "copy"
    changed = "action differs in 1 of 12 frames, first in frame 6"
    assert compared(base, other, capsys) == ["episodes only in A: 1", f"episode 0 (in B 1): {changed}"]
    assert compared(other, base, capsys) == ["episodes only in B: 1", f"episode 1 (in B 0): {changed}"]


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
