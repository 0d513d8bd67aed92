"""The servos of a real arm, as commands that read its datasets let the user name them."""

from __future__ import annotations

from pathlib import Path

from demorec.core.errors import ConfigError
from demorec.robots.motors import Motors, MotorUnits
from demorec.robots.so101 import SO101_FOLLOWER


def named_motors(units: MotorUnits | None, calibration: Path | None) -> Motors | None:
    """Those of --motor-units and --calibration, None without; ConfigError for a calibration that is none of theirs."""
    if units is not None:
        return SO101_FOLLOWER.motors(units, calibration)
    if calibration is not None:
        raise ConfigError("--calibration belongs to --motor-units.")
    return None
