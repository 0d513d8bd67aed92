"""What the servos of a real arm say: their calibration, and from positions of joints to the values that LeRobot gives.

LeRobot reads counts of a servo's encoder and makes degrees of them, centred on the servo's calibrated range, or the
share of that range in per cent (`MotorsBus` with `DEGREES` and `RANGE_0_100`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from demorec.core.geometry import Array

COUNTS = 4096
"""Of the encoder in a turn."""


@dataclass(frozen=True, kw_only=True)
class Motor:
    """A servo and its calibration.

    Attributes:
        joint: Of the URDF; also the servo's name.
        zero: Count at the joint's zero; counts grow with the joint's position.
        range_min, range_max: Calibrated range, counts, as in LeRobot's file of a calibration.
        unit: Degrees from the middle of the range, or per cent of it, which never leave 0 to 100.
    """

    joint: str
    zero: int
    range_min: int
    range_max: int
    unit: Literal["deg", "%"] = "deg"

    def value(self, position: Array) -> Array:
        """What LeRobot says of positions (...), rad, before the encoder rounds them: degrees or per cent."""
        count = self.zero + position * (COUNTS / (2 * math.pi))
        if self.unit == "deg":
            # A turn has one step less here than it has counts: so LeRobot has it.
            return np.asarray((count - (self.range_min + self.range_max) / 2) * (360 / (COUNTS - 1)))
        share = (count - self.range_min) / (self.range_max - self.range_min)
        return np.asarray(np.clip(share, 0.0, 1.0) * 100)


@dataclass(frozen=True, kw_only=True)
class RealArm:
    """An arm as LeRobot drives it.

    Attributes:
        robot_type: What LeRobot calls it.
        motors: In LeRobot's order: those of the arm's joints, then that of the gripper's.
    """

    robot_type: str
    motors: tuple[Motor, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Of the elements of state and action."""
        return tuple(f"{motor.joint}.pos" for motor in self.motors)

    def values(self, joint_position: Array) -> Array:
        """(T, D) degrees and per cent of (T, D) positions, rad, in the order of the motors."""
        columns = zip(self.motors, joint_position.T, strict=True)
        return np.stack([motor.value(position) for motor, position in columns], axis=1)
