"""Progress in a log file: infrequent lines, and none for short jobs."""

from __future__ import annotations

import pytest

from demorec.cli.shared.output import ProgressBar


class Clock:
    """A clock that moves only on request."""

    def __init__(self) -> None:
        self.now = 1000.0

    def __call__(self) -> float:
        return self.now


def lines_of(
    capsys: pytest.CaptureFixture[str], *, total: int, seconds_each: float, done: int = 0, note: str = ""
) -> list[str]:
    """Progress lines of a job whose items take the given times."""
    clock = Clock()
    with ProgressBar("generating", total=total, done=done, clock=clock) as bar:
        bar.note(note)
        for _ in range(done, total):
            clock.now += seconds_each
            bar.advance()
    told = capsys.readouterr()
    assert told.out == ""
    return told.err.splitlines()


def test_a_line_has_progress_and_time(capsys: pytest.CaptureFixture[str]) -> None:
    lines = lines_of(capsys, total=40, seconds_each=30.0, note="2 failed attempts")
    assert lines[0] == "generating: 2 of 40 episodes (5 %), 01:00 passed, 2 failed attempts"
    assert lines[1] == "generating: 4 of 40 episodes (10 %), 02:00 passed, 2 failed attempts"


@pytest.mark.parametrize(
    ("total", "seconds_each", "fewest", "most"),
    [
        (3, 10.0, 0, 0),
        (9000, 0.005, 0, 0),
        (130_000, 0.001, 2, 2),
        (60, 120.0, 60, 60),
    ],
)
def test_lines_are_neither_too_many_nor_too_few(
    capsys: pytest.CaptureFixture[str], total: int, seconds_each: float, fewest: int, most: int
) -> None:
    assert fewest <= len(lines_of(capsys, total=total, seconds_each=seconds_each)) <= most
