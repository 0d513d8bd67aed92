"""Servos of a real arm: their calibration, and the conversion of joint positions to LeRobot's values.

LeRobot converts encoder counts of a servo to degrees, centred on its calibrated range, or to a ratio of that range:
-100 to 100, for grippers 0 to 100 (`MotorsBus._normalize`, `MotorNormMode`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from demorec.core.errors import ConfigError, describe_error
from demorec.core.files import read_text_limited
from demorec.core.geometry import Array
from demorec.core.plain import from_plain, listed, parse_json

COUNTS = 4096
"""Encoder counts per turn."""
MotorUnits = Literal["degrees", "range_m100_100"]
"""LeRobot's units of an arm's joints: with `use_degrees` (its default) and without."""
CALIBRATIONS = Path(__file__).with_name("calibration")
"""Folder of the calibrations that ship with the robots."""
_MAX_BYTES = 1 << 16


@dataclass(frozen=True, kw_only=True)
class MotorCalibration:
    """A servo's entry in the file that `lerobot-calibrate` saves.

    `drive_mode` is 1 if ratios of the range run against the encoder, else 0; the range is in counts.
    """

    id: int
    drive_mode: int
    homing_offset: int
    range_min: int
    range_max: int


@dataclass(frozen=True, kw_only=True)
class Motor:
    """A servo in a real arm.

    Attributes:
        joint: Joint of the URDF; also the servo's name.
        middle: Position of the joint in the middle of the calibrated range, rad; counts increase with the position.
        units: LeRobot's unit of its position.
        calibration: Its calibration.
    """

    joint: str
    middle: float
    units: MotorUnits | Literal["range_0_100"]
    calibration: MotorCalibration

    @property
    def to_position(self) -> tuple[float, float]:
        """Factor and offset: factor times LeRobot's value plus offset is the joint's position, rad."""
        zero, unit = self._scale
        step = 2 * math.pi / COUNTS
        return step / unit, step * (zero - self._count_at_zero)

    def value(self, position: Array) -> Array:
        """Convert positions (...), rad, to LeRobot's values, before rounding to encoder counts."""
        zero, unit = self._scale
        value = (self._count_at_zero + position * (COUNTS / (2 * math.pi)) - zero) * unit
        if self.units == "degrees":
            return np.asarray(value)
        return np.clip(value, 0.0 if self.units == "range_0_100" else -100.0, 100.0)

    @property
    def _count_at_zero(self) -> int:
        """Encoder count at the joint's zero."""
        return (self.calibration.range_min + self.calibration.range_max) // 2 - round(self.middle / math.tau * COUNTS)

    @property
    def _scale(self) -> tuple[float, float]:
        """Encoder count at LeRobot's 0, and LeRobot's units per count."""
        low, high = self.calibration.range_min, self.calibration.range_max
        if self.units == "degrees":
            # LeRobot counts one step less in a turn.
            return (low + high) / 2, 360 / (COUNTS - 1)
        sign = -1 if self.calibration.drive_mode else 1
        if self.units == "range_m100_100":
            return (low + high) / 2, sign * 200 / (high - low)
        return (high if sign < 0 else low), sign * 100 / (high - low)


@dataclass(frozen=True, kw_only=True)
class Motors:
    """The calibrated servos of an arm.

    Attributes:
        robot_type: LeRobot's name of the arm in datasets.
        motors: In LeRobot's order: arm joints first, then the gripper.
    """

    robot_type: str
    motors: tuple[Motor, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the elements of state and action."""
        return tuple(f"{motor.joint}.pos" for motor in self.motors)

    @property
    def joints(self) -> tuple[str, ...]:
        """Joints of the URDF, in the same order."""
        return tuple(motor.joint for motor in self.motors)

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the elements: "deg", or "%" of the calibrated range or of its half."""
        return tuple("deg" if motor.units == "degrees" else "%" for motor in self.motors)

    @property
    def to_positions(self) -> tuple[tuple[float, float], ...]:
        """Factor and offset of each motor, as `Motor.to_position`."""
        return tuple(motor.to_position for motor in self.motors)

    def values(self, joint_position: Array) -> Array:
        """Convert (T, D) positions, rad, in the order of the motors, to LeRobot's values (T, D)."""
        columns = zip(self.motors, joint_position.T, strict=True)
        return np.stack([motor.value(position) for motor, position in columns], axis=1)


@dataclass(frozen=True, kw_only=True)
class RealArm:
    """An arm driven by LeRobot.

    Attributes:
        robot_type: LeRobot's name in datasets.
        middles: Joint of the URDF, in LeRobot's order, gripper last -> its position, rad, in the middle of the range
            that `lerobot-calibrate` finds.
        calibration: Name of the file in `CALIBRATIONS` for an arm built exactly as its URDF.
    """

    robot_type: str
    middles: Mapping[str, float]
    calibration: str

    def motors(self, units: MotorUnits = "degrees", calibration: Path | None = None) -> Motors:
        """Build the servos from a calibration saved by LeRobot, or from that of an arm built exactly as its URDF.

        Raises:
            ConfigError: The file is not a calibration of such an arm.
        """
        path = calibration or CALIBRATIONS / self.calibration
        found, (*_, gripper) = read_calibration(path, tuple(self.middles)), self.middles
        motors = [
            Motor(
                joint=joint,
                middle=middle,
                units="range_0_100" if joint == gripper else units,
                calibration=found[joint],
            )
            for joint, middle in self.middles.items()
        ]
        return Motors(robot_type=self.robot_type, motors=tuple(motors))


def read_calibration(path: Path, names: tuple[str, ...]) -> dict[str, MotorCalibration]:
    """Read motor -> its entry in a file saved by LeRobot; ConfigError if it is not a calibration of these motors."""
    try:
        entries = parse_json(read_text_limited(path, _MAX_BYTES))
        if not isinstance(entries, dict) or set(entries) != set(names):
            had = listed(map(repr, entries), separator=", ") if isinstance(entries, dict) and entries else "none"
            raise ValueError(f"it has the motors {had}, expected are {', '.join(names)}")
        found = {name: from_plain(entries[name], MotorCalibration) for name in names}
        for name, motor in found.items():
            if not 0 <= motor.range_min < motor.range_max < COUNTS:
                raise ValueError(
                    f"the range of {name} is {motor.range_min} to {motor.range_max}, expected are two counts from 0 to "
                    f"{COUNTS - 1} that rise"
                )
            if motor.drive_mode not in (0, 1):
                raise ValueError(f"the drive_mode of {name} is {motor.drive_mode}, allowed are 0 and 1")
    except (OSError, ValueError) as error:
        raise ConfigError(
            f"This is not a calibration saved by LeRobot ({describe_error(error)}): {path}; lerobot-calibrate writes "
            "one, below ~/.cache/huggingface/lerobot/calibration/robots."
        ) from error
    return found
