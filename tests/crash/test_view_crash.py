"""Files that `view` makes on a full disk, in a folder without permission, after a kill."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from support.recording import write_episode

from demorec.cli import main
from demorec.view.programs import viewer_program

PROGRAM = """
import os, signal, sys
from demorec.cli import main
os.fsync = lambda handle: os.kill(os.getpid(), signal.SIGKILL)
main(sys.argv[1:])
"""


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_episode(tmp_path_factory.mktemp("recorded") / "e.mcap", num_frames=40)


def demorec(*arguments: object, limit: int = 0) -> int:
    """The exit code; a limit on the size of a file fails the write that crosses it, as a full disk does."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit or before[0], before[1]))
    try:
        with pytest.raises(SystemExit) as done:
            main([str(argument) for argument in arguments])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    return int(done.value.code or 0)


@pytest.mark.parametrize(("limit", "there"), [(1_000, False), (20_000, True), (60_000, False)])
def test_a_full_disk_is_told_and_leaves_no_cut_file(
    recorded: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str], limit: int, there: bool
) -> None:
    """Also the file that was there before stays."""
    target = tmp_path / "x.rrd"
    if there:
        target.write_bytes(b"RRF2 what was there before")
    assert demorec("view", recorded, "--save", target, "--overwrite", limit=limit) == 1
    said = capfd.readouterr()  # of Rerun's threads, too
    assert said.out == ""
    assert len(said.err.splitlines()) == 1
    assert "The file cannot be written (File too large)" in said.err
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == (
        {"x.rrd": b"RRF2 what was there before"} if there else {}
    )


def test_a_full_disk_at_the_very_end(recorded: Path, tmp_path: Path) -> None:
    """Only the last of the table of contents at the end of the file is missing."""
    whole = tmp_path / "whole.rrd"
    assert demorec("view", recorded, "--save", whole) == 0
    assert subprocess.run([viewer_program(), "rrd", "verify", whole], check=False).returncode == 0
    assert demorec("view", recorded, "--save", tmp_path / "x.rrd", limit=whole.stat().st_size - 500) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["whole.rrd"]


def test_what_a_kill_left_is_removed_by_the_next_call(recorded: Path, tmp_path: Path) -> None:
    target = tmp_path / "x.rrd"
    killed = [sys.executable, "-c", PROGRAM, "view", str(recorded), "--save", str(target)]
    assert subprocess.run(killed, capture_output=True, check=False).returncode == -signal.SIGKILL
    (left,) = tmp_path.iterdir()
    assert left.name == ".x.rrd.demorec-part"
    assert left.stat().st_size > 0
    assert demorec("view", recorded, "--save", target) == 0
    assert [path.name for path in tmp_path.iterdir()] == ["x.rrd"]


def test_a_folder_that_cannot_be_written_to(recorded: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """/proc refuses files to root, too, whom permissions do not stop."""
    place = Path("/proc/self/x.rrd")
    assert demorec("view", recorded, "--save", place) in (1, 2)
    said = capsys.readouterr().err
    assert len(said.splitlines()) == 1
    assert "cannot be written" in said
    assert not os.path.lexists(place)
