"""A simulated episode as LeRobot would have recorded it of the real arm: an episode that has no scene."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np

from demorec.core.errors import ConfigError
from demorec.datasets.episode import DONE, REWARD, SUCCESS
from demorec.datasets.lerobot.options import ExportOptions
from demorec.datasets.lerobot.robots import IN_MOTOR_UNITS
from demorec.episode.episode import Columns
from demorec.episode.features import ACTION, EE_POSE, STATE, VELOCITY
from demorec.episode.info import Feature
from demorec.mcap import Recording, open_recording

NO_PLACE = (VELOCITY, EE_POSE, REWARD, DONE, SUCCESS)
"""Features that LeRobot does not record of a real arm."""


class MotorRecording(Recording):
    """A recording whose numbers are those of the real arm's motors, whose scene nobody knows.

    Args:
        path: Of the file.

    Raises:
        ConfigError: It is of a robot that LeRobot does not have.
        RecordingError: As `Recording`.
    """

    def __init__(self, path: str | Path) -> None:
        super().__init__(path)
        simulated = self.info
        arm = IN_MOTOR_UNITS.get(simulated.robot_name) if simulated.simulation is not None else None
        if arm is None:
            self.close()
            raise ConfigError(
                f"Motor units are asked for, which simulated episodes of {', '.join(IN_MOTOR_UNITS)} have, not those "
                f"of {simulated.robot_name or 'an unnamed robot'}: leave --motor-units out: {path}"
            )
        self._arm, self._spec = arm, simulated.robot
        units = tuple(motor.unit for motor in arm.motors)
        joints = (*self._spec.arm_joints, "")  # the gripper is no angle here
        self.info = replace(
            simulated,
            format_version=0,
            robot_name=arm.robot_type,
            urdf=self.description(),
            features=tuple(Feature(name=name, names=arm.names, units=units, joints=joints) for name in (STATE, ACTION)),
            origin=f"simulated: {simulated.task}, seed {simulated.root_seed}, configuration {simulated.config_digest}",
            simulation=None,
        )

    def columns(self) -> Columns:
        """As of `Recording`: state and action in degrees and per cent."""
        return self._converted

    @cached_property
    def _converted(self) -> Columns:
        with Recording(self.path) as simulated:  # which knows its scene
            columns = simulated.columns()
        jaw = self._spec.gripper.joint_position(columns.action_gripper)
        targets = np.concatenate([columns.action_joint_target, jaw], axis=1)
        values = {STATE: self._arm.values(columns.joint_position), ACTION: self._arm.values(targets)}
        return replace(columns, features=values, stamps=dict.fromkeys(values, columns.time_ns))


def recording_of(path: Path, options: ExportOptions) -> Recording:
    """What a dataset with these options is made of; opens it.

    Raises:
        ConfigError: Motor units are asked for, and it has none.
        RecordingError: It is no recording, or damaged.
    """
    return MotorRecording(path) if options.motor_units else open_recording(path)
