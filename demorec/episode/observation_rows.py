"""Numbers of several observations at once, measured now or recorded."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from demorec.core.geometry import Array
from demorec.episode.episode import Observation, Trajectory
from demorec.episode.info import sensor_feature


@dataclass(frozen=True, kw_only=True, eq=False)
class ObservationRows:
    """The numbers of T observations; shapes and units as in `demorec.episode.episode.Observation`.

    Attributes:
        sensed: Feature -> (T, ...), for features that datasets have only on request.
    """

    joint_position: Array  # (T, n_joints)
    joint_velocity: Array  # (T, n_joints)
    gripper_width: Array  # (T,)
    base_from_tcp: Array  # (T, 7)
    object_poses: Mapping[str, Array]  # name -> (T, 7), world_from_object
    sensed: Mapping[str, Array]

    @classmethod
    def of_trajectory(cls, trajectory: Trajectory, rows: NDArray[np.intp] | slice = slice(None)) -> ObservationRows:
        """Take the rows of a recorded episode, or of some of its frames."""
        sensed = {
            "effort": trajectory.joint_effort,
            "contact_force": trajectory.contact_force,
            **trajectory.sensed,
        }
        return cls(
            joint_position=trajectory.joint_position[rows],
            joint_velocity=trajectory.joint_velocity[rows],
            gripper_width=trajectory.gripper_width[rows],
            base_from_tcp=trajectory.base_from_tcp[rows],
            object_poses={name: poses[rows] for name, poses in trajectory.object_poses.items()},
            sensed={sensor_feature(name): values[rows] for name, values in sensed.items()},
        )

    @classmethod
    def of_observation(cls, observation: Observation) -> ObservationRows:
        """Take one observation, as T = 1."""
        force = np.array(observation.contact_force)
        sensed = {"effort": observation.joint_effort, "contact_force": force, **observation.sensed}
        return cls(
            joint_position=observation.joint_position[np.newaxis],
            joint_velocity=observation.joint_velocity[np.newaxis],
            gripper_width=np.array([observation.gripper_width]),
            base_from_tcp=observation.base_from_tcp.vector()[np.newaxis],
            object_poses={name: pose.vector()[np.newaxis] for name, pose in observation.object_poses.items()},
            sensed={sensor_feature(name): values[np.newaxis] for name, values in sensed.items()},
        )
