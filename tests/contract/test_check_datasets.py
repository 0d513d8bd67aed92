"""Faults in runs and datasets, one at a time, and the checks that are meant for them."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from support.check import checked, copy, edit_column, edit_json, level_of, simulate_run
from support.external import make_external, write_external

from demorec.check.coverage import largest_gap
from demorec.core.config import EpisodePlan, GenerateConfig
from demorec.core.tables import TASKS
from demorec.datasets.lerobot.export import export_lerobot
from demorec.datasets.lerobot.options import ExportOptions
from demorec.episode.info import EpisodeInfo
from demorec.loop import prepare

Rows = np.ndarray[Any, Any]


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
        report = checked(path, kind, images=False)
        assert [r for r in report.results if r.level in ("warn", "fail")] == []
        assert report.count("pass") >= 3
    assert level_of(filmed_dataset, "dataset_image_statistics", "dataset") == "pass"
    assert level_of(filmed_dataset, "dataset_videos", "dataset") == "pass"


# ------------------------------------------------------------------------------------------------- runs


@pytest.mark.parametrize("complete", [True, False])
def test_what_a_killed_run_has_not_listed_yet(run: Path, tmp_path: Path, complete: bool) -> None:
    spoilt = copy(run, tmp_path / "run")
    shutil.copy(spoilt / "episodes/episode_000001.mcap", spoilt / "episodes/episode_000007.mcap")
    told = json.loads((spoilt / "run.json").read_text())
    (spoilt / "run.json").write_text(json.dumps({**told, "complete": complete}))
    results = checked(spoilt, "run", images=False).results
    (found,) = [result for result in results if result.check == "run_files"]
    assert "episode_000007.mcap is not in run.json" in found.detail
    assert ("the command that began the run takes it in" in found.detail) != complete


def test_a_dataset_that_lacks_an_episode(run: Path, tmp_path: Path) -> None:
    spoilt = copy(run, tmp_path / "run")
    export_lerobot([spoilt], spoilt / "dataset", ExportOptions(verify=False))
    assert level_of(spoilt, "run_dataset", "run") == "pass"
    edit_json(spoilt / "dataset/meta/info.json", lambda data: data.update(total_episodes=2))
    assert level_of(spoilt, "run_dataset", "run") == "fail"


def _infos(count: int) -> list[EpisodeInfo]:
    return [prepare(EpisodePlan(config=GenerateConfig(cameras=()), episode_index=i)).info for i in range(count)]


def test_coverage() -> None:
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


@pytest.mark.parametrize("task", TASKS.names())
def test_what_is_chosen_from_a_few_is_no_gap(task: str) -> None:
    """Which tray, which slot in it: 50 episodes of every task are judged to cover their ranges."""
    for seed in (0, 9):
        config = GenerateConfig(task=task, cameras=(), seed=seed)
        found = largest_gap([prepare(EpisodePlan(config=config, episode_index=i)).info for i in range(50)])
        assert found is not None
        assert found.value < 0.35, found.detail


# ------------------------------------------------------------------------------------------------- datasets


def of_column(name: str, change: Callable[[Rows], Any]) -> Callable[[Path], None]:
    return lambda dataset: edit_column(dataset, name, change)


def of_json(file: str, change: Callable[[Any], None]) -> Callable[[Path], None]:
    return lambda dataset: edit_json(dataset / file, change)


def nudged(rows: Rows) -> Rows:
    rows[100, 3] += 1e-5
    return rows


STATE, RANDOM = "observation.state", np.random.default_rng(0)
FAULTS: dict[str, tuple[Callable[[Path], None], Sequence[str]]] = {
    "shifted actions": (of_column("action", lambda r: np.concatenate([r[:1], r[:-1]])), ("dataset_action_lag",)),
    # A third-party dataset doctor gave full marks to these.
    "random actions": (
        of_column("action", lambda r: RANDOM.uniform(r.min(axis=0), r.max(axis=0), r.shape)), ("dataset_action_lag",)
    ),
    "joints exchanged": (of_column(STATE, lambda r: r[:, [1, 0, *range(2, r.shape[1])]]), ("forward_kinematics",)),
    "degrees": (of_column(STATE, np.degrees), ("joint_limits",)),
    "scalar first": (
        of_column("observation.ee_pose", lambda r: r[:, [0, 1, 2, 6, 3, 4, 5]]), ("forward_kinematics",)
    ),
    "another fps": (
        of_json("meta/info.json", lambda d: d.update(fps=20)), ("velocity_matches_position", "dataset_counts")
    ),
    "wrong statistics": (
        of_json("meta/stats.json", lambda d: d["action"]["std"].__setitem__(2, 1.0)), ("dataset_statistics",)
    ),
    **{
        f"wrong {name}": (of_column(name, lambda r: np.concatenate([r[:50], r[50:] + 1])), ("dataset_counts",))
        for name in ("index", "frame_index", "timestamp")
    },
    "a changed number": (of_column(STATE, nudged), ("dataset_sidecar",)),
    "another outcome": (of_column("next.success", np.zeros_like), ("dataset_sidecar",)),
    "a missing table": (lambda dataset: next(dataset.glob("data/*/*.parquet")).unlink(), ("dataset_readable",)),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_of_a_dataset(fault: str, dataset: Path, tmp_path: Path) -> None:
    change, checks = FAULTS[fault]
    spoilt = copy(dataset, tmp_path / "ds")
    change(spoilt)
    for check in checks:
        assert level_of(spoilt, check, "dataset") == "fail"


def _copied(source: str, target: str) -> Callable[[Path], None]:
    def fault(run: Path) -> None:
        shutil.copy(run / f"episodes/episode_00000{source}.mcap", run / f"episodes/episode_00000{target}.mcap")

    return fault


RUN_FAULTS: dict[str, tuple[Callable[[Path], None], Sequence[str]]] = {
    "an episode twice": (_copied("1", "7"), ("duplicates", "run_files")),
    "a changed file": (_copied("1", "2"), ("run_files", "run_agrees")),
    "a missing file": (lambda run: (run / "episodes/episode_000001.mcap").unlink(), ("run_files",)),
}


@pytest.mark.parametrize("fault", RUN_FAULTS)
def test_a_fault_of_a_run(fault: str, run: Path, tmp_path: Path) -> None:
    change, checks = RUN_FAULTS[fault]
    spoilt = copy(run, tmp_path / "run")
    change(spoilt)
    for check in checks:
        assert level_of(spoilt, check, "run") == "fail"


@pytest.mark.parametrize("action", ["joint_increment", "ee", "ee_delta"])
def test_shifted_actions_of_every_kind(action: str, run: Path, tmp_path: Path) -> None:
    export_lerobot([run], tmp_path / "ds", ExportOptions(verify=False, action=action))  # type: ignore[arg-type]
    assert level_of(tmp_path / "ds", "dataset_action_lag", "dataset") == "pass"
    late = 1 if action == "ee" else 6  # noise is taken back in increments, which blurs their time
    edit_column(tmp_path / "ds", "action", lambda rows: np.concatenate([np.zeros_like(rows[:late]), rows[:-late]]))
    assert level_of(tmp_path / "ds", "dataset_action_lag", "dataset") == "fail"


def test_wrong_image_statistics(filmed_dataset: Path, tmp_path: Path) -> None:
    spoilt = copy(filmed_dataset, tmp_path / "ds")
    # Levels of 0..255 instead of 0..1.
    key = "observation.images.front"
    edit_json(spoilt / "meta/stats.json", lambda data: data[key].update(mean=[[[140.0]], [[139.0]], [[138.0]]]))
    assert level_of(spoilt, "dataset_image_statistics", "dataset") == "fail"


def test_a_cut_video(filmed_dataset: Path, tmp_path: Path) -> None:
    spoilt = copy(filmed_dataset, tmp_path / "ds")
    video = next(spoilt.glob("videos/*/*/*.mp4"))
    video.write_bytes(video.read_bytes()[: video.stat().st_size // 2])
    assert level_of(spoilt, "dataset_videos", "dataset") == "fail"


def test_episodes_that_the_sidecar_does_not_know(dataset: Path, tmp_path: Path) -> None:
    """As after LeRobot's resume: those that it knows are judged by their own rows."""
    spoilt = copy(dataset, tmp_path / "ds")
    path = next((spoilt / "demorec" / "episodes").glob("*/*.parquet"))
    pq.write_table(pq.read_table(path).slice(1), path)
    before, after = (checked(each, "dataset", images=False).results for each in (dataset, spoilt))
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


def test_coverage_of_a_dataset_comes_from_its_sidecar(dataset: Path) -> None:
    from demorec.check.dataset import Dataset

    infos = Dataset(dataset).infos
    assert [info.episode_index for info in infos] == [0, 1, 2]
    renamed = [info.with_simulation(task="another") for info in infos]
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
