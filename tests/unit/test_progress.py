"""Progress in a log file: infrequent lines with the time left, and none for short jobs."""

from __future__ import annotations

import re

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
    with ProgressBar("generating", total=total, done=done, is_terminal=False, clock=clock) as bar:
        bar.note(note)
        for _ in range(done, total):
            clock.now += seconds_each
            bar.advance()
    told = capsys.readouterr()
    assert told.out == ""
    return told.err.splitlines()


def test_a_line_has_progress_and_remaining_time(capsys: pytest.CaptureFixture[str]) -> None:
    lines = lines_of(capsys, total=40, seconds_each=5.0, note="2 failed attempts")
    assert lines[0] == "generating: 2 of 40 episodes (5 %), 10 s passed, about 3.2 min left, 2 failed attempts"
    assert lines[1].startswith("generating: 4 of 40 episodes (10 %), 20 s passed, about 3.0 min left")
    assert "left" not in lines[-1]


@pytest.mark.parametrize("is_terminal", [True, False])
@pytest.mark.parametrize("workers", [1, 8])
def test_the_start_does_not_affect_the_remaining_time(
    capsys: pytest.CaptureFixture[str], workers: int, is_terminal: bool
) -> None:
    """All workers start for two minutes, and then each finishes an episode a minute, one second apart."""
    total, clock = 100_000, Clock()
    with ProgressBar("generating", total=total, at_once=workers, is_terminal=is_terminal, clock=clock) as bar:
        clock.now += 120
        for _ in range(7):
            clock.now += 60 - workers
            for _ in range(workers):
                clock.now += 1
                bar.advance()
    left = re.findall(r"about ([\d.]+) days left", capsys.readouterr().err)
    expected = total / workers * 60 / 86400
    assert left
    assert all(expected / 2 < float(days) < expected * 1.1 for days in left)
    assert float(left[-1]) > expected * 0.8


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
