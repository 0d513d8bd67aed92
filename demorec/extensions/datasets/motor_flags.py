"""Flags that name the servos of the arm whose values a dataset holds."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from demorec.cli.shared.flags import arg
from demorec.core.errors import ConfigError
from demorec.robots.motors import Motors, MotorUnits


@dataclass(frozen=True, kw_only=True)
class MotorFlags:
    """The servos of a real arm whose values LeRobot recorded as state and action."""

    motor_units: MotorUnits | None = None
    """Joint units of a dataset that LeRobot recorded with an SO-101 (shoulder_pan.pos to gripper.pos): degrees,
    LeRobot's default, or -100..100 of each joint's range. The dataset does not record the units.
    """
    calibration: Path | None = None
    """With --motor-units: LeRobot's calibration file of the arm (auto: an arm that matches its URDF)."""

    @property
    def named(self) -> Motors | None:
        """The servos; None without --motor-units. Raises ConfigError if the calibration does not match them."""
        from demorec.robots.so101 import SO101_FOLLOWER

        if self.motor_units is not None:
            return SO101_FOLLOWER.motors(self.motor_units, self.calibration)
        if self.calibration is not None:
            raise ConfigError("--calibration belongs to --motor-units.")
        return None


MotorsByFlags = Annotated[MotorFlags, arg(name="")]
