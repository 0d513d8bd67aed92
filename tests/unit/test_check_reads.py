"""Everything that is recorded or exported is read by some check, or named as unchecked with a reason."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from demorec.check import reads
from demorec.cli import main
from demorec.core.tables import CHECKS
from demorec.mcap import SimulatedRecording

SAMPLES = Path(__file__).parents[2] / "recordings" / "sample"


def test_nothing_is_read_by_no_check_without_a_reason() -> None:
    rows = reads.coverage()
    assert [row.name for row in rows if not row.checks and not row.why_not] == []
    assert [
        row.name for row in rows if row.checks and any(reads._covers(part, row.name) for part in reads.UNCHECKED)
    ] == []


def test_what_is_declared_exists() -> None:
    names = [name for _, name in reads.everything()]
    declared = {read for check in CHECKS.names() for read in CHECKS.load(check).reads} | set(reads.UNCHECKED)
    assert [read for read in sorted(declared) if not any(reads._covers(read, name) for name in names)] == []


@pytest.mark.parametrize("sample", sorted(SAMPLES.glob("*.mcap")), ids=lambda path: path.stem)
def test_the_topics_are_those_of_recordings(sample: Path) -> None:
    known = reads.topics()
    with SimulatedRecording(sample) as recording:
        bodies = [body.name for body in recording.info.scene.bodies]
        for topic in recording.topics:
            general = topic
            for camera in recording.cameras:
                general = general.replace(f"/camera/{camera}/", "/camera/{camera}/")
            for body in bodies:
                general = general.replace(f"/object/{body}/", "/object/{body}/")
            assert general in known


def test_the_command_tells_it(capsys: pytest.CaptureFixture[str]) -> None:
    def run(*args: str) -> tuple[int, str]:
        with pytest.raises(SystemExit) as ended:
            main(["list", *args])
        return int(ended.value.code or 0), capsys.readouterr().out

    code, told = run("checks", "--coverage")
    assert code == 0
    lines = {line.split()[1]: line for line in told.splitlines()}
    assert "moving_frames" in lines["/tf"]
    assert "dataset_statistics" in lines["observation.state"]
    assert "no check: " in lines["outcome.final_state_digest"]
    code, told = run("checks", "--coverage", "--json")
    assert {row["kind"] for row in json.loads(told)} == {"topic", "field", "column"}
    assert run("tasks", "--coverage")[0] == 2
