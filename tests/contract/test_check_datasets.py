"""Faults in runs and datasets, one at a time, and the checks that are meant for them."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from support.check import checked, copy, edit_column, edit_json, level_of, simulate_run
from support.external import make_external, write_external

from demorec.check.coverage import draw_coverage, largest_gap
from demorec.core.config import EpisodePlan, GenerateConfig
from demorec.core.tables import TASKS
from demorec.datasets.lerobot.export import export_lerobot
from demorec.datasets.lerobot.options import ExportOptions
from demorec.episode.episode import SimulatedInfo
from demorec.loop import prepare


@pytest.fixture(scope="session")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return simulate_run(tmp_path_factory.mktemp("check") / "run", 3, seed=3)


@pytest.fixture(scope="session")
def dataset(run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("check_ds") / "ds"
    export_lerobot([run], folder, ExportOptions(verify=False))
    return folder


@pytest.fixture(scope="session")
def filmed_dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("check_filmed")
    run = simulate_run(folder / "run", 2, seed=3, cameras=("front",))
    export_lerobot([run], folder / "ds", ExportOptions(verify=False))
    return folder / "ds"


def test_the_good_ones_pass_without_a_warning(run: Path, dataset: Path, filmed_dataset: Path) -> None:
    for path, kind in ((run, "run"), (dataset, "dataset")):
        report = checked(path, kind, pictures=False)
        assert [r for r in report.results if r.level in ("warn", "fail")] == []
        assert report.count("pass") >= 3
    assert level_of(filmed_dataset, "dataset_picture_statistics", "dataset") == "pass"
    assert level_of(filmed_dataset, "dataset_videos", "dataset") == "pass"


# ------------------------------------------------------------------------------------------------- runs


def test_an_episode_twice(run: Path, tmp_path: Path) -> None:
    spoilt = copy(run, tmp_path / "run")
    shutil.copy(spoilt / "episodes/episode_000001.mcap", spoilt / "episodes/episode_000007.mcap")
    assert level_of(spoilt, "duplicates", "run") == "fail"
    assert level_of(spoilt, "run_files", "run") == "fail"


def test_a_changed_file(run: Path, tmp_path: Path) -> None:
    spoilt = copy(run, tmp_path / "run")
    shutil.copy(spoilt / "episodes/episode_000001.mcap", spoilt / "episodes/episode_000002.mcap")
    assert level_of(spoilt, "run_files", "run") == "fail"
    assert level_of(spoilt, "run_agrees", "run") == "fail"


def test_a_missing_file(run: Path, tmp_path: Path) -> None:
    spoilt = copy(run, tmp_path / "run")
    (spoilt / "episodes/episode_000001.mcap").unlink()
    assert level_of(spoilt, "run_files", "run") == "fail"


@pytest.mark.parametrize("complete", [True, False])
def test_what_a_killed_run_has_not_listed_yet(run: Path, tmp_path: Path, complete: bool) -> None:
    spoilt = copy(run, tmp_path / "run")
    shutil.copy(spoilt / "episodes/episode_000001.mcap", spoilt / "episodes/episode_000007.mcap")
    told = json.loads((spoilt / "run.json").read_text())
    (spoilt / "run.json").write_text(json.dumps({**told, "complete": complete}))
    results = checked(spoilt, "run", pictures=False).results
    (found,) = [result for result in results if result.check == "run_files"]
    assert "episode_000007.mcap is not in run.json" in found.detail
    assert ("the command that began the run takes it in" in found.detail) != complete


def test_another_seed_in_run_json(run: Path, tmp_path: Path) -> None:
    spoilt = copy(run, tmp_path / "run")
    edit_json(spoilt / "run.json", lambda data: data["episodes"][1].update(seed=99))
    assert level_of(spoilt, "run_agrees", "run") == "fail"


def test_another_config_in_run_json(run: Path, tmp_path: Path) -> None:
    spoilt = copy(run, tmp_path / "run")
    edit_json(spoilt / "run.json", lambda data: data.update(config_digest="0123456789abcdef"))
    assert level_of(spoilt, "run_agrees", "run") == "fail"


def test_a_dataset_that_lacks_an_episode(run: Path, tmp_path: Path) -> None:
    spoilt = copy(run, tmp_path / "run")
    export_lerobot([spoilt], spoilt / "dataset", ExportOptions(verify=False))
    assert level_of(spoilt, "run_dataset", "run") == "pass"
    edit_json(spoilt / "dataset/meta/info.json", lambda data: data.update(total_episodes=2))
    assert level_of(spoilt, "run_dataset", "run") == "fail"


def _infos(count: int) -> list[SimulatedInfo]:
    return [prepare(EpisodePlan(config=GenerateConfig(cameras=()), episode_index=i)).info for i in range(count)]


def test_coverage(tmp_path: Path) -> None:
    infos = _infos(60)
    full = largest_gap(infos)
    assert full is not None
    assert full.value < 0.35
    # The middle half of the table left out, as a sampler with a bug would.
    x = [info.scene.body("red_cube").world_from_body.position[0] for info in infos]
    low, high = np.quantile(x, [0.1, 0.9])
    outer = [info for info, value in zip(infos, x, strict=True) if not low < value < high]
    halved = largest_gap(outer * 5)
    assert halved is not None
    assert halved.value > 0.35
    same = largest_gap([infos[0]] * 60)
    assert same is not None
    assert same.value == 1.0
    # Five starts ten times each and five single ones: too few are drawn to be judged alone, and it is no coverage.
    few = largest_gap([info for info in infos[:5] for _ in range(10)] + infos[5:10])
    assert few is not None
    assert few.value > 0.35
    assert largest_gap(infos[:40]) is None  # too few to judge
    draw_coverage(infos, tmp_path / "coverage.png")
    assert (tmp_path / "coverage.png").stat().st_size > 1000


@pytest.mark.parametrize("task", TASKS.names())
def test_what_is_chosen_from_a_few_is_no_gap(task: str) -> None:
    """Which tray, which slot in it: 50 episodes of every task are judged to cover their ranges."""
    for seed in (0, 9):
        config = GenerateConfig(task=task, cameras=(), seed=seed)
        found = largest_gap([prepare(EpisodePlan(config=config, episode_index=i)).info for i in range(50)])
        assert found is not None
        assert found.value < 0.35, found.detail


# ------------------------------------------------------------------------------------------------- datasets


def test_shifted_actions(dataset: Path, tmp_path: Path) -> None:
    spoilt = copy(dataset, tmp_path / "ds")
    edit_column(spoilt, "action", lambda rows: np.concatenate([rows[:1], rows[:-1]]))
    assert level_of(spoilt, "dataset_action_lag", "dataset") == "fail"


def test_random_actions(dataset: Path, tmp_path: Path) -> None:
    # A third-party dataset doctor gave full marks to these.
    spoilt = copy(dataset, tmp_path / "ds")
    rng = np.random.default_rng(0)
    edit_column(spoilt, "action", lambda rows: rng.uniform(rows.min(axis=0), rows.max(axis=0), rows.shape))
    assert level_of(spoilt, "dataset_action_lag", "dataset") == "fail"


@pytest.mark.parametrize("action", ["joint_increment", "ee", "ee_delta"])
def test_shifted_actions_of_every_kind(action: str, run: Path, tmp_path: Path) -> None:
    export_lerobot([run], tmp_path / "ds", ExportOptions(verify=False, action=action))  # type: ignore[arg-type]
    assert level_of(tmp_path / "ds", "dataset_action_lag", "dataset") == "pass"
    late = 1 if action == "ee" else 6  # noise is taken back in increments, which blurs their time
    edit_column(tmp_path / "ds", "action", lambda rows: np.concatenate([np.zeros_like(rows[:late]), rows[:-late]]))
    assert level_of(tmp_path / "ds", "dataset_action_lag", "dataset") == "fail"


def test_swapped_joints(dataset: Path, tmp_path: Path) -> None:
    spoilt = copy(dataset, tmp_path / "ds")
    edit_column(spoilt, "observation.state", lambda rows: rows[:, [1, 0, *range(2, rows.shape[1])]])
    assert level_of(spoilt, "forward_kinematics", "dataset") == "fail"


def test_degrees(dataset: Path, tmp_path: Path) -> None:
    spoilt = copy(dataset, tmp_path / "ds")
    edit_column(spoilt, "observation.state", np.degrees)
    assert level_of(spoilt, "joint_limits", "dataset") == "fail"


def test_quaternions_scalar_first(dataset: Path, tmp_path: Path) -> None:
    spoilt = copy(dataset, tmp_path / "ds")
    edit_column(spoilt, "observation.ee_pose", lambda rows: rows[:, [0, 1, 2, 6, 3, 4, 5]])
    assert level_of(spoilt, "forward_kinematics", "dataset") == "fail"


def test_wrong_fps(dataset: Path, tmp_path: Path) -> None:
    spoilt = copy(dataset, tmp_path / "ds")
    edit_json(spoilt / "meta/info.json", lambda data: data.update(fps=20))
    assert level_of(spoilt, "velocity_matches_position", "dataset") == "fail"
    assert level_of(spoilt, "dataset_counts", "dataset") == "fail"


def test_wrong_statistics(dataset: Path, tmp_path: Path) -> None:
    spoilt = copy(dataset, tmp_path / "ds")
    edit_json(spoilt / "meta/stats.json", lambda data: data["action"]["std"].__setitem__(2, 1.0))
    assert level_of(spoilt, "dataset_statistics", "dataset") == "fail"


def test_wrong_picture_statistics(filmed_dataset: Path, tmp_path: Path) -> None:
    spoilt = copy(filmed_dataset, tmp_path / "ds")
    # Levels of 0..255 instead of 0..1.
    key = "observation.images.front"
    edit_json(spoilt / "meta/stats.json", lambda data: data[key].update(mean=[[[140.0]], [[139.0]], [[138.0]]]))
    assert level_of(spoilt, "dataset_picture_statistics", "dataset") == "fail"


def test_a_cut_video(filmed_dataset: Path, tmp_path: Path) -> None:
    spoilt = copy(filmed_dataset, tmp_path / "ds")
    video = next(spoilt.glob("videos/*/*/*.mp4"))
    video.write_bytes(video.read_bytes()[: video.stat().st_size // 2])
    assert level_of(spoilt, "dataset_videos", "dataset") == "fail"


@pytest.mark.parametrize("column", ["index", "frame_index", "timestamp"])
def test_wrong_counters(column: str, dataset: Path, tmp_path: Path) -> None:
    spoilt = copy(dataset, tmp_path / "ds")
    edit_column(spoilt, column, lambda rows: np.concatenate([rows[:50], rows[50:] + 1]))
    assert level_of(spoilt, "dataset_counts", "dataset") == "fail"


def test_a_changed_number(dataset: Path, tmp_path: Path) -> None:
    spoilt = copy(dataset, tmp_path / "ds")

    def nudge(rows: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        rows[100, 3] += 1e-5
        return rows

    edit_column(spoilt, "observation.state", nudge)
    assert level_of(spoilt, "dataset_sidecar", "dataset") == "fail"


def test_an_outcome_that_was_changed(dataset: Path, tmp_path: Path) -> None:
    spoilt = copy(dataset, tmp_path / "ds")
    edit_column(spoilt, "next.success", np.zeros_like)
    assert level_of(spoilt, "dataset_sidecar", "dataset") == "fail"


def test_episodes_that_the_sidecar_does_not_know(dataset: Path, tmp_path: Path) -> None:
    """As after LeRobot's resume: those that it knows are judged by their own rows."""
    spoilt = copy(dataset, tmp_path / "ds")
    path = next((spoilt / "demorec" / "episodes").glob("*/*.parquet"))
    pq.write_table(pq.read_table(path).slice(1), path)
    before, after = (checked(each, "dataset", pictures=False).results for each in (dataset, spoilt))
    differing = [(b.check, b.level, a.level) for b, a in zip(before, after, strict=True) if b.level != a.level]
    # What is not known to be ours is judged as anybody's.
    assert differing == [("pose_follows_joints", "skip", "pass"), ("dataset_sidecar", "pass", "fail")]
    (sidecar,) = [result for result in after if result.check == "dataset_sidecar"]
    assert sidecar.detail.startswith("of episode 0 it knows nothing: LeRobot recorded 1 of 3 into the dataset, or")


