"""Faults of datasets, one at a time, and the checks that must find them."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from support.check import (
    change_table,
    checked,
    edit_column,
    edit_json,
    edit_parquet,
    simulate,
    simulate_run,
    verdict_of,
)
from support.commands import exit_code
from support.export import rewrite_video
from support.external import make_external, write_external
from support.mcap import rewritten

from demorec.core.errors import ExportError
from demorec.datasets.lerobot.export import export_lerobot
from demorec.datasets.lerobot.options import ExportOptions
from demorec.mcap import channels

CAMERA = "observation.images.front"
STATE = "observation.state"
Fault = Callable[[Path], None]
Rows = np.ndarray[Any, Any]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three recorded episodes with images, and their dataset."""
    folder = simulate_run(tmp_path_factory.mktemp("faults") / "run", 3, seed=3, cameras=("front",), width=64, height=64)
    export_lerobot([folder], folder / "dataset", ExportOptions(verify=False))
    return folder


@pytest.fixture
def dataset(run: Path, tmp_path: Path) -> Path:
    """A copy to be damaged."""
    return shutil.copytree(run / "dataset", tmp_path / "dataset")


def of_info(change: Callable[[Any], Any]) -> Fault:
    return lambda dataset: edit_json(dataset / "meta/info.json", change)


def of_feature(name: str, **values: Any) -> Fault:
    return of_info(lambda data: data["features"][name].update(values))


def of_video(**values: Any) -> Fault:
    return of_info(lambda data: data["features"][CAMERA]["info"].update({f"video.{k}": v for k, v in values.items()}))


def of_stats(name: str, quantity: str, value: Callable[[Any], Any]) -> Fault:
    return lambda dataset: edit_json(
        dataset / "meta/stats.json", lambda data: data[name].update({quantity: value(data[name][quantity])})
    )


def of_column(name: str, change: Callable[[Rows], Any]) -> Fault:
    return lambda dataset: edit_column(dataset, name, change)


def of_table(place: str, change: Callable[[pa.Table], pa.Table]) -> Fault:
    return lambda dataset: change_table(dataset, place, change)


def value_of(name: str, row: int, value: Any, place: str = "data") -> Fault:
    """Change one value of one row."""

    def change(values: list[Any]) -> list[Any]:
        if isinstance(values[row], list) and not isinstance(value, list):
            values[row][1] = value
        else:
            values[row] = value
        return values

    return lambda dataset: edit_parquet(next(dataset.glob(f"{place}/*/*.parquet")), name, change)


def of_rows(name: str) -> Fault:
    """Make a counter jump by one."""
    return of_column(name, lambda rows: np.concatenate([rows[:50], rows[50:] + 1]))


def rows_exchanged(table: pa.Table) -> pa.Table:
    return table.take([*range(40), 41, 40, *range(42, table.num_rows)])


