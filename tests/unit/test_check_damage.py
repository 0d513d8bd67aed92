"""One cause is one finding: checks that it prevents are counted, and the output repeats nothing."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.check import flip_bits
from support.commands import exit_code
from support.export import make_run
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
    assert len([line for line in text.splitlines() if line.startswith("  broken  checksums")]) == 1
    assert "inf" not in text
    report = check_subject(Subject(path=damaged, kind="recording"), CheckOptions())
    assert [finding.check for finding in report.findings] == ["checksums"]


def test_damaged_parts_are_listed_and_good_ones_are_not(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    folder = make_run(tmp_path / "run", [4, 5, 6], cameras=()) / "episodes"
    only = ("--only", "opens", "checksums", "missing_numbers", "--no-images")
    code, out = check(folder, capsys, *only)
    assert code == 0
    assert out.splitlines()[1].startswith("good: 3 episodes, 15 frames")
    damaged = folder / "episode_000001.mcap"
    damaged.write_bytes(damaged.read_bytes()[:200])
    code, out = check(folder, capsys, *only)
    assert code == 1
    assert out.splitlines()[1] == "broken: 3 episodes, 10 frames; 1 broken, 2 good"
    assert "episode_000001.mcap" in out
    assert "episode_000000" not in out
    assert "good    episode 0" in check(folder, capsys, *only, "--all")[1]
