"""Calibration errors are recovered from the recorded numbers; contradictory numbers give none."""

from __future__ import annotations

import math

import numpy as np
import pytest

from demorec.core.geometry import Pose
from demorec.episode.variation import error_values, stated_error


@pytest.mark.parametrize(
    "lie",
    [
        {"calibration_front_angle": math.nan},
        {"calibration_front_qy": 1.5},
        {"calibration_front_x": math.inf},
    ],
)
def test_contradictory_numbers_give_no_calibration_error(lie: dict[str, float]) -> None:
    turn = Pose(position=np.array([1e-3, 0, 0]), quat_xyzw=np.array([0.003, 0.004, 0.0, math.sqrt(1 - 25e-6)]))
    values = error_values({"front": turn})
    assert values["calibration_front_angle"] == pytest.approx(2 * math.asin(0.005))
    assert stated_error("front", values) is not None
    assert stated_error("front", values | lie) is None
