"""The joints in the physics steps before a frame, as the servo tells them, against a servo that is stepped."""

from __future__ import annotations

import numpy as np

from demorec.check.dynamics import servo_steps
from demorec.episode.scene import POSITION_GAIN


def test_the_steps_before_a_frame_are_those_of_the_servo() -> None:
    substeps, step_s, frames = 8, 1 / 240, 20
    rng = np.random.default_rng(4)
    start = np.array([0.3, -1.0])
    commands = start + np.cumsum(rng.normal(0, 0.02, (frames, 2)), axis=0)
    way, target, position = [start, start, start], start, start
    recorded, velocity, before, first = [start], [np.zeros(2)], [start], [start]
    for command in commands[:-1]:
        for step in range(1, substeps + 1):
            aim = target + (command - target) * step / substeps
            position = position + POSITION_GAIN * (aim - position)
            way.append(position)
        target = command
        recorded.append(way[-1])
        before.append(way[-2])
        first.append(way[-3])
        velocity.append((way[-1] - way[-2]) / step_s)
    found_before, found_first, off = servo_steps(
        np.array(recorded), np.array(velocity), commands, start=start, substeps=substeps, step_s=step_s
    )
    assert np.allclose(found_before, before, atol=1e-12)
    assert np.allclose(found_first, first, atol=1e-12)
    assert off.max() < 1e-9
    spoilt = np.array(velocity)
    spoilt[7, 1] += 0.05
    *_, off = servo_steps(np.array(recorded), spoilt, commands, start=start, substeps=substeps, step_s=step_s)
    assert np.flatnonzero(off > 0.01).tolist() == [7]