def half_a_video(dataset: Path) -> None:
    video = next(dataset.glob("videos/*/*/*.mp4"))
    video.write_bytes(video.read_bytes()[: video.stat().st_size // 2])


ALONE: dict[str, tuple[Fault, str]] = {
    "a column that is not a feature": (of_info(lambda data: data["features"].pop("next.reward")), "table_schema"),
    "a feature without a column": (of_table("data", lambda t: t.drop_columns(["next.reward"])), "unreadable_episodes"),
    "another type": (of_feature("next.reward", dtype="float64"), "table_schema"),
    "another shape": (of_feature("action", shape=[7]), "unreadable_episodes"),
    "another codec": (of_video(codec="av1"), "video_format"),
    "another height": (of_video(height=128), "video_format"),
    "another shape of the images": (of_feature(CAMERA, shape=[32, 32, 3]), "video_format"),
    "another rate": (of_info(lambda data: data.update(fps=20)), "video_format"),
    "rows in another order": (of_table("data", rows_exchanged), "unreadable_episodes"),
    "a wrong index": (of_rows("index"), "contradicting_counts"),
    "the largest index": (value_of("index", 20, 2**63 - 1), "contradicting_counts"),
    "a wrong frame_index": (of_rows("frame_index"), "unreadable_episodes"),
    "a wrong timestamp": (of_rows("timestamp"), "time_grid"),
    "an unknown task": (value_of("task_index", 20, 7), "contradicting_counts"),
    "a video's range that ends early": (
        value_of(f"videos/{CAMERA}/to_timestamp", 1, 1.0, "meta/episodes"), "contradicting_counts"
    ),
    "rows of no episode": (of_table("data", lambda t: pa.concat_tables([t, t.slice(0, 5)])), "contradicting_counts"),
    "a null in an index": (value_of("task_index", 20, None), "unreadable_episodes"),
    "an episode that ends late": (value_of("length", 2, 10_000, "meta/episodes"), "unreadable_episodes"),
    "a missing table": (lambda dataset: next(dataset.glob("data/*/*.parquet")).unlink(), "unreadable_episodes"),
    "a NaN in the state": (value_of(STATE, 20, float("nan")), "missing_numbers"),
    "an infinity in the action": (value_of("action", 20, float("inf")), "missing_numbers"),
    "a wrong deviation": (of_stats("action", "std", lambda v: [*v[:2], 1.0, *v[3:]]), "wrong_statistics"),
    "a wrong quantile": (of_stats("action", "q10", lambda v: [0.5 * number for number in v]), "wrong_statistics"),
    "a wrong count": (of_stats("action", "count", lambda v: [v[0] - 1]), "wrong_statistics"),
    "numbers that are text": (of_stats("action", "mean", lambda v: [str(n) for n in v]), "wrong_statistics"),
    "numbers that are null": (of_stats("action", "mean", lambda v: None), "wrong_statistics"),
    "colours that are text": (of_stats(CAMERA, "mean", lambda v: "grey"), "wrong_statistics"),
    "colours that are not numbers": (of_stats(CAMERA, "std", lambda v: [[[float("nan")]]] * 3), "wrong_statistics"),
    "an episode's mean": (value_of("stats/action/mean", 1, 0.7, "meta/episodes"), "wrong_statistics"),
    "missing statistics": (lambda dataset: (dataset / "meta/stats.json").unlink(), "wrong_statistics"),
    "colours of 0 to 255": (of_stats(CAMERA, "mean", lambda v: [[[140.0]]] * 3), "wrong_colours"),
    "half a video": (half_a_video, "undecodable_images"),
    "one image missing": (
        lambda dataset: rewrite_video(dataset, CAMERA, lambda images: images[:-1]), "undecodable_images"
    ),
}  # fmt: skip
"""Name -> damage to the files of a dataset without sidecar, and the check that finds it."""


@pytest.mark.parametrize("name", ALONE)
def test_a_fault_of_the_files(name: str, dataset: Path) -> None:
    fault, check = ALONE[name]
    shutil.rmtree(dataset / "demorec")
    fault(dataset)
    assert verdict_of(dataset, check, "dataset") in ("look", "broken")


def second_video(dataset: Path) -> None:
    path = next(dataset.glob("videos/*/*/*.mp4"))
    shutil.copy(path, path.with_name("file-001.mp4"))


def last_frames_as_ends(dataset: Path) -> None:
    path = next(dataset.glob("meta/episodes/*/*.parquet"))
    edit_parquet(path, f"videos/{CAMERA}/to_timestamp", lambda ends: [end - 1 / 30 for end in ends])


WARNED: dict[str, tuple[Fault, str]] = {
    "videos that end at their last frames": (last_frames_as_ends, "contradicting_counts"),
    "a video without an episode": (second_video, "unused_files"),
    "statistics of an unknown feature": (
        lambda dataset: edit_json(dataset / "meta/stats.json", lambda data: data.update(force=data["action"])),
        "wrong_statistics",
    ),
}


@pytest.mark.parametrize("name", WARNED)
def test_a_warning(name: str, dataset: Path) -> None:
    fault, check = WARNED[name]
    fault(dataset)
    assert verdict_of(dataset, check, "dataset") == "look"


def test_statistics_without_a_count_are_called_missing(dataset: Path, capsys: pytest.CaptureFixture[str]) -> None:
    edit_json(dataset / "meta/stats.json", lambda data: data["action"].pop("count"))
    assert exit_code("check", dataset, "--only", "wrong_statistics") == 0
    assert "the count of action in meta/stats.json is missing" in capsys.readouterr().out


@pytest.mark.parametrize("is_ours", [True, False])
def test_the_good_one_passes(is_ours: bool, dataset: Path) -> None:
    if not is_ours:
        shutil.rmtree(dataset / "demorec")
    report = checked(dataset, "dataset")
    assert [result for result in report.results if result.verdict in ("look", "broken")] == []
    skipped = {result.check for result in report.results if result.verdict == "not measured"}
    assert skipped == {"image_lag", "cut_off_episodes", "unusual_motion"}
    assert ("dataset_sidecar" in {result.check for result in report.results}) == is_ours


@pytest.mark.slow
def test_a_nan_spoils_its_rows_and_not_the_other_checks(dataset: Path) -> None:
    shutil.rmtree(dataset / "demorec")
    value_of(STATE, 20, float("nan"))(dataset)
    edit_column(dataset, "observation.ee_pose", lambda rows: rows[:, [0, 1, 2, 6, 3, 4, 5]])
    found = {result.check: result.verdict for result in checked(dataset, "dataset", images=False).results}
    failed = {check for check, verdict in found.items() if verdict == "broken"}
    assert failed == {"missing_numbers", "pose_mismatch", "wrong_statistics"}
    assert "not measured" not in {found["joint_limits"], found["velocity_mismatch"], found["action_lag"]}


def test_a_missing_video_leaves_the_other_checks(dataset: Path) -> None:
    next(dataset.glob("videos/*/*/*.mp4")).unlink()
    found = {result.check: result.verdict for result in checked(dataset, "dataset", only=MEASURED).results}
    assert found == dict.fromkeys(MEASURED[:-1], "good") | {"undecodable_images": "not measured"}


MEASURED = ("joint_limits", "contradicting_counts", "wrong_statistics", "undecodable_images")


# ------------------------------------------------------------------------------------------------- the sidecar

CHANGED: dict[str, Fault] = {
    "a changed number": value_of(STATE, 20, 0.123),
    "another outcome": of_column("next.success", np.zeros_like),
    "a swapped image": lambda dataset: rewrite_video(
        dataset, CAMERA, lambda images: [*images[:40], images[10], *images[41:]]
    ),
}


@pytest.mark.parametrize("name", CHANGED)
def test_an_episode_that_the_sidecar_contradicts(name: str, dataset: Path) -> None:
    CHANGED[name](dataset)
    assert verdict_of(dataset, "dataset_sidecar", "dataset") == "broken"


def test_an_external_episode_that_was_changed(tmp_path: Path) -> None:
    path = write_external(tmp_path / "e.mcap", make_external(cameras=(), num_frames=12))
    export_lerobot([path], tmp_path / "ds", ExportOptions(verify=False))
    assert verdict_of(tmp_path / "ds", "dataset_sidecar", "dataset") == "good"
    edit_column(tmp_path / "ds", "action", lambda rows: rows + 1e-3)
    assert verdict_of(tmp_path / "ds", "dataset_sidecar", "dataset") == "broken"


def test_episodes_that_the_sidecar_does_not_know(run: Path, tmp_path: Path) -> None:
    """As after LeRobot's resume: episodes that the sidecar lists are compared with their own rows."""
    spoilt = shutil.copytree(run, tmp_path / "run")
    path = next((spoilt / "dataset/demorec/episodes").glob("*/*.parquet"))
    pq.write_table(pq.read_table(path).slice(1), path)
    (result,) = checked(spoilt / "dataset", "dataset", only=["dataset_sidecar"]).results
    assert (result.verdict, result.findings[0].message) == (
        "broken",
        "episode 0 is unknown, perhaps recorded with LeRobot's resume",
    )
    assert verdict_of(spoilt / "dataset", "pose_mismatch", "dataset") == "good"


def test_a_sidecar_of_other_episodes(dataset: Path) -> None:
    edit_parquet(next((dataset / "demorec/episodes").glob("*/*.parquet")), "episode_index", lambda _: [0, 1, 7])
    (result,) = checked(dataset, "dataset", only=["dataset_sidecar"]).results
    assert (result.verdict, result.findings[0].message) == (
        "broken",
        "its rows have the episodes [0, 1, 7], the dataset has 3",
    )


def test_statistics_of_row_numbers_are_not_judged(dataset: Path) -> None:
    """LeRobot's delete and split renumber rows but keep the statistics of the old numbers."""

    def renumbered(stats: dict[str, Any]) -> None:
        stats["index"]["max"] = [10**6]
        stats["episode_index"]["mean"] = [17.0]

    edit_json(dataset / "meta" / "stats.json", renumbered)
    assert verdict_of(dataset, "wrong_statistics", "dataset") == "good"


def test_a_recording_with_nan_is_not_exported(tmp_path: Path) -> None:
    source, seen = simulate(tmp_path / "a.mcap", fps=10), 0

    def spoil(topic: str, data: bytes) -> bytes:
        nonlocal seen
        seen += topic == channels.GRIPPER
        if topic != channels.GRIPPER or seen != 12:
            return data
        return data[:-40] + np.float64(np.nan).tobytes() + data[-32:]  # position, then two sequences of one number

    (tmp_path / "b.mcap").write_bytes(rewritten(source, messages=spoil))
    assert verdict_of(tmp_path / "b.mcap", "missing_numbers") == "broken"
    with pytest.raises(ExportError, match=r"observation.state is not finite in frame 11"):
        export_lerobot([tmp_path / "b.mcap"], tmp_path / "ds", ExportOptions(verify=False))
    assert not (tmp_path / "ds").exists()


def test_a_damaged_table_is_named_once(dataset: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = next(dataset.glob("data/*/*.parquet"))
    path.write_bytes(path.read_bytes()[:-100])
    assert exit_code("check", dataset) == 1
    lines = capsys.readouterr().out.splitlines()
    (finding, episodes) = (line for line in lines if line.startswith("  broken"))
    assert finding.startswith("  broken  unreadable_episodes  3 episodes (0, 1, 2), for example 0: ")
    assert episodes.startswith("  broken  3 episodes (0, 1, 2), score 0.00: The table cannot be read")
    assert lines[lines.index(finding) + 2].strip() == "-> download the tables again"
