"""Subtasks of external recordings become the language columns of a dataset, row by row, with nothing added."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from rerun.chunk import RrdReader
from support.commands import exit_code
from support.export import export, recordings
from support.external import make_external, write_external

from demorec.check.report import CheckOptions, Subject, check_subject
from demorec.core.errors import ConfigError
from demorec.extensions.recorder.sampled_writer import SampledWriter
from demorec.extensions.recovery.recover import recover
from demorec.mcap import Recording

pytestmark = pytest.mark.usefixtures("hf_datasets_cache")
SAID = {12: "grasp the cup", 30: "lift the cup", 41: "put it down"}


def recorded(folder: Path, *episodes: dict[int, str]) -> Path:
    """A run whose episodes have these subtasks, each at its first row."""
    (folder / "run" / "episodes").mkdir(parents=True)
    for index, subtasks in enumerate(episodes):
        given = make_external(cameras=(), episode_index=index)
        frames = [replace(frame, subtask=subtasks.get(row, "")) for row, frame in enumerate(given.frames)]
        path = folder / "run" / "episodes" / f"episode_{index:06d}.mcap"
        write_external(path, replace(given, frames=frames))
    return folder / "run"


def rows_of(dataset: Path) -> list[dict[str, Any]]:
    (file,) = sorted((dataset / "data").rglob("*.parquet"))
    found: list[dict[str, Any]] = pq.read_table(file).to_pylist()
    return found


@pytest.mark.parametrize(
    ("change", "expected"),
    [({"style": "memory"}, "all but its subtasks"), ({"content": "a\nb"}, "a subtask is not a single line")],
)
def test_other_language_of_a_dataset_is_left_out(
    change: dict[str, str], expected: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    export(recorded(tmp_path, SAID), tmp_path / "a", language=("subtask",))
    (file,) = sorted((tmp_path / "a" / "data").rglob("*.parquet"))
    table = pq.read_table(file)
    place = table.schema.get_field_index("language_persistent")
    rows = table.column(place).to_pylist()
    for row in rows:
        row[1] |= change
    fields = list(table.schema.field(place).type.value_type)[:4]
    plain = pa.list_(pa.struct([(field.name, field.type) for field in fields]))
    kept = [[{field.name: entry[field.name] for field in fields} for entry in row] for row in rows]
    pq.write_table(table.set_column(place, "language_persistent", pa.array(kept, plain)), file)
    assert exit_code("import", "lerobot", tmp_path / "a", "--out", tmp_path / "again") == 0
    assert f"language_persistent is left out: {expected}" in capsys.readouterr().out
    with Recording(recordings(tmp_path / "again")[0]) as opened:
        assert len(opened.subtasks) == (2 if "style" in change else 0)


@pytest.mark.usefixtures("without_lerobot")
def test_a_dataset_has_exactly_the_recorded_subtasks(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recorded(tmp_path, SAID)
    words = ("export", "lerobot", tmp_path / "run", "--out", tmp_path / "dataset", "--language", "subtask")
    assert exit_code(*words, "--no-verify") == 0
    assert "Nobody said" not in capsys.readouterr().out
    for row in rows_of(tmp_path / "dataset"):
        told = row["language_persistent"]
        assert [(entry["content"], entry["timestamp"]) for entry in told] == [
            (text, float(np.float32(frame / 30))) for frame, text in SAID.items()
        ]
        assert {(entry["role"], entry["style"], entry["camera"]) for entry in told} == {("assistant", "subtask", None)}
        assert not row["language_events"]
    report = check_subject(Subject(path=tmp_path / "dataset", kind="dataset"), CheckOptions())
    assert not [result.check for result in report.results if result.verdict in ("broken", "look")]


def test_subtasks_are_shown_at_their_time(tmp_path: Path) -> None:
    (recording,) = recordings(recorded(tmp_path, SAID))
    with Recording(recording) as opened:
        times = opened.table().time_ns
        expected = [(int(times[frame] - times[0]) / 1e9, text) for frame, text in opened.subtasks]
    assert len(expected) == 3
    assert exit_code("view", recording, "--save", tmp_path / "x.rrd") == 0
    shown: list[tuple[float, str]] = []
    for chunk in RrdReader(tmp_path / "x.rrd").stream():
        if chunk.entity_path == "/words":
            batch = chunk.to_record_batch()
            seconds = batch.column("time").cast("int64").to_pylist()
            pages = batch.column("TextDocument:text").to_pylist()
            shown += [(time / 1e9, page) for time, (page,) in zip(seconds, pages, strict=True)]
    assert [page for _, page in shown] == [f"**Now**\n\n{text}" for _, text in expected]
    assert [time for time, _ in shown] == pytest.approx([time for time, _ in expected], abs=1e-6)


def test_all_kinds_means_the_known_ones(tmp_path: Path) -> None:
    export(recorded(tmp_path, SAID), tmp_path / "all", language=())
    assert {entry["style"] for row in rows_of(tmp_path / "all") for entry in row["language_persistent"]} == {"subtask"}
    with pytest.raises(ConfigError, match="needs the scene"):
        export(tmp_path / "run", tmp_path / "plans", language=("subtask", "plan"))


def test_episodes_without_subtasks_get_none(tmp_path: Path) -> None:
    recorded(tmp_path, SAID, {})
    words = ("export", "lerobot", tmp_path / "run", "--out", tmp_path / "dataset", "--language", "--no-verify")
    assert exit_code(*words) == 0
    assert [len(row["language_persistent"]) for row in rows_of(tmp_path / "dataset")].count(0) == len(
        [row for row in rows_of(tmp_path / "dataset") if row["episode_index"] == 1]
    )


def test_subtasks_are_never_invented(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ("export", "lerobot", recorded(tmp_path, {}), "--out", tmp_path / "dataset", "--language", "subtask")
    assert exit_code(*words, "--no-verify") == 2
    err = capsys.readouterr().err
    assert "no source specifies subtasks" in err
    assert err.count("\n") == 1
    assert not (tmp_path / "dataset").exists()


def test_recovery_keeps_subtasks(tmp_path: Path) -> None:
    given = make_external(cameras=())
    with SampledWriter(tmp_path / "a.mcap", given.info) as writer:
        for number, frame in enumerate(given.frames):
            writer.write(replace(frame, subtask={0: "reach", 9: "grasp"}.get(number, "")))
        writer.flush()
    recover(tmp_path / "a.mcap.part", tmp_path / "b.mcap")
    with Recording(tmp_path / "b.mcap") as recording:
        assert recording.subtasks == ((0, "reach"), (9, "grasp"))
