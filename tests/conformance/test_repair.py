"""`demorec dataset repair` on LeRobot datasets with damage from public reports; LeRobot verifies the result."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from support.check import change_table, checked, edit_json, edit_parquet
from support.commands import exit_code
from support.datasets import TOP, items, same, write_with_lerobot
from support.drawn_datasets import write_v21
from support.export import content_of

pytestmark = [
    pytest.mark.usefixtures("hf_datasets_cache"),
    pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning"),
]
repair = partial(exit_code, "dataset", "repair")
EPISODES = 4
Damage = Callable[[Path], object]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four episodes, several files of rows and images."""
    root = tmp_path_factory.mktemp("whole") / "whole"
    return write_with_lerobot(root, episodes=EPISODES, data_files_size_in_mb=0.002, video_files_size_in_mb=0.004)


@pytest.fixture(scope="module")
def frames(whole: Path) -> list[list[dict[str, Any]]]:
    """All items that LeRobot reads from the undamaged dataset."""
    assert len(list(whole.glob("data/*/*.parquet"))) > 1
    return items(whole)


def info(**values: Any) -> Damage:
    return lambda root: edit_json(root / "meta/info.json", lambda data: data.update(values))


def feature(name: str, **values: Any) -> Damage:
    return lambda root: edit_json(root / "meta/info.json", lambda data: data["features"][name].update(values))


def column(place: str, name: str, values: Callable[[list[Any]], list[Any]]) -> Damage:
    """Change a column in all files of a folder."""

    def damage(root: Path) -> None:
        for path in root.glob(f"{place}/*/*.parquet"):
            edit_parquet(path, name, values)

    return damage


def without(*names: str) -> Damage:
    """Remove columns from the rows and from info.json."""

    def damage(root: Path) -> None:
        for path in root.glob("data/*/*.parquet"):
            pq.write_table(pq.read_table(path).drop_columns(list(names)), path)
        edit_json(root / "meta/info.json", lambda data: [data["features"].pop(name) for name in names])

    return damage


def as_double(root: Path) -> None:
    """Rows as pandas writes them, while info.json specifies float32."""
    for path in root.glob("data/*/*.parquet"):
        table = pq.read_table(path)
        values = pa.array(table.column("observation.state").to_pylist(), pa.list_(pa.float64()))
        pq.write_table(
            table.set_column(table.schema.get_field_index("observation.state"), "observation.state", values), path
        )


def same_numbers(root: Path) -> None:
    """Files joined by hand: each numbers its episodes from 0; the table of episodes was not joined."""
    for path in root.glob("data/*/*.parquet"):
        edit_parquet(path, "episode_index", lambda values: [value - min(values) + 10 for value in values])
    shutil.rmtree(root / "meta/episodes")


def cut_off(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-30])


def tasks_as_column(root: Path) -> None:
    table = pq.read_table(root / "meta/tasks.parquet")
    pq.write_table(table.replace_schema_metadata(None), root / "meta/tasks.parquet")


def other_task_numbers(root: Path) -> None:
    column("data", "task_index", lambda values: [value + 5 for value in values])(root)
    edit_parquet(root / "meta/tasks.parquet", "task_index", lambda values: [value + 5 for value in values])


def stray(root: Path) -> None:
    shutil.copy(next(root.glob("data/*/*.parquet")), root / "data/chunk-000/file-000 (copy).parquet")


def table_file(root: Path) -> Path:
    return next(root.glob("meta/episodes/*/*.parquet"))