def test_a_sidecar_of_other_episodes(dataset: Path, tmp_path: Path) -> None:
    spoilt = copy(dataset, tmp_path / "ds")
    path = next((spoilt / "demorec" / "episodes").glob("*/*.parquet"))
    table = pq.read_table(path)
    numbers = pa.array([0, 1, 7], table.schema.field("episode_index").type)
    pq.write_table(table.set_column(table.schema.get_field_index("episode_index"), "episode_index", numbers), path)
    (result,) = checked(spoilt, "dataset", only=["dataset_sidecar"]).results
    assert (result.level, result.detail) == ("fail", "its rows are of the episodes [0, 1, 7], the dataset has 3")


def test_statistics_of_numbers_of_rows_are_nobodys_business(dataset: Path, tmp_path: Path) -> None:
    """LeRobot's delete and split number rows anew and keep the statistics of the old numbers."""
    spoilt = copy(dataset, tmp_path / "ds")

    def renumbered(stats: dict[str, Any]) -> None:
        stats["index"]["max"] = [10**6]
        stats["episode_index"]["mean"] = [17.0]

    edit_json(spoilt / "meta" / "stats.json", renumbered)
    assert level_of(spoilt, "dataset_statistics", "dataset") == "pass"
    edit_json(spoilt / "meta" / "stats.json", lambda stats: stats["timestamp"].update(max=[10**6]))
    assert level_of(spoilt, "dataset_statistics", "dataset") == "fail"


