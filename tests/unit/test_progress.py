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
    lines = lines_of(capsys, total=40, seconds_each=5.0, note="2 failed attempts")
    assert lines[0] == "generating: 2 of 40 episodes (5 %), 00:10 passed, 2 failed attempts"
    assert lines[1] == "generating: 4 of 40 episodes (10 %), 00:20 passed, 2 failed attempts"


@pytest.mark.parametrize(
    ("total", "seconds_each", "fewest", "most"),
    [
        (3, 3.0, 0, 0),
        (9000, 0.001, 0, 0),
        (100_000, 0.001, 9, 10),  # 100 s: every 10 s
        (8640, 10.0, 300, 360),  # a day: every five minutes after the first hours
    ],
)
def test_lines_are_neither_too_many_nor_too_few(
    capsys: pytest.CaptureFixture[str], total: int, seconds_each: float, fewest: int, most: int
) -> None:
    assert fewest <= len(lines_of(capsys, total=total, seconds_each=seconds_each)) <= most
