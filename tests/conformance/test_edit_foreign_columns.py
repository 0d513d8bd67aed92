"""Edits of datasets with columns that other programs write: every value that was not asked for stays, as PyArrow reads
it before and after."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from numpy.typing import NDArray
from PIL import Image
from support.commands import exit_code
from support.export import recordings
from support.foreign_dataset import DATA, EPISODES, TASKS, write_foreign

from demorec.datasets.lerobot.episode_table import are_on_grid
from demorec.mcap import Recording

TEXTS = ("open the drawer", "close the drawer", "valid", "invalid", "push it")
LENGTH, COUNT = 8, 4


def foreign(root: Path, columns: Mapping[str, pa.Array | pa.ChunkedArray], *, dtype: str = "int64") -> Path:
    """A dataset whose episodes have the tasks 4, 0, 1, 0, with other columns, or some in place of its own."""
    write_foreign(root, length=LENGTH, episodes=COUNT)
    table, info = pq.read_table(root / DATA), json.loads((root / "meta/info.json").read_text())
    numbers = [4, 0, 1, 0]
    columns = {"task_index": pa.array(np.repeat(numbers, LENGTH)), **columns}
    for name, values in columns.items():
        if name in table.column_names:
            table = table.drop_columns(name)
        else:
            info["features"][name] = {"dtype": dtype, "shape": [1], "names": None}
        table = table.append_column(name, values)
    pq.write_table(table, root / DATA)
    info["total_tasks"] = len(TEXTS)
    (root / "meta/info.json").write_text(json.dumps(info))
    pq.write_table(pa.table({"task": TEXTS, "task_index": range(len(TEXTS))}), root / TASKS)
    episodes = pq.read_table(root / EPISODES).drop_columns("tasks")
    pq.write_table(episodes.append_column("tasks", pa.array([[TEXTS[n]] for n in numbers])), root / EPISODES)
    return root


def rows(root: Path) -> pa.Table:
    return pa.concat_tables(pq.read_table(path) for path in sorted(root.glob("data/*/*.parquet")))


def tasks(root: Path) -> list[str]:
    table = pq.read_table(root / TASKS)
    order = np.argsort(table["task_index"].to_numpy())
    name = "task" if "task" in table.column_names else "__index_level_0__"
    return [table[name].to_pylist()[place] for place in order]


def said(root: Path, column: str) -> list[str]:
    """The text that each row's number stands for."""
    texts = tasks(root)
    return [texts[number] for number in rows(root)[column].to_pylist()]