VIDEO = f"videos/{TOP}"
DAMAGES: dict[str, tuple[Damage, str]] = {
    "never finalized (leLab#84)": (lambda root: shutil.rmtree(root / "meta/episodes"), "table of episodes is missing"),
    "a table cut off (lerobot#3522)": (lambda root: cut_off(table_file(root)), "episodes is written from the rows"),
    "episodes lost from the table (axol#158)": (
        lambda root: change_table(root, "meta/episodes", lambda table: table.slice(0, 3)), "entries of 3 are"),
    "more episodes than rows": (
        column("meta/episodes", "episode_index", lambda values: [*values[:-1], 9]), "entries of 3, 9 are"),
    "wrong counts": (info(total_episodes=9, total_frames="many", total_tasks=0), "total_frames many; it is 54 now"),
    "impossible splits": (info(splits={"train": "0:900"}), "states the splits {'train': '0:900'}; train has all"),
    "wrong sizes": (info(chunks_size=0, data_files_size_in_mb=None), "chunks_size 0"),
    "stale files (lerobot#2401)": (column("meta/episodes", "data/file_index", lambda v: [0] * len(v)), "entries of"),
    "scrambled ranges (lerobot#1919)": (
        column("meta/episodes", "dataset_from_index", lambda v: v[::-1]), "entries of"),
    "wrong lengths (lerobot#4143)": (
        column("meta/episodes", "length", lambda v: [v[0], 0, *v[2:]]), "entries of 1"),
    "images at wrong places (axol#158)": (
        column("meta/episodes", f"{VIDEO}/from_timestamp", lambda v: [x + 0.7 for x in v]), "entries of 0, 1, 2, 3"),
    "index from 0 in each file": (column("data", "index", lambda v: [x + 7 for x in v]), "index counts over"),
    "episodes from 3 on": (column("data", "episode_index", lambda v: [x + 3 for x in v]), "they were 3, 4, 5, 6"),
    "files joined by hand": (same_numbers, "numbered from 0;"),
    "no counters (lerobot#3068)": (without("frame_index", "index"), "frame_index is int64"),
    "no episode_index": (without("episode_index"), "episode_index is int64"),
    "no timestamps": (without("timestamp"), "timestamp is float32"),
    "timestamps of the whole recording (unitree_lerobot#41)": (
        column("data", "timestamp", lambda v: [x + 100 for x in v]), "timestamp of 4 of 4"),
    "measured timestamps (OpenTau#258)": (
        column("data", "timestamp", lambda v: [x + 0.004 * (k % 2) for k, x in enumerate(v)]), "up to 4.0 ms"),
    "another shape": (feature("action", shape=[5], names=None), "action is float32 of shape (3,)"),
    "names of other elements": (feature("action", names=["a", "b"]), "names of action"),
    "no feature": (
        lambda root: edit_json(root / "meta/info.json", lambda data: data["features"].pop("action")), "becomes"),
    "a feature without rows": (
        lambda root: edit_json(root / "meta/info.json", lambda data: data["features"].update(
            force={"dtype": "float32", "shape": [2], "names": None})), "force is left out"),
    "another size of images": (feature(TOP, shape=[96, 64, 3]), "96x64 pixels"),
    "another rate": (info(fps=30), "fps is 10"),
    "no statistics": (lambda root: (root / "meta/stats.json").unlink(), "stats.json is written"),
    "stale statistics": (
        lambda root: edit_json(root / "meta/stats.json", lambda data: data["action"].update(mean=[9.0] * 3)),
        "of action"),
    "no tasks": (lambda root: (root / "meta/tasks.parquet").unlink(), "table of tasks is written again"),
    "tasks whose text is not an index": (tasks_as_column, "text as its index"),
    "tasks numbered otherwise": (other_task_numbers, "numbered from 0, in order"),
    "a copy next to the files": (stray, "file-000 (copy).parquet is left out"),
}  # fmt: skip
"""Fault, with a public report of it -> function that makes it, and part of the message about it."""


