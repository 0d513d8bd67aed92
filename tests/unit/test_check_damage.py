"""One cause is one finding: what could not be checked for it is counted, and the words say each thing once."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from support.check import flip_bits
from support.export import export
from support.recording import write_episode

from demorec.check.report import CheckOptions, Subject, check_subject
from demorec.cli import main
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
    with pytest.raises(SystemExit) as done:
        main(["check", str(path), *flags])
    return int(done.value.code or 0), capsys.readouterr().out


def test_a_flipped_bit_is_one_finding(damaged: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, text = check(damaged, capsys)
    assert code == 1
    assert [line.split()[:2] for line in text.splitlines() if "is damaged (" in line] == [["fail", "checksums:"]]
    assert "inf" not in text
    blocked = int(text.splitlines()[-2].split()[0])
    assert text.splitlines()[-2] == f"      {blocked} checks need what is damaged."
    report = check_subject(Subject(path=damaged, kind="recording"), CheckOptions())
    assert blocked == sum(result.is_blocked for result in report.results) > 6


def test_no_finding_repeats_another_or_the_name_of_the_file(damaged: Path, capsys: pytest.CaptureFixture[str]) -> None:
    _, text = check(damaged, capsys, "--json")
    (report,) = json.loads(text)
    failed = [result["detail"] for result in report["results"] if result["level"] == "fail"]
    sentences = [detail for detail in failed if detail != "camera front"]  # a place, of different measurements
    assert len(sentences) == len(set(sentences))
    assert sentences
    assert not any(str(damaged) in detail for detail in failed), "the report names the file already"


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