def test_a_number_of_a_external_episode_that_was_changed(tmp_path: Path) -> None:
    path = write_external(tmp_path / "e.mcap", make_external(cameras=(), num_frames=12))
    export_lerobot([path], tmp_path / "ds", ExportOptions(verify=False))
    assert level_of(tmp_path / "ds", "dataset_sidecar", "dataset") == "pass"
    edit_column(tmp_path / "ds", "action", lambda rows: rows + 1e-3)
    assert level_of(tmp_path / "ds", "dataset_sidecar", "dataset") == "fail"


def test_an_episode_twice_in_a_dataset(run: Path, tmp_path: Path) -> None:
    spoilt = copy(run, tmp_path / "run")
    shutil.copy(spoilt / "episodes/episode_000001.mcap", spoilt / "episodes/episode_000009.mcap")
    export_lerobot([spoilt], tmp_path / "ds", ExportOptions(verify=False))
    assert level_of(tmp_path / "ds", "duplicates", "dataset") == "fail"


def test_a_missing_table(dataset: Path, tmp_path: Path) -> None:
    spoilt = copy(dataset, tmp_path / "ds")
    next(spoilt.glob("data/*/*.parquet")).unlink()
    report = checked(spoilt, "dataset", pictures=False)
    assert next(r for r in report.results if r.check == "dataset_readable").level == "fail"


def test_coverage_of_a_dataset_comes_from_its_sidecar(dataset: Path) -> None:
    from demorec.check.dataset import Dataset

    infos = Dataset(dataset).infos
    assert [info.episode_index for info in infos] == [0, 1, 2]
    renamed = [replace(info, task="another") for info in infos]
    assert largest_gap(renamed) is None


@pytest.mark.slow
def test_what_lerobot_cannot_open(filmed_dataset: Path, tmp_path: Path) -> None:
    assert level_of(filmed_dataset, "dataset_opens", "dataset") == "pass"
    spoilt = copy(filmed_dataset, tmp_path / "ds")
    path = next(spoilt.glob("meta/episodes/*/*.parquet"))
    pq.write_table(pq.read_table(path).drop_columns(["length"]), path)
    for data in spoilt.glob("data/*/*.parquet"):
        data.unlink()
    # Without these columns the tables themselves cannot be read, which is said instead of starting LeRobot.
    assert checked(spoilt, "dataset").level == "fail"
