"""Failed attempts that a run keeps are judged apart: what they recorded counts for nothing, a damaged file does."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
from support.check import flip_bits
from support.export import make_run

from demorec.check.report import CheckOptions, SubjectReport, check_subjects, find_subjects
from demorec.cli import main
from demorec.cli.generate_report import check_run
from demorec.core.config import GenerateConfig
from demorec.generate.options import RunResult
from demorec.runs.run_file import Generation, RunFile, inspect_recording, save_run_file

FAILED = "failed/episode_000000.attempt_0.mcap"


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A run of one failed attempt, made up, so that checks of its physics fail."""
    folder = make_run(tmp_path / "run", [], failures=[0], cameras=())
    attempt = replace(inspect_recording(folder / FAILED)[0], file=FAILED)
    save_run_file(
        RunFile(generation=Generation(config=GenerateConfig(), versions={}, num_episodes=1), attempts=(attempt,)),
        folder,
    )
    return folder


def report_of(path: Path, file: Path) -> SubjectReport:
    """What the check of `path` says about a file."""
    (report,) = (r for r in check_subjects(find_subjects([path]), CheckOptions(images=False)) if r.path == file)
    return report


def check(capsys: pytest.CaptureFixture[str], *args: object) -> tuple[int, str]:
    with pytest.raises(SystemExit) as ended:
        main(["check", *map(str, args)])
    return int(ended.value.code or 0), capsys.readouterr().out


def test_what_a_failed_attempt_recorded_is_told_and_does_not_fail_the_run(
    capsys: pytest.CaptureFixture[str], run: Path
) -> None:
    report = report_of(run, run / FAILED)
    assert report.level == "fail"
    assert not report.is_bad()
    wrong = {result.check for result in report.results if result.level == "fail"}
    code, out = check(capsys, run, "--only", *wrong)
    assert code == 0
    assert f"fail  failed attempt {run / FAILED}" in out
    assert f"fail  {min(wrong)}" in out
    failed = [result for result in report.results if result.level == "fail" and result.value is not None]
    assert any(result.warn < result.fail for result in failed)
    for result in failed:  # with the limit that it broke
        line = next(line for line in out.splitlines() if line.lstrip().startswith(f"fail  {result.check} "))
        assert f"(allowed {result.fail:g}" in line
    assert "0 failed" in out
    assert "Not counted, since what they recorded fails checks: 1 failed attempt." in out
    code, out = check(capsys, run, "--only", *wrong, "--json")
    assert code == 0
    assert [item["failed_attempt"] for item in json.loads(out) if item["kind"] == "recording"] == [True]


@pytest.mark.parametrize("of", ["file", "folder"])
def test_named_directly_it_is_judged_as_any_recording(capsys: pytest.CaptureFixture[str], run: Path, of: str) -> None:
    path = run / FAILED if of == "file" else (run / FAILED).parent
    assert report_of(path, run / FAILED).is_bad()
    assert check(capsys, path)[0] == 1


@pytest.mark.parametrize("damage", ["cut", "flipped"])
def test_a_damaged_file_among_the_failed_attempts_fails(
    capsys: pytest.CaptureFixture[str], run: Path, damage: str
) -> None:
    path = run / FAILED
    good = path.read_bytes()
    if damage == "cut":
        path.write_bytes(good[:-100])
    else:
        flip_bits(path, path, offset=len(good) // 2)
    assert path.read_bytes() != good
    assert report_of(run, path).is_bad()
    assert check(capsys, run)[0] == 1


def test_a_recording_of_a_success_is_judged_in_full(tmp_path: Path) -> None:
    folder = make_run(tmp_path / "run", [12], cameras=())
    path = folder / "episodes/episode_000000.mcap"
    attempt = replace(inspect_recording(path)[0], file="episodes/episode_000000.mcap")
    save_run_file(
        RunFile(generation=Generation(config=GenerateConfig(), versions={}, num_episodes=1), attempts=(attempt,)),
        folder,
    )
    assert report_of(folder, path).is_bad()


def test_the_closing_table_counts_them_apart(run: Path) -> None:
    """What decides the exit code of generate-dataset."""
    attempt = replace(inspect_recording(run / FAILED)[0], file=FAILED)
    known = RunFile(generation=Generation(config=GenerateConfig(), versions={}, num_episodes=1), attempts=(attempt,))
    result = RunResult(folder=run, run=known, made=(), interrupted=False)
    found, failures = check_run(result, progress=lambda done, total: None)
    assert "not counted: those of 1 failed attempt" in found
    assert not any(failure.startswith(Path(FAILED).name) for failure in failures)


def test_where_no_chosen_check_applies_nothing_has_passed(capsys: pytest.CaptureFixture[str], run: Path) -> None:
    code, out = check(capsys, run, "--only", "opens")
    assert code == 0
    assert f"skip  run {run}: none of the chosen checks is about a run" in out
    assert "1 checked, 0 failed, 0 with warnings. Of 1 nothing was measured." in out
    _, out = check(capsys, run, "--only", "opens", "--json")
    assert {item["kind"]: item["level"] for item in json.loads(out)} == {"run": "skip", "recording": "pass"}


def test_what_passed_is_one_line_and_what_did_not_is_listed(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    run = make_run(tmp_path / "run", [0, 1, 2], cameras=())
    damaged = run / "episodes" / "episode_000001.mcap"
    only = ("--only", "opens", "checksums", "--no-images")
    code, out = check(capsys, run / "episodes", *only)
    assert code == 0
    assert out.splitlines()[0] == "pass  3 recordings: 6 checks passed"  # two of each
    damaged.write_bytes(damaged.read_bytes()[:200])
    code, out = check(capsys, run / "episodes", *only)
    assert code == 1
    assert f"fail  recording {damaged}" in out
    assert "pass  2 recordings: 4 checks passed" in out
    assert "episode_000000" not in out
    assert f"pass  recording {run / 'episodes' / 'episode_000000.mcap'}" in check(capsys, run, *only, "--verbose")[1]
