"""Each fault that is put into the language columns, the facts and the progress of a dataset is found by its check."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from support.check import checked, level_of, simulate_run
from support.export import export

Row = dict[str, Any]
Episode = list[tuple[list[Row], list[Row]]]
"""(persistent, events) of each row."""
CHECKS = ("dataset_language", "dataset_language_truth", "dataset_facts", "dataset_progress")
CAMERA = "observation.images.front"


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("good")
    run = simulate_run(
        folder / "run", 1, task="pick_from_clutter", seed=5, fps=10, cameras=("front",), width=64, height=64,
        segmentation=True,
    )  # fmt: skip
    export(run, folder / "dataset", language=(), boxes=True, progress=True)
    return folder / "dataset"


@pytest.fixture
def dataset(good: Path, tmp_path: Path) -> Path:
    shutil.copytree(good, tmp_path / "dataset")
    return tmp_path / "dataset"


def test_the_good_one_passes_all_of_them(good: Path) -> None:
    report = checked(good, "dataset", only=CHECKS)
    assert {result.check: result.level for result in report.results} == dict.fromkeys(CHECKS, "pass")


def spoil(dataset: Path, change: Callable[[Episode], None]) -> None:
    """Rewrite the language columns of the only data file."""
    path = next((dataset / "data").glob("*/*.parquet"))
    table = pq.read_table(path)
    columns = [table.column(name).to_pylist() for name in ("language_persistent", "language_events")]
    episode: Episode = list(zip(*columns, strict=True))
    before = json.dumps(episode)
    change(episode)
    assert json.dumps(episode) != before
    event = {name: pa.string() for name in ("role", "content", "style", "camera")} | {
        "tool_calls": pa.list_(pa.string())
    }
    state = {**event, "timestamp": pa.float32()}
    for name, fields, rows in (
        ("language_persistent", state, [row[0] for row in episode]),
        ("language_events", event, [row[1] for row in episode]),
    ):
        column = pa.array(rows, pa.list_(pa.struct(list(fields.items()))))
        table = table.set_column(table.column_names.index(name), name, column)
    pq.write_table(table, path)


def everywhere(style: str, change: Callable[[Row], None], number: int = 0) -> Callable[[Episode], None]:
    """Change one entry of a style in every row."""

    def apply(episode: Episode) -> None:
        for persistent, _ in episode:
            change([row for row in persistent if row["style"] == style][number])

    return apply


def answer(kind: str, change: Callable[[Row], None]) -> Callable[[Episode], None]:
    """Change the first answer that has a key."""

    def apply(episode: Episode) -> None:
        for _, events in episode:
            for row in events:
                if row["role"] == "assistant" and kind in (told := json.loads(row["content"])):
                    change(told)
                    row["content"] = json.dumps(told)
                    return
        raise AssertionError(kind)

    return apply


def first_event(change: Callable[[Row], None], style: str = "vqa") -> Callable[[Episode], None]:
    return lambda episode: change(next(row for _, events in episode for row in events if row["style"] == style))


def later(row: Row) -> None:
    row["timestamp"] += 0.1


def moved_box(told: Row) -> None:
    box = told["detections"][0]["bbox"]
    told["detections"][0]["bbox"] = [box[0] + 1, box[1], box[2] + 1, box[3]]


def first_is_other(episode: Episode) -> None:
    episode[3][0][0]["content"] = "something else"


def two_answers(episode: Episode) -> None:
    rows = next(events for _, events in episode if events)
    rows.append(dict(rows[0]))


def drop_first_subtask(episode: Episode) -> None:
    for persistent, _ in episode:
        persistent.remove(next(row for row in persistent if row["style"] == "subtask"))


def turned_round(episode: Episode) -> None:
    """All motions say up for down, and down for up."""
    for persistent, _ in episode:
        for row in persistent:
            if row["style"] == "motion":
                row["content"] = row["content"].replace("up", "UP").replace("down", "up").replace("UP", "down")


def only_first_subtask(episode: Episode) -> None:
    for persistent, _ in episode:
        subtasks = [row for row in persistent if row["style"] == "subtask"]
        persistent[:] = [row for row in persistent if row not in subtasks[1:]]


def other_colors(episode: Episode, style: str) -> None:
    """Nothing of a style has the colours of the instruction."""
    for persistent, _ in episode:
        for row in persistent:
            if row["style"] == style:
                row["content"] = re.sub(r"\b(red|blue|yellow|orange|purple|green)\b", "white", row["content"])


def of(**values: Any) -> Callable[[Row], None]:
    return lambda row: row.update(values)


def other_color(row: Row) -> None:
    words = row["content"].split()
    color = next(word for word in words if word in ("red", "blue", "yellow", "orange", "purple"))
    row["content"] = row["content"].replace(color, "green")


FAULTS: dict[str, tuple[str, Callable[[Episode], None]]] = {
    "a subtask a frame late": ("dataset_language_truth", everywhere("subtask", later, 2)),
    "a subtask about another thing": ("dataset_language_truth", everywhere("subtask", other_color, 3)),
    "a miss that was none": (
        "dataset_language_truth",
        everywhere("subtask", lambda row: row.update(content=row["content"] + ", to miss it on purpose")),
    ),
    "an ambiguous wording": (
        "dataset_language_truth", everywhere("task_aug", of(content="put the cube on the mark"), 5),
    ),
    "a wording of another task": (
        "dataset_language_truth", everywhere("task_aug", of(content="put the green target on the table"), 5),
    ),
    "the box of another thing": ("dataset_language_truth", answer("detections", moved_box)),
    "a point beside the thing": ("dataset_language_truth", answer("point", of(point=[1, 1]))),
    "a wrong count": ("dataset_language_truth", answer("count", of(count=7))),
    "a time between two frames": ("dataset_language", everywhere("plan", of(timestamp=0.05))),
    "a camera that is none": ("dataset_language", first_event(of(camera="observation.images.back"))),
    "no camera": ("dataset_language", first_event(of(camera=None), "trace")),
    "motions of the other direction": ("dataset_language", turned_round),
    "wordings of other colours": ("dataset_language", lambda episode: other_colors(episode, "task_aug")),
    "subtasks of other colours": ("dataset_language", lambda episode: other_colors(episode, "subtask")),
    "no subtask but the first": ("dataset_language", only_first_subtask),
    "a subtask of the user's": ("dataset_language", everywhere("subtask", of(role="user"))),
    "a wording of the robot's": ("dataset_language", everywhere("task_aug", of(role="assistant"))),
    "a subtask about a camera": ("dataset_language", everywhere("subtask", of(camera=CAMERA))),
    "an unknown style": ("dataset_language", everywhere("motion", of(style="dance"))),
    "a question among the states": ("dataset_language", everywhere("motion", of(style="vqa", camera=CAMERA))),
    "an unknown role": ("dataset_language", everywhere("memory", of(role="robot"))),
    "nothing said": ("dataset_language", everywhere("subtask", of(content=""))),
    "an answer that is no JSON": ("dataset_language", first_event(of(content="{oops", role="assistant"))),
    "an answer of no kind": ("dataset_language", answer("count", lambda told: told.pop("count"))),
    "a box beyond the image": (
        "dataset_language", answer("detections", lambda told: told["detections"][0].update(bbox=[0, 0, 64, 5])),
    ),
    "a trace beyond the image": ("dataset_language", answer("points", of(points=[[5, -1]]))),
    "two answers at once": ("dataset_language", two_answers),
    "no subtask at first": ("dataset_language", drop_first_subtask),
    "two subtasks at once": ("dataset_language", everywhere("subtask", of(timestamp=0.0), 1)),
    "other states in one row": ("dataset_language", first_is_other),
}  # fmt: skip


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_in_the_words_is_found(name: str, dataset: Path) -> None:
    check, change = FAULTS[name]
    spoil(dataset, change)
    assert level_of(dataset, check, "dataset") == "fail"
    assert level_of(dataset, "dataset_sidecar", "dataset") == "fail"  # the content digest


def test_plans_of_another_task(tmp_path: Path) -> None:
    run = simulate_run(tmp_path / "run", 3, seed=5, fps=10)
    export(run, tmp_path / "dataset", language=("subtask", "plan"))
    assert level_of(tmp_path / "dataset", "dataset_language", "dataset") == "pass"
    spoil(tmp_path / "dataset", everywhere("plan", of(content="1. fold a towel")))
    assert level_of(tmp_path / "dataset", "dataset_language", "dataset") == "fail"


@pytest.mark.parametrize(
    ("name", "value"), [("success", False), ("num_retries", 4), ("seed", 99), ("task_name", "stack")]
)
def test_a_wrong_fact_is_found(name: str, value: object, dataset: Path) -> None:
    path = next((dataset / "meta" / "episodes").glob("*/*.parquet"))
    table = pq.read_table(path)
    place = table.column_names.index(name)
    assert table.column(name).to_pylist() != [value]
    pq.write_table(table.set_column(place, name, pa.array([value], table.schema.field(name).type)), path)
    assert level_of(dataset, "dataset_facts", "dataset") == "fail"


@pytest.mark.parametrize("fault", ["shifted", "too much", "a row less", "stages with a gap"])
def test_wrong_progress_is_found(fault: str, dataset: Path) -> None:
    if fault == "stages with a gap":
        path = next((dataset / "meta" / "episodes").glob("*/*.parquet"))
        table = pq.read_table(path)
        name = "dense_subtask_start_frames"
        (starts,) = table.column(name).to_pylist()
        starts[1] += 1
        column = pa.array([starts], table.schema.field(name).type)
        pq.write_table(table.set_column(table.column_names.index(name), name, column), path)
    else:
        path = dataset / "sarm_progress.parquet"
        table = pq.read_table(path)
        values = table.column("progress_dense").to_pylist()
        values = {"shifted": [*values[1:], 1.0], "too much": [2.0, *values[1:]]}.get(fault, values)
        column = pa.array(values, pa.float32())
        table = table.set_column(table.column_names.index("progress_dense"), "progress_dense", column)
        pq.write_table(table.slice(0, len(values) - 1) if fault == "a row less" else table, path)
    assert level_of(dataset, "dataset_progress", "dataset") == "fail"


def test_a_dataset_without_words_has_nothing_to_measure(good: Path, tmp_path: Path) -> None:
    export(good.parent / "run", tmp_path / "plain")
    report = checked(tmp_path / "plain", "dataset", only=CHECKS)
    levels = {result.check: result.level for result in report.results}
    assert levels == dict.fromkeys(CHECKS, "skip") | {"dataset_facts": "pass"}
