"""`--interject`: the expert goes for the wrong thing, is corrected, and the dataset says so in LeRobot's form."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from support.check import checked, level_of, simulate_run
from support.export import export
from support.language import active, language_of, meant, phrases

from demorec.core.config import GenerateConfig
from demorec.core.plain import from_plain, to_plain
from demorec.core.seeding import PURPOSES
from demorec.datasets.lerobot import dataset_digest
from demorec.mcap import Recording

Row = dict[str, Any]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("interjection") / "run"
    return simulate_run(folder, 1, task="pick_from_clutter", seed=3, fps=10, interject=True)


@pytest.fixture(scope="module")
def dataset(run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("interjection") / "dataset"
    report = export(run, out, language=(), progress=True)
    assert report.digest == dataset_digest(out)
    return out


def recording_of(run: Path) -> Path:
    (path,) = (run / "episodes").glob("*.mcap")
    return path


def test_a_config_without_it_is_written_as_before() -> None:
    assert "interject" not in to_plain(GenerateConfig())
    assert to_plain(GenerateConfig(interject=True))["interject"] is True
    assert from_plain(to_plain(GenerateConfig()), GenerateConfig) == GenerateConfig()
    assert PURPOSES[-1] == "interjection"  # a stream of its own behind all others


def test_the_hand_goes_for_the_wrong_thing_until_it_is_told(run: Path) -> None:
    with Recording(recording_of(run)) as recording:
        columns, info = recording.columns(), recording.info
        ((time_ns, event),) = [item for item in recording.events() if item[1].name == "interjection"]
    assert recording.outcome is not None
    assert recording.outcome.success
    words = event.message.split()
    wanted, mistaken = words[0], words[-1]
    assert wanted == info.scene.goals[0].object != mistaken
    frame = columns.time_ns.tolist().index(time_ns)
    assert set(columns.phase[:frame]) == {"mistake"}
    assert columns.phase[frame] == "correct"
    tcp = info.scene.robot.world_from_base.apply(columns.base_from_tcp[:, :3])
    there = {name: columns.object_poses[name][0, :2].tolist() for name in (wanted, mistaken)}

    def nearer(name: str, first: int, last: int) -> bool:
        return math.dist(tcp[last, :2], there[name]) < math.dist(tcp[first, :2], there[name])

    assert nearer(mistaken, 0, frame)
    assert nearer(wanted, columns.phase.index("approach"), columns.phase.index("descend"))


def test_the_recording_passes_every_check(run: Path) -> None:
    report = checked(recording_of(run))
    assert [result.check for result in report.results if result.level not in ("pass", "skip")] == []


@pytest.mark.slow
def test_lerobots_own_validator_finds_nothing(dataset: Path, tmp_path: Path) -> None:
    from lerobot.annotations.steerable_pipeline.reader import iter_episodes
    from lerobot.annotations.steerable_pipeline.staging import EpisodeStaging
    from lerobot.annotations.steerable_pipeline.validator import StagingValidator

    (frames,) = language_of(dataset)
    (record,) = iter_episodes(dataset)
    staging = EpisodeStaging(tmp_path, record.episode_index)
    staging.write("plan", frames[0][0])
    events = [
        {**row, "timestamp": record.frame_timestamps[number]} for number, (_, rows) in enumerate(frames) for row in rows
    ]
    staging.write("interjections", [row for row in events if row["style"] in ("interjection", None)])
    report = StagingValidator().validate([record], tmp_path)
    assert (report.errors, report.warnings) == ([], [])
    assert [row["role"] for row in events if row["style"] in ("interjection", None)] == ["user", "assistant"]


def test_words_say_what_is_meant_and_the_plan_is_another(run: Path, dataset: Path) -> None:
    with Recording(recording_of(run)) as recording:
        scene, fps, phase = recording.info.scene, recording.info.fps, recording.columns().phase
    wanted = scene.goals[0].object
    (frames,) = language_of(dataset)
    frame = phase.index("correct")
    said, answer = [row for row in frames[frame][1] if row["style"] in ("interjection", None)]
    assert wanted in [name for phrase in phrases(said["content"]) for name in meant(phrase, scene)]
    (call,) = answer["tool_calls"]
    function = json.loads(call)["function"]
    assert function["name"] == "say"
    assert [meant(phrase, scene) for phrase in phrases(function["arguments"]["text"])] == [[wanted]]
    for time, is_meant in ((0.0, False), (frame / fps, True)):
        for style in ("plan", "subtask") if not is_meant else ("plan",):
            (row,) = active(frames[0][0], style, time + 1e-4)
            assert (meant(phrases(row["content"])[0], scene) == [wanted]) == is_meant, row["content"]


def spoil(dataset: Path, change: Callable[[list[tuple[list[Row], list[Row]]]], None], out: Path) -> Path:
    """A copy of the numbers and sidecar with other language columns."""
    shutil.copytree(dataset, out)
    path = next((out / "data").glob("*/*.parquet"))
    table = pq.read_table(path)
    columns = [table.column(name).to_pylist() for name in ("language_persistent", "language_events")]
    rows = list(zip(*columns, strict=True))
    before = json.dumps(rows)
    change(rows)
    assert json.dumps(rows) != before
    event = dict.fromkeys(("role", "content", "style", "camera"), pa.string()) | {"tool_calls": pa.list_(pa.string())}
    for name, fields, values in (
        ("language_persistent", {**event, "timestamp": pa.float32()}, [row[0] for row in rows]),
        ("language_events", event, [row[1] for row in rows]),
    ):
        column = pa.array(values, pa.list_(pa.struct(list(fields.items()))))
        table = table.set_column(table.column_names.index(name), name, column)
    pq.write_table(table, path)
    return out


def place(rows: list[tuple[list[Row], list[Row]]]) -> int:
    return next(number for number, (_, told) in enumerate(rows) if any(row["style"] == "interjection" for row in told))


def _later(rows: list[tuple[list[Row], list[Row]]]) -> None:
    frame = place(rows)
    rows[frame + 1][1].extend(rows[frame][1])
    rows[frame][1].clear()


def _other_thing(rows: list[tuple[list[Row], list[Row]]]) -> None:
    said = next(row for row in rows[place(rows)][1] if row["style"] == "interjection")
    said["content"] = "No, not that one."


def _no_answer(rows: list[tuple[list[Row], list[Row]]]) -> None:
    told = rows[place(rows)][1]
    told[:] = [row for row in told if row["style"] is not None]


def _old_plan(rows: list[tuple[list[Row], list[Row]]]) -> None:
    for persistent, _ in rows:
        persistent[:] = [row for row in persistent if row["style"] != "plan" or row["timestamp"] == 0]


@pytest.mark.parametrize("change", [_later, _other_thing, _no_answer, _old_plan])
def test_words_that_do_not_fit_what_happened_are_found(
    change: Callable[[list[tuple[list[Row], list[Row]]]], None], dataset: Path, tmp_path: Path
) -> None:
    assert level_of(dataset, "dataset_language_truth", "dataset") == "pass"
    assert level_of(dataset, "dataset_language", "dataset") == "pass"
    spoilt = spoil(dataset, change, tmp_path / "spoilt")
    assert level_of(spoilt, "dataset_language_truth", "dataset") == "fail"
