"""A simulated episode as LeRobot would have recorded it of the real arm: an episode that has no scene."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np

from demorec.core.errors import ConfigError
from demorec.datasets.episode import DONE, REWARD, SUCCESS
from demorec.datasets.lerobot.options import ExportOptions
from demorec.datasets.lerobot.robots import IN_MOTOR_UNITS, motor_features
from demorec.episode.episode import Columns
from demorec.episode.features import ACTION, EE_POSE, STATE, VELOCITY
from demorec.mcap import Recording, open_recording
from demorec.robots.motors import MotorUnits

NO_PLACE = (VELOCITY, EE_POSE, REWARD, DONE, SUCCESS)
"""Features that LeRobot does not record of a real arm."""


class MotorRecording(Recording):
    """A recording whose numbers are those of the real arm's motors, whose scene nobody knows.

    Args:
        path: Of the file.
        units: Of the arm's joints.
        calibration: File that LeRobot saved of the arm's servos; None: of an arm that is built as its URDF says.

    Raises:
        ConfigError: It is of a robot that LeRobot does not have, or the calibration is none of its servos.
        RecordingError: As `Recording`.
    """

    def __init__(self, path: str | Path, units: MotorUnits, calibration: Path | None = None) -> None:
        super().__init__(path)
        simulated = self.info
        arm = IN_MOTOR_UNITS.get(simulated.robot_name) if simulated.simulation is not None else None
        if arm is None:
            self.close()
            raise ConfigError(
                f"Motor units are asked for, which simulated episodes of {', '.join(IN_MOTOR_UNITS)} have, not those "
                f"of {simulated.robot_name or 'an unnamed robot'}: leave --motor-units out: {path}"
            )
        self._motors, self._spec = arm.motors(units, calibration), simulated.robot
        self.info = replace(
            simulated,
            robot_name=arm.robot_type,
            urdf=self.description(),
            features=motor_features(self._motors),
            origin=f"simulated: {simulated.task}, seed {simulated.root_seed}, configuration {simulated.config_digest}",
            simulation=None,
        )

    def columns(self) -> Columns:
        """As of `Recording`: state and action as the servos say them."""
        return self._converted

    @cached_property
    def _converted(self) -> Columns:
        with Recording(self.path) as simulated:  # which knows its scene
            columns = simulated.columns()
        jaw = self._spec.gripper.joint_position(columns.action_gripper)
        targets = np.concatenate([columns.action_joint_target, jaw], axis=1)
        values = {STATE: self._motors.values(columns.joint_position), ACTION: self._motors.values(targets)}
        return replace(columns, features=values, stamps=dict.fromkeys(values, columns.time_ns))


def recording_of(path: Path, options: ExportOptions) -> Recording:
    """What a dataset with these options is made of; opens it.

    Raises:
        ConfigError: Motor units are asked for, and it has none, or not by this calibration.
        RecordingError: It is no recording, or damaged.
    """
    if options.motor_units is None:
        return open_recording(path)
    return MotorRecording(path, options.motor_units, options.calibration)
