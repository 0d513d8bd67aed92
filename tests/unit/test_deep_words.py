"""The last line of `check --deep`: what could not be made again is not said to differ."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from support.external import write_external

from demorec.cli import main
from demorec.cli.check import deep_summary
from demorec.replay.deep import DeepReport


def report(error: str = "") -> DeepReport:
    return DeepReport(path=Path("a.mcap"), versions=(), error=error, num_frames=3, is_derived=False)


def test_what_is_impossible_is_counted_apart() -> None:
    good, impossible = report(), report("it has no scene")
    assert deep_summary([], []) == ""
    assert deep_summary([good, good], [good]) == " 2 made again, 1 not as recorded."
    assert deep_summary([good, impossible], [impossible]) == (
        " 1 made again, 0 not as recorded. 1 could not be made again."
    )


def test_other_versions_are_counted_as_they_are_told() -> None:
    other = replace(report(), versions=("version of pybullet is 1 there and 2 here",))
    assert deep_summary([report(), other], []) == " 2 made again (1 with a warning), 0 not as recorded."


def test_a_external_episode_cannot_be_made_again(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write_external(tmp_path / "a.mcap")
    with pytest.raises(SystemExit) as ended:
        main(["check", str(path), "--deep", "--only", "opens"])
    assert ended.value.code == 1
    told = capsys.readouterr().out
    assert "It cannot be made again" in told
    assert told.rstrip().endswith("1 could not be made again.")
    assert "not as recorded" not in told
