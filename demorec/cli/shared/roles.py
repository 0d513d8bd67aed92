"""Flags by which users name features' roles and an arm's servos, for commands that read third-party data."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import UseAppendAction, arg

from demorec.core.errors import ConfigError
from demorec.robots.motors import Motors, MotorUnits

if TYPE_CHECKING:
    from demorec.episode.roles import NamedRoles

_Features = Annotated[tuple[str, ...], UseAppendAction, arg(metavar="FEATURE")]
_GripperNames = Annotated[tuple[str, ...], UseAppendAction, arg(metavar="NAME")]


@dataclass(frozen=True, kw_only=True)
class RoleFlags:
    """Features whose role the user names, in data that demorec did not simulate."""

    state: _Features = ()
    """Feature with the robot's state (auto: by its name); repeat the flag to join several."""
    action: _Features = ()
    """Feature with the action (auto: by its name); repeat the flag to join several."""
    gripper: _GripperNames = ()
    """Feature or state element with the gripper's position (auto: by its name)."""

    @property
    def named(self) -> NamedRoles:
        """The flags as `NamedRoles`."""
        from demorec.episode.roles import NamedRoles

        return NamedRoles(state=self.state, action=self.action, gripper=self.gripper)


NamedByFlags = Annotated[RoleFlags, arg(name="")]


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