@pytest.mark.parametrize("name", ["annotation.human.action.task_description", "annotation.human.validity"])
@pytest.mark.parametrize("dtype", ["int64", "int32"])
@pytest.mark.parametrize(
    ("words", "taken"),
    [
        ("select SET --episodes 2,3 --out NEW", [2, 3]),
        ("drop SET --episodes 0 --out NEW", [1, 2, 3]),
        ("rename SET observation.state=state --out NEW", [0, 1, 2, 3]),
        ("reorder SET --order 3,1,2,0 --out NEW", [3, 1, 2, 0]),
    ],
)
def test_references_to_tasks_keep_their_meaning(
    words: str, taken: list[int], name: str, dtype: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    numbers = np.random.default_rng(0).integers(0, len(TEXTS), COUNT * LENGTH)
    source = foreign(tmp_path / "set", {name: pa.array(numbers, getattr(pa, dtype)())}, dtype=dtype)
    (source / "meta/modality.json").write_text('{"annotation": {"human.validity": {}}}')
    call = [word.replace("SET", str(source)).replace("NEW", str(tmp_path / "new")) for word in words.split()]
    assert exit_code("dataset", *call) == 0, capsys.readouterr().err
    before = np.array(said(source, name)).reshape(COUNT, LENGTH)
    assert said(tmp_path / "new", name) == before[taken].ravel().tolist()
    whole = np.array(said(source, "task_index")).reshape(COUNT, LENGTH)
    assert said(tmp_path / "new", "task_index") == whole[taken].ravel().tolist()
    assert (tmp_path / "new/meta/modality.json").read_bytes() == (source / "meta/modality.json").read_bytes()


def test_merging_renumbers_references(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    name = "annotation.task"
    numbers = np.arange(COUNT * LENGTH) % len(TEXTS)
    first = foreign(tmp_path / "a", {name: pa.array(numbers)})
    second = foreign(tmp_path / "b", {name: pa.array(numbers)})
    reversed_tasks = pa.table({"task": TEXTS[::-1], "task_index": range(len(TEXTS))})
    pq.write_table(reversed_tasks, second / TASKS)
    episodes = pq.read_table(second / EPISODES).drop_columns("tasks")
    pq.write_table(
        episodes.append_column("tasks", pa.array([[TEXTS[::-1][n]] for n in (4, 0, 1, 0)])), second / EPISODES
    )
    expected = said(first, name) + said(second, name)
    assert exit_code("dataset", "merge", first, second, "--out", tmp_path / "new") == 0, capsys.readouterr().err
    assert said(tmp_path / "new", name) == expected


def test_columns_that_may_be_references_are_refused_where_numbers_change(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    numbers = pa.array(np.zeros(COUNT * LENGTH, np.int64))
    first = foreign(tmp_path / "a", {"subtask_id": numbers})
    second = foreign(tmp_path / "b", {"subtask_id": numbers})
    pq.write_table(pa.table({"task": TEXTS[::-1], "task_index": range(len(TEXTS))}), second / TASKS)
    episodes = pq.read_table(second / EPISODES).drop_columns("tasks")
    pq.write_table(
        episodes.append_column("tasks", pa.array([[TEXTS[::-1][n]] for n in (4, 0, 1, 0)])), second / EPISODES
    )
    assert exit_code("dataset", "merge", first, second, "--out", tmp_path / "new") == 2
    assert "subtask_id may hold numbers of tasks" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


def measured(jitter_s: float, start_s: float) -> NDArray[np.float32]:
    """Timestamps of four episodes that a clock has measured, or that begin late."""
    random = np.random.default_rng(1)
    steps = np.tile(np.arange(LENGTH) / 10, COUNT) + start_s
    return (steps + random.uniform(0, jitter_s, COUNT * LENGTH)).astype(np.float32)


@pytest.mark.parametrize(("jitter_s", "start_s"), [(0.004, 0.0), (0.03, 0.0), (0.0, 3.25), (0.02, 1.7)])
def test_measured_timestamps_stay(
    jitter_s: float, start_s: float, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    seconds = measured(jitter_s, start_s)
    source = foreign(tmp_path / "set", {"timestamp": pa.array(seconds)})
    assert exit_code("dataset", "select", source, "--episodes", "1,3", "--out", tmp_path / "new") == 0
    found = rows(tmp_path / "new")["timestamp"].to_numpy()
    assert found.tobytes() == seconds.reshape(COUNT, LENGTH)[[1, 3]].tobytes()
    assert exit_code("dataset", "trim", source, "--head", "3", "--out", tmp_path / "cut") == 0
    cut = seconds.reshape(COUNT, LENGTH)[:, 3:].astype(np.float64)
    expected = (cut - cut[:, :1]).astype(np.float32)
    grid = np.abs(cut - cut[:, :1] - np.arange(LENGTH - 3) / 10).max(axis=1) <= 1e-4
    trimmed = rows(tmp_path / "cut")["timestamp"].to_numpy().reshape(COUNT, LENGTH - 3)
    for episode in range(COUNT):
        if not grid[episode]:
            assert trimmed[episode].tobytes() == expected[episode].tobytes()
    assert exit_code("import", "lerobot", source, "--out", tmp_path / "run") == 0, capsys.readouterr().err
    for path, stamps in zip(recordings(tmp_path / "run"), seconds.reshape(COUNT, LENGTH), strict=True):
        with Recording(path) as recording:
            assert recording.time_ns.tolist() == np.rint(stamps.astype(np.float64) * 1e9).astype(np.int64).tolist()
    assert exit_code("view", source, "--episodes", "0", "--save", tmp_path / "x.rrd") == 0


@pytest.mark.parametrize("begin_s", [0.0, 10.0, 1500.0, 3000.0])
def test_the_grid_of_a_long_episode_is_one(begin_s: float) -> None:
    """float32 rounds times beyond 1,024 s by more than LeRobot's tolerance."""
    seconds = (begin_s + np.arange(300) / 30).astype(np.float32).astype(np.float64)
    assert are_on_grid(seconds, 30, float(seconds[0]))
    seconds[7] += 0.002
    assert not are_on_grid(seconds, 30, float(seconds[0]))


def test_doubles_under_float32_stay_doubles(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    values = np.random.default_rng(2).normal(size=(COUNT * LENGTH, 3))
    source = foreign(tmp_path / "set", {"action": pa.array(list(values), pa.list_(pa.float64()))})
    assert exit_code("dataset", "select", source, "--episodes", "0,2", "--out", tmp_path / "new") == 0
    assert "float32 of action, which the data files hold as float64" in capsys.readouterr().out
    found = np.array(rows(tmp_path / "new")["action"].to_pylist())
    assert found.dtype == np.float64
    assert found.tobytes() == values.reshape(COUNT, LENGTH, 3)[[0, 2]].tobytes()
    assert json.loads((tmp_path / "new/meta/info.json").read_text())["features"]["action"]["dtype"] == "float64"
    assert exit_code("import", "lerobot", source, "--out", tmp_path / "run") == 0
    with Recording(recordings(tmp_path / "run")[1]) as recording:
        np.testing.assert_array_equal(
            recording.table().features["action"], values[LENGTH : 2 * LENGTH].astype("float32")
        )


@pytest.mark.parametrize("kind", [pa.binary(), pa.large_binary()])
def test_images_as_plain_bytes_are_read(kind: Any, tmp_path: Path) -> None:
    images = []
    for row in range(COUNT * LENGTH):
        file = io.BytesIO()
        Image.new("RGB", (64, 48), (row, 0, 0)).save(file, "PNG")
        images.append(file.getvalue())
    source = foreign(tmp_path / "set", {"observation.images.top": pa.array(images, kind)})
    assert exit_code("dataset", "select", source, "--episodes", "3", "--out", tmp_path / "new") == 0
    found = [row["bytes"] for row in rows(tmp_path / "new")["observation.images.top"].to_pylist()]
    assert found == images[3 * LENGTH :]
    assert exit_code("view", source, "--episodes", "0", "--save", tmp_path / "x.rrd") == 0
