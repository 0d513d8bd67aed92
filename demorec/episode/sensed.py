"""The numbers of observations as rows, and what of them datasets have only when they are asked for it by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from demorec.core.geometry import Array
from demorec.episode.episode import Observation, SimulatedColumns
from demorec.robots.robot import RobotSpec


@dataclass(frozen=True, kw_only=True, eq=False)
class ObservationRows:
    """The numbers of T observations; shapes and units as in `demorec.episode.episode.Observation`."""

    joint_position: Array  # (T, n_joints)
    joint_velocity: Array  # (T, n_joints)
    gripper_width: Array  # (T,)
    base_from_tcp: Array  # (T, 7)
    object_poses: Mapping[str, Array]  # name -> (T, 7), world_from_object
    joint_effort: Array | None = None  # (T, n_joints)
    contact_force: Array | None = None  # (T,)
    wrench: Array | None = None  # (T, 6)

    @classmethod
    def of_columns(cls, columns: SimulatedColumns, rows: NDArray[np.intp] | slice = slice(None)) -> ObservationRows:
        """Those of a recorded episode, or of some of its frames."""
        return cls(
            joint_position=columns.joint_position[rows],
            joint_velocity=columns.joint_velocity[rows],
            gripper_width=columns.gripper_width[rows],
            base_from_tcp=columns.base_from_tcp[rows],
            object_poses={name: poses[rows] for name, poses in columns.object_poses.items()},
            joint_effort=columns.joint_effort[rows],
            contact_force=columns.contact_force[rows],
            wrench=None if columns.wrench is None else columns.wrench[rows],
        )

    @classmethod
    def of_observation(cls, observation: Observation) -> ObservationRows:
        """One observation, as T = 1."""
        return cls(
            joint_position=observation.joint_position[np.newaxis],
            joint_velocity=observation.joint_velocity[np.newaxis],
            gripper_width=np.array([observation.gripper_width]),
            base_from_tcp=observation.base_from_tcp.vector()[np.newaxis],
            object_poses={name: pose.vector()[np.newaxis] for name, pose in observation.object_poses.items()},
            joint_effort=observation.joint_effort[np.newaxis],
            contact_force=np.array([observation.contact_force]),
            wrench=None if observation.wrench is None else observation.wrench[np.newaxis],
        )


@dataclass(frozen=True, kw_only=True)
class SensedFeature:
    """A sensed quantity that datasets have only when they are asked for it by name.

    Attributes:
        meaning: In words, with units and coordinate frame.
        names: Of its elements.
        values: (T, D) or (T,) of T observations; None where it was not sensed.
    """

    meaning: str
    names: Callable[[RobotSpec], tuple[str, ...]]
    values: Callable[[ObservationRows, RobotSpec], Array | None]


SENSED: Mapping[str, SensedFeature] = {
    "observation.effort": SensedFeature(
        meaning="motor torques of the arm's joints (N m)",
        names=lambda robot: tuple(f"{joint}.effort" for joint in robot.arm_joints),
        values=lambda rows, robot: None if rows.joint_effort is None else rows.joint_effort[:, : len(robot.arm_joints)],
    ),
    "observation.contact_force": SensedFeature(
        meaning="sum of the normal forces on the fingers (N)",
        names=lambda robot: ("gripper.force",),
        values=lambda rows, robot: rows.contact_force,
    ),
    "observation.wrench": SensedFeature(
        meaning="force (N) and torque (N m) with which the arm holds the hand, along the axes of the hand's link",
        names=lambda robot: tuple(f"hand.{kind}.{axis}" for kind in ("force", "torque") for axis in ("x", "y", "z")),
        values=lambda rows, robot: rows.wrench,
    ),
}
"""Feature -> what it is. A row here makes a sensed quantity exportable (`--features`)."""
