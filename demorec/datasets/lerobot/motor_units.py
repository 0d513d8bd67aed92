"""A simulated episode as LeRobot would have recorded it of the real arm: an episode that has no scene."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np

from demorec.core.errors import ConfigError, RecordingError
from demorec.datasets.episode import DONE, REWARD, SUCCESS
from demorec.datasets.lerobot.options import ExportOptions
from demorec.datasets.lerobot.robots import IN_MOTOR_UNITS, motor_features
from demorec.episode.episode import Table, Trajectory
from demorec.episode.features import ACTION, EE_POSE, STATE, VELOCITY
from demorec.episode.info import NOT_SIMULATED
from demorec.episode.simulated import scene_of
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
        described = self.info
        arm = IN_MOTOR_UNITS.get(described.robot_name) if scene_of(described) is not None else None
        if arm is None:
            self.close()
            raise ConfigError(
                f"Motor units are asked for, which simulated episodes of {', '.join(IN_MOTOR_UNITS)} have, not those "
                f"of {described.robot_name or 'an unnamed robot'}: leave --motor-units out: {path}"
            )
        simulation = described.simulated
        self._motors, self._spec = arm.motors(units, calibration), simulation.robot
        self.info = replace(
            described,
            robot_name=arm.robot_type,
            urdf=self.description(),
            features=motor_features(self._motors),
            origin=(
                f"simulated: {simulation.task}, seed {simulation.root_seed}, configuration {simulation.config_digest}"
            ),
            simulation=None,
        )

    def trajectory(self) -> Trajectory:
        """Refuse: nobody knows what was simulated. Raises RecordingError."""
        raise RecordingError(f"{NOT_SIMULATED}: {self.path}")

    @cached_property
    def _table(self) -> Table:
        with Recording(self.path) as simulated:  # which knows its scene
            trajectory, table = simulated.trajectory(), simulated.table()
        jaw = self._spec.gripper.joint_position(trajectory.action_gripper)
        targets = np.concatenate([trajectory.action_joint_target, jaw], axis=1)
        values = {STATE: self._motors.values(trajectory.joint_position), ACTION: self._motors.values(targets)}
        return replace(table, features=values, stamps=dict.fromkeys(values, table.time_ns))


def recording_of(path: Path, options: ExportOptions) -> Recording:
    """What a dataset with these options is made of; opens it.

    Raises:
        ConfigError: Motor units are asked for, and it has none, or not by this calibration.
        RecordingError: It is no recording, or damaged.
    """
    if options.motor_units is None:
        return open_recording(path)
    return MotorRecording(path, options.motor_units, options.calibration)
