"""CPU seconds of an attempt by stage, with a clock that the test sets."""

from __future__ import annotations

import time

import pytest

from demorec.generate import worker
from demorec.generate.worker import RECORDING, RENDERING, SIMULATION
from demorec.runs.run_file import STARTING


@pytest.mark.parametrize(
    ("first", "expected"),
    [
        (SIMULATION, {SIMULATION: 1.0 + 4.0, RENDERING: 20.0 + 50.0, RECORDING: 300.0}),
        # A worker's first drawing compiles: that belongs to the start.
        (STARTING, {STARTING: 1.0 + 20.0, SIMULATION: 4.0, RENDERING: 50.0, RECORDING: 300.0}),
    ],
)
def test_every_second_counts_once(first: str, expected: dict[str, float], monkeypatch: pytest.MonkeyPatch) -> None:
    now = 1000.0
    monkeypatch.setattr(time, "process_time", lambda: now)
    clock = worker._Stopwatch(first)
    now += 1.0
    with clock.stage(RENDERING):
        now += 20.0
    with clock.stage(RECORDING):
        now += 300.0
    now += 4.0
    with clock.stage(RENDERING):
        now += 50.0
    assert clock.seconds() == expected