@pytest.mark.slow
@pytest.mark.parametrize("fault", DAMAGES)
def test_lerobot_reads_every_frame_of_a_repaired_dataset(
    fault: str, whole: Path, frames: list[list[dict[str, Any]]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = Path(shutil.copytree(whole, tmp_path / "d"))
    damage, words = DAMAGES[fault]
    damage(root)
    before = content_of(root)
    assert repair(root, "--dry-run") == 0
    planned = capsys.readouterr().out.splitlines()
    assert repair(root, "--out", tmp_path / "new") == 0
    told = capsys.readouterr().out.splitlines()
    assert content_of(root) == before
    assert any(words in line for line in told), told
    assert [line for line in planned if "ould " not in line] == [line for line in told if line in planned]
    found = items(tmp_path / "new")
    assert len(found) == EPISODES
    assert all(same(a, b) for a, b in zip(found, frames, strict=True))
    results = checked(tmp_path / "new", "dataset", images=False).results
    assert {result.verdict for result in results if result.check.startswith("dataset")} <= {"good", "not measured"}
    assert repair(tmp_path / "new", "--out", tmp_path / "again") == 0
    assert capsys.readouterr().out == f"Nothing to repair, so nothing is written: {tmp_path / 'new'}\n"
    assert not (tmp_path / "again").exists()


@pytest.mark.parametrize(
    ("names", "shape"),
    [([["x", "y", "z"]], [3]), ({"motors": ["x", "y", "z"]}, [5]), ({"axes": ["x", "y", "z"]}, [3]), (["x", "y"], [5])],
)
def test_names_keep_their_form(
    names: Any, shape: list[int], whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = Path(shutil.copytree(whole, tmp_path / "d"))
    as_double(root)
    feature("observation.state", names=names, shape=shape)(root)
    fits = names != ["x", "y"]
    assert repair(root, "--out", tmp_path / "new") == 0
    assert ("The names of observation.state are left out" in capsys.readouterr().out) != fits
    found = json.loads((tmp_path / "new/meta/info.json").read_text())["features"]["observation.state"]
    assert (found["dtype"], found["shape"], found["names"]) == ("float64", [3], names if fits else None)


def test_a_camera_may_have_any_name(whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The columns of its ranges end in from_timestamp and to_timestamp."""
    name = "observation.images.photo_to_top"
    assert exit_code("dataset", "rename", whole, f"{TOP}={name}", "--out", tmp_path / "named") == 0
    capsys.readouterr()
    assert repair(tmp_path / "named", "--dry-run") == 0
    assert capsys.readouterr().out.startswith("Nothing to repair")


def test_splits_are_kept_where_episodes_keep_their_numbers(
    whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    splits, text = {"train": "0:1", "val": "1:2"}, "info.json states the splits"
    for name, is_cut_off in (("a", False), ("b", True)):
        root = Path(shutil.copytree(whole, tmp_path / name))
        info(splits=splits, total_tasks=0)(root)
        if is_cut_off:
            cut_off(sorted(root.glob("data/*/*.parquet"))[0])
        assert repair(root, "--out", tmp_path / f"new_{name}") == 0
        assert (text in capsys.readouterr().out) == is_cut_off
        found = json.loads((tmp_path / f"new_{name}/meta/info.json").read_text())
        assert found["splits"] == ({"train": f"0:{found['total_episodes']}"} if is_cut_off else splits)


@pytest.mark.parametrize("place", ["data", f"videos/{TOP}"])
def test_episodes_in_files_that_cannot_be_read_are_left_out_and_named(
    place: str, whole: Path, frames: list[list[dict[str, Any]]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = Path(shutil.copytree(whole, tmp_path / "d"))
    path = sorted(root.glob(f"{place}/*/*"))[-1]
    table = pq.read_table(table_file(root)).to_pylist()
    number = int(path.stem.removeprefix("file-"))
    kept = [row["episode_index"] for row in table if row[f"{place}/file_index"] != number]
    assert 0 < len(kept) < EPISODES
    cut_off(path)
    assert repair(root, "--out", tmp_path / "new") == 0
    told = capsys.readouterr().out
    assert "left out" in told
    found = items(tmp_path / "new")
    assert all(same(a, frames[n]) for a, n in zip(found, kept, strict=True))
    assert repair(tmp_path / "new", "--dry-run") == 0
    assert "Nothing to repair" in capsys.readouterr().out


@pytest.mark.slow
def test_wrong_paths_a_camera_without_videos_and_counters_as_floats(tmp_path: Path) -> None:
    """Faults of GR00T's demo data (paths, camera) and of fixtures in lerobot-studio (counters)."""
    roots = [write_v21(tmp_path / name) for name in ("whole", "d")]
    for path in roots[1].glob("data/*/*.parquet"):
        table = pq.read_table(path)
        for name in ("frame_index", "index", "episode_index", "task_index"):
            place = table.schema.get_field_index(name)
            table = table.set_column(place, name, table.column(name).cast(pa.float64()))
        pq.write_table(table, path)
    ghost = {"dtype": "video", "shape": [64, 96, 3], "names": None}
    edit_json(roots[1] / "meta/info.json", lambda data: data["features"].update({"observation.images.ghost": ghost}))
    info(data_path="data/chunk-{episode_index:03d}/episode_{episode_index:06d}.parquet")(roots[1])
    (roots[1] / "meta/episodes.jsonl").unlink()
    assert repair(roots[1], "--out", tmp_path / "new") == 0
    assert exit_code("dataset", "select", roots[0], "--episodes", "0,1", "--out", tmp_path / "expected") == 0
    found, expected = items(tmp_path / "new"), items(tmp_path / "expected")
    assert all(same(a, b) for a, b in zip(found, expected, strict=True))


def lost_rows(root: Path) -> None:
    path = next(root.glob("data/*/*.parquet"))
    table = pq.read_table(path)
    pq.write_table(table.take(pa.array(np.delete(np.arange(len(table)), 4))), path)


def no_text(root: Path) -> None:
    (root / "meta/tasks.parquet").unlink()
    shutil.rmtree(root / "meta/episodes")


def short_video(root: Path) -> None:
    """Fewer images than rows, and no file identifies the rows without one (AgiBot-World#149)."""
    shutil.rmtree(root)
    write_with_lerobot(root, episodes=2)
    path = next(root.glob("data/*/*.parquet"))
    table = pq.read_table(path).to_pylist()
    last = [row for row in table if row["episode_index"] == 0][-1]
    added = last | {"frame_index": last["frame_index"] + 1}
    at = table.index(last) + 1
    pq.write_table(pa.Table.from_pylist([*table[:at], added, *table[at:]], pq.read_schema(path)), path)


def three_rates(root: Path) -> None:
    info(fps=30)(root)
    column("data", "timestamp", lambda values: [value / 5 for value in values])(root)


REFUSED: dict[str, tuple[Damage, str]] = {
    "rows missing between others": (lost_rows, "comes after"),
    "no instruction": (no_text, "instruction of episode 0 is unknown"),
    "fewer images than rows": (short_video, "25 images for 26 rows"),
    "no info.json": (lambda root: (root / "meta/info.json").write_text("{"), "info.json"),
    "no videos": (lambda root: shutil.rmtree(root / "videos"), "restore its videos"),
    "a rate that nothing agrees on": (three_rates, "rate is ambiguous"),
}  # fmt: skip


@pytest.mark.parametrize("fault", REFUSED)
def test_repairs_that_need_invented_data_are_refused(
    fault: str, whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = Path(shutil.copytree(whole, tmp_path / "d"))
    damage, words = REFUSED[fault]
    damage(root)
    before = content_of(root)
    capsys.readouterr()
    assert repair(root, "--out", tmp_path / "new") in (1, 2)
    told = capsys.readouterr().err
    assert words in told
    assert told.count("\n") == 1
    assert content_of(root) == before
    assert [path.name for path in tmp_path.iterdir()] == ["d"]
