"""One cause is one finding: what could not be checked for it is counted, and the words say each thing once."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.check import flip_bits
from support.commands import exit_code
from support.export import export, make_run
from support.recording import write_episode

from demorec.check.report import CheckOptions, Subject, check_subject
from demorec.mcap.container import Container


@pytest.fixture
def damaged(tmp_path: Path) -> Path:
    """A recording with one flipped bit in its first chunk, which holds the calibration of its camera."""
    path = write_episode(tmp_path / "e.mcap", num_frames=40, cameras=("front",), width=64, height=48)
    container = Container(path)
    place = min(container._chunks, key=lambda chunk: chunk.chunk_start_offset)
    container.close()
    return flip_bits(path, path, offset=place.chunk_start_offset + place.chunk_length // 2)


def check(path: Path, capsys: pytest.CaptureFixture[str], *flags: str) -> tuple[int, str]:
    return exit_code("check", path, *flags), capsys.readouterr().out


def test_a_flipped_bit_is_one_finding(damaged: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, text = check(damaged, capsys)
    assert code == 1
    assert [line.split()[:2] for line in text.splitlines() if "is damaged (" in line] == [["fail", "checksums:"]]
    assert "inf" not in text
    blocked = int(text.splitlines()[-2].split()[0])
    assert text.splitlines()[-2] == f"      {blocked} checks need what is damaged."
    report = check_subject(Subject(path=damaged, kind="recording"), CheckOptions())
    assert blocked == sum(result.is_blocked for result in report.results) > 2


def test_what_is_wrong_in_a_dataset_is_said_without_pythons_words(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recording = write_episode(tmp_path / "e.mcap", num_frames=10, cameras=())
    export([recording], tmp_path / "d")
    (tmp_path / "d" / "meta" / "stats.json").unlink()
    code, text = check(tmp_path / "d", capsys, "--no-images")
    assert code == 1
    (line,) = (line for line in text.splitlines() if "dataset_statistics" in line)
    assert line.strip() == (
        "fail  dataset_statistics: The statistics cannot be read (No such file or directory): meta/stats.json"
    )


def test_where_no_chosen_check_applies_nothing_has_passed(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    path = write_episode(tmp_path / "e.mcap", num_frames=10, cameras=())
    code, out = check(path, capsys, "--only", "run_files")
    assert code == 0
    assert f"skip  recording {path}: none of the chosen checks is about a recording" in out
    assert "0 checked, 0 failed, 0 with warnings. Of 1 nothing was measured." in out


def test_what_passed_is_one_line_and_what_did_not_is_listed(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    folder = make_run(tmp_path / "run", [4, 5, 6], cameras=()) / "episodes"
    damaged = folder / "episode_000001.mcap"
    only = ("--only", "opens", "checksums", "--no-images")
    code, out = check(folder, capsys, *only)
    assert code == 0
    assert out.splitlines()[0] == "pass  3 recordings: 6 checks passed"  # two of each
    damaged.write_bytes(damaged.read_bytes()[:200])
    code, out = check(folder, capsys, *only)
    assert code == 1
    assert f"fail  recording {damaged}" in out
    assert "pass  2 recordings: 4 checks passed" in out
    assert "episode_000000" not in out
    assert f"pass  recording {folder / 'episode_000000.mcap'}" in check(folder, capsys, *only, "--verbose")[1]
