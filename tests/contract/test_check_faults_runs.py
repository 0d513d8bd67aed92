"""Faults of a run's folder, each caught by the check that compares run.json with the recordings themselves."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from support.check import checked, edit_json, level_of, simulate_run
from support.commands import exit_code

from demorec.check.report import CheckOptions, check_subjects, find_subjects


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two episodes without images."""
    return simulate_run(tmp_path_factory.mktemp("runs") / "good", 2, seed=3)


@pytest.fixture
def run(good: Path, tmp_path: Path) -> Path:
    """A copy to be spoilt."""
    return Path(shutil.copytree(good, tmp_path / "run"))


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


LINES: list[tuple[str, Callable[[Any], None]]] = [
    ("another seed", first_line("seed", 9)),
    ("another attempt", first_line("attempt", 1)),
    ("a failure that was a success", first_line("success", False)),
    ("a phase of a failure", first_line("phase", "lift")),
    ("a reason of a failure", first_line("reason", "drop")),
    ("more frames", first_line("num_frames", 999)),
    ("fewer bytes", first_line("num_bytes", 10)),
    ("another digest", first_line("digest", "0" * 64)),
    ("digests exchanged", exchanged("digest")),
    ("lengths exchanged", exchanged("num_bytes")),
    ("numbers exchanged", exchanged("episode_index")),
    ("another config", lambda data: data.update(config_digest="0" * 16)),
    ("another value of the config", lambda data: data["config"].update(depth=not data["config"]["depth"])),
    ("other versions", lambda data: data.update(versions={"demorec": "9.9"})),
]


def test_the_good_one_passes(good: Path) -> None:
    report = checked(good, "run")
    assert [result for result in report.results if result.level in ("warn", "fail")] == []


@pytest.mark.parametrize(("name", "change"), LINES, ids=[name for name, _ in LINES])
def test_a_line_that_lies(name: str, change: Callable[[Any], None], run: Path) -> None:
    edit_json(run / "run.json", change)
    assert level_of(run, "run_agrees", "run") == "fail"


def test_a_file_of_another_number(run: Path) -> None:
    (run / "episodes" / "episode_000001.mcap").rename(run / "episodes" / "episode_000007.mcap")
    edit_json(run / "run.json", lambda data: data["episodes"][1].update(file="episodes/episode_000007.mcap"))
    assert level_of(run, "run_agrees", "run") == "fail"


def test_a_success_among_the_failures(run: Path) -> None:
    (run / "episodes" / "episode_000001.mcap").rename(run / "failed" / "episode_000001.mcap")
    edit_json(run / "run.json", lambda data: data["episodes"][1].update(file="failed/episode_000001.mcap"))
    assert level_of(run, "run_agrees", "run") == "fail"


def test_recordings_exchanged(run: Path) -> None:
    first, second = (run / "episodes" / f"episode_00000{number}.mcap" for number in (0, 1))
    first.rename(run / "aside")
    second.rename(first)
    (run / "aside").rename(second)
    assert level_of(run, "run_agrees", "run") == "fail"
    assert level_of(run, "run_files", "run") == "fail"


def test_a_fixed_layout_is_no_twin(tmp_path: Path) -> None:
    run = simulate_run(tmp_path / "run", 2, seed=3, task="tutorial", fixed=True, variation="none")
    result = next(r for r in checked(run, "run").results if r.check == "duplicates")
    assert result.level == "skip"
    assert "--fixed" in result.detail


@pytest.mark.parametrize("workers", [1, 2])
def test_one_bad_recording_leaves_the_reports_of_the_others(
    workers: int, run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bad = run / "episodes" / "episode_000000.mcap"
    bad.write_bytes(bad.read_bytes()[:-1000])
    reports = list(check_subjects(find_subjects([run]), CheckOptions(workers=workers)))
    assert [report.path.name for report in reports] == ["run", "episode_000000.mcap", "episode_000001.mcap"]
    assert [report.level for report in reports] == ["fail", "fail", "pass"]


def test_what_nobody_foresaw_is_a_finding(good: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from demorec.check.episode import CheckedEpisode

    def broken(self: CheckedEpisode) -> None:
        raise IndexError("list index out of range")

    monkeypatch.setattr(CheckedEpisode, "world_from_tcp", property(broken))
    report = checked(good / "episodes" / "episode_000000.mcap")
    failed = {result.check: result.detail for result in report.results if result.level == "fail"}
    assert len(failed) == 1, "one cause is one finding"
    (told,) = failed.values()
    assert "cannot be computed" in told
    assert "index" not in told
    assert report.count("pass") > 20


def test_the_command_goes_on_behind_a_bad_recording(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (run / "episodes" / "episode_000000.mcap").write_bytes(b"")
    assert exit_code("check", run, "--json") == 1
    assert [row["level"] for row in json.loads(capsys.readouterr().out)] == ["fail", "fail", "pass"]
