"""Faults of a run's folder, each found by the check that compares run.json, recordings and dataset."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from support.check import checked, edit_column, edit_json, edit_parquet, simulate_run, verdict_of
from support.commands import exit_code

from demorec.check.report import CheckOptions, check_subjects, find_subjects
from demorec.datasets.lerobot.export import export_lerobot
from demorec.datasets.lerobot.options import ExportOptions
from demorec.extensions.datasets.folder import LeRobotFolder
from demorec.extensions.datasets.inspect import episode_digests
from demorec.extensions.doctor.evidence import Evidence


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two recorded episodes with images, and their dataset."""
    run = simulate_run(tmp_path_factory.mktemp("runs") / "good", 2, seed=3, fps=10, cameras=("front",))
    export_lerobot([run], run / "dataset", ExportOptions(verify=False))
    return run


@pytest.fixture
def run(good: Path, tmp_path: Path) -> Path:
    """A copy to be damaged."""
    return shutil.copytree(good, tmp_path / "run")


def first_line(key: str, value: Any) -> Callable[[Any], None]:
    def change(data: Any) -> None:
        assert data["episodes"][0][key] != value
        data["episodes"][0][key] = value

    return change


def exchanged(key: str) -> Callable[[Any], None]:
    def change(data: Any) -> None:
        a, b = data["episodes"][:2]
        a[key], b[key] = b[key], a[key]

    return change


LINES: dict[str, Callable[[Any], None]] = {
    "another seed": first_line("seed", 9),
    "a failure that was a success": first_line("success", False),
    "more frames": first_line("num_frames", 999),
    "another digest": first_line("digest", "0" * 64),
    "numbers exchanged": exchanged("episode_index"),
    "another value of the config": lambda data: data["config"].update(depth=not data["config"]["depth"]),
    "other versions": lambda data: data.update(versions={"demorec": "9.9"}),
}


def test_the_good_one_passes(good: Path) -> None:
    assert {(result.check, result.verdict) for result in checked(good, "run").results} == {
        (check, "good") for check in ("run_files", "run_complete", "run_agrees", "run_dataset")
    }


@pytest.mark.parametrize("name", LINES)
def test_a_wrong_line_in_run_json(name: str, run: Path) -> None:
    edit_json(run / "run.json", LINES[name])
    assert verdict_of(run, "run_agrees", "run") == "broken"


def test_info_and_check_agree_about_a_damaged_export(run: Path) -> None:
    record = {"run_digest": "a", "repo_id": "local/a", "dataset_digest": "b", "seconds": 1.0}
    for repo_id, code, verdict in (("local/a", 0, "good"), (None, 1, "broken")):
        edit_json(run / "run.json", partial(dict.update, export={**record, "repo_id": repo_id}))
        assert exit_code("info", run) == code
        assert verdict_of(run, "run_files", "run") == verdict


def recordings_exchanged(run: Path) -> None:
    first, second = (run / f"episodes/episode_00000{number}.mcap" for number in (0, 1))
    first.rename(run / "aside")
    second.rename(first)
    (run / "aside").rename(second)


def an_episode_twice(run: Path) -> None:
    shutil.copy(run / "episodes/episode_000001.mcap", run / "episodes/episode_000007.mcap")


FOLDERS: dict[str, tuple[Callable[[Path], None], set[str]]] = {
    "recordings exchanged": (recordings_exchanged, {"run_agrees", "run_files"}),
    "an episode twice": (an_episode_twice, {"run_files"}),
    "a missing file": (lambda run: (run / "episodes/episode_000001.mcap").unlink(), {"run_files"}),
}


@pytest.mark.parametrize("name", FOLDERS)
def test_a_fault_of_the_folder(name: str, run: Path) -> None:
    change, checks = FOLDERS[name]
    change(run)
    assert checks <= {result.check for result in checked(run, "run").results if result.verdict == "broken"}


# ------------------------------------------------------------------------------------------------- its dataset


def with_its_digest(dataset: Path) -> None:
    """A number changed by a faulty exporter, with its digest: only the recording has the right one."""
    edit_column(dataset, "observation.velocity", lambda rows: rows * (1 + 1e-5))
    digests = episode_digests(LeRobotFolder(dataset))
    edit_parquet(next(dataset.glob("demorec/episodes/*/*.parquet")), "content_digest", lambda _: digests)
    assert verdict_of(dataset, "dataset_sidecar", "dataset") == "good"


def an_episode_less(dataset: Path) -> None:
    other = dataset.parent / "other"
    export_lerobot([dataset.parent / "episodes/episode_000000.mcap"], other, ExportOptions(verify=False))
    shutil.rmtree(dataset)
    other.rename(dataset)


DATASETS = {"changed with its digest": with_its_digest, "an episode less": an_episode_less}


@pytest.mark.parametrize("name", DATASETS)
def test_a_dataset_that_differs_from_its_recordings(name: str, run: Path) -> None:
    DATASETS[name](run / "dataset")
    assert verdict_of(run, "run_dataset", "run") == "broken"


@pytest.mark.slow
def test_a_dataset_of_another_run(good: Path, tmp_path: Path) -> None:
    other = simulate_run(tmp_path / "other", 2, seed=4, fps=10, cameras=("front",))
    shutil.copytree(good / "dataset", other / "dataset")
    assert verdict_of(other, "run_dataset", "run") == "broken"


# ------------------------------------------------------------------------------------------------- several subjects


@pytest.mark.slow
@pytest.mark.parametrize("workers", [1, 2])
def test_one_bad_recording_leaves_the_reports_of_the_others(workers: int, run: Path) -> None:
    bad = run / "episodes" / "episode_000000.mcap"
    bad.write_bytes(bad.read_bytes()[:-1000])
    reports = list(check_subjects(find_subjects([run]), CheckOptions(workers=workers, images=False)))
    assert [(report.path.name, report.verdict) for report in reports] == [
        ("run", "broken"),
        ("episode_000000.mcap", "broken"),
        ("episode_000001.mcap", "good"),
        ("dataset", "good"),
    ]


def test_an_unexpected_error_hides_nothing(good: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(evidence: Evidence) -> None:
        raise IndexError("list index out of range")

    monkeypatch.setattr("demorec.extensions.doctor.checks.kinematics.arm_of", broken)
    results = {result.check: result for result in checked(good / "episodes" / "episode_000000.mcap").results}
    assert results["joint_limits"].verdict == "not measured"
    assert "cannot be computed" in results["joint_limits"].not_measured
    assert "index" not in results["joint_limits"].not_measured
    assert {results[name].verdict for name in ("opens", "checksums", "missing_numbers")} == {"good"}
