"""The flags by which commands that read other people's data let the user name features' roles and an arm's servos."""

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
    """Features whose role the user names, of data that demorec did not simulate."""

    state: _Features = ()
    """Feature that is the robot's state (auto: by its name); given several times, they are joined."""
    action: _Features = ()
    """Feature that is the action (auto: by its name); given several times, they are joined."""
    gripper: _GripperNames = ()
    """Feature, or element of the state, that is a gripper (auto: by its name)."""

    @property
    def named(self) -> NamedRoles:
        """The flags for code that reads the data."""
        from demorec.episode.roles import NamedRoles

        return NamedRoles(state=self.state, action=self.action, gripper=self.gripper)


NamedByFlags = Annotated[RoleFlags, arg(name="")]


@dataclass(frozen=True, kw_only=True)
class MotorFlags:
    """The servos of a real arm, whose values LeRobot recorded as state and action."""

    motor_units: MotorUnits | None = None
    """For a dataset that LeRobot recorded with an SO-101 (shoulder_pan.pos to gripper.pos): whether its joints are in
    degrees, LeRobot's default, or scaled to -100..100 of their ranges. The dataset itself does not say so."""
    calibration: Path | None = None
    """With --motor-units: the file that LeRobot saved of the arm's servos (auto: an arm that is built as its URDF
    says)."""

    @property
    def named(self) -> Motors | None:
        """The servos; None without --motor-units. Raises ConfigError for a calibration that is none of theirs."""
        from demorec.robots.so101 import SO101_FOLLOWER

        if self.motor_units is not None:
            return SO101_FOLLOWER.motors(self.motor_units, self.calibration)
        if self.calibration is not None:
            raise ConfigError("--calibration belongs to --motor-units.")
        return None


MotorsByFlags = Annotated[MotorFlags, arg(name="")]
