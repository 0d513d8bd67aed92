"""Simulated episodes in a real arm's motor units, as LeRobot would record them: without a scene."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from demorec.core.errors import ConfigError
from demorec.datasets.episode import DONE, REWARD, SUCCESS, ExportEpisode
from demorec.datasets.lerobot.options import ExportOptions
from demorec.datasets.lerobot.robots import IN_MOTOR_UNITS, motor_features
from demorec.episode.episode import Table
from demorec.episode.features import ACTION, EE_POSE, STATE, VELOCITY
from demorec.episode.info import EpisodeInfo
from demorec.episode.simulated import scene_of
from demorec.mcap import Recording
from demorec.robots.motors import Motors

NO_PLACE = (VELOCITY, EE_POSE, REWARD, DONE, SUCCESS)
"""Features that LeRobot does not record from a real arm."""


def export_episode(recording: Recording, options: ExportOptions) -> ExportEpisode[ExportOptions]:
    """Select the frames, features and images of a recording for a dataset with these options.

    Raises:
        ConfigError: Options that the recording does not support, or a calibration that does not fit the arm's servos.
        RecordingError: The recording is damaged.
    """
    if options.motor_units is None:
        return ExportEpisode(recording, options)
    name = recording.info.robot_name
    if scene_of(recording.info) is None or name not in IN_MOTOR_UNITS:
        raise ConfigError(
            f"Motor units exist for simulated episodes of {', '.join(IN_MOTOR_UNITS)}, not for those "
            f"of {name or 'an unnamed robot'}: leave out --motor-units: {recording.path}"
        )
    motors = IN_MOTOR_UNITS[name].motors(options.motor_units, options.calibration)
    info, read_table = _info_of_arm(recording, motors), partial(_motor_table, recording, motors)
    return ExportEpisode(recording, options, info=info, read_table=read_table)


def _info_of_arm(recording: Recording, motors: Motors) -> EpisodeInfo:
    """Describe the episode without its scene."""
    simulation = recording.info.simulated
    return replace(
        recording.info,
        robot_name=motors.robot_type,
        urdf=recording.description(),
        features=motor_features(motors),
        origin=f"simulated: {simulation.task}, seed {simulation.root_seed}, configuration {simulation.config_digest}",
        simulation=None,
    )


def _motor_table(recording: Recording, motors: Motors) -> Table:
    """Convert state and action to motor units."""
    trajectory, table = recording.trajectory(), recording.table()
    jaw = recording.info.simulated.robot.gripper.joint_position(trajectory.action_gripper)
    targets = np.concatenate([trajectory.action_joint_target, jaw], axis=1)
    values = {STATE: motors.values(trajectory.joint_position), ACTION: motors.values(targets)}
    return replace(table, features=values, stamps=dict.fromkeys(values, table.time_ns))
