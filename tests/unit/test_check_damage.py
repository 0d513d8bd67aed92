"""One cause is one finding: checks that it prevents are counted, and the output repeats nothing."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.check import flip_bits
from support.commands import exit_code
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
