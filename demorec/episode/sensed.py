"""What is sensed beside positions and velocities: one row a quantity, and everything goes by the rows.

A row whose quantity is a stream of its own is written, read, checked for shape, plotted, and offered to datasets and
environments without any other module knowing it by name; the simulator alone has to sense it (`demorec.sim.arm`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from demorec.core.geometry import Array
from demorec.episode.episode import Observation, Trajectory
from demorec.robots.robot import RobotSpec


@dataclass(frozen=True, kw_only=True, eq=False)
class ObservationRows:
    """The numbers of T observations; shapes and units as in `demorec.episode.episode.Observation`.

    Attributes:
        sensed: Quantity of `SENSED` -> (T, ...), of those that were sensed.
    """

    joint_position: Array  # (T, n_joints)
    joint_velocity: Array  # (T, n_joints)
    gripper_width: Array  # (T,)
    base_from_tcp: Array  # (T, 7)
    object_poses: Mapping[str, Array]  # name -> (T, 7), world_from_object
    sensed: Mapping[str, Array]

    @classmethod
    def of_trajectory(cls, trajectory: Trajectory, rows: NDArray[np.intp] | slice = slice(None)) -> ObservationRows:
        """Those of a recorded episode, or of some of its frames."""
        sensed = {
            "joint_effort": trajectory.joint_effort,
            "contact_force": trajectory.contact_force,
            **trajectory.sensed,
        }
        return cls(
            joint_position=trajectory.joint_position[rows],
            joint_velocity=trajectory.joint_velocity[rows],
            gripper_width=trajectory.gripper_width[rows],
            base_from_tcp=trajectory.base_from_tcp[rows],
            object_poses={name: poses[rows] for name, poses in trajectory.object_poses.items()},
            sensed={name: values[rows] for name, values in sensed.items()},
        )

    @classmethod
    def of_observation(cls, observation: Observation) -> ObservationRows:
        """One observation, as T = 1."""
        force = np.array(observation.contact_force)
        sensed = {"joint_effort": observation.joint_effort, "contact_force": force, **observation.sensed}
        return cls(
            joint_position=observation.joint_position[np.newaxis],
            joint_velocity=observation.joint_velocity[np.newaxis],
            gripper_width=np.array([observation.gripper_width]),
            base_from_tcp=observation.base_from_tcp.vector()[np.newaxis],
            object_poses={name: pose.vector()[np.newaxis] for name, pose in observation.object_poses.items()},
            sensed={name: values[np.newaxis] for name, values in sensed.items()},
        )


@dataclass(frozen=True, kw_only=True)
class Plot:
    """A plot of some elements, those after the ones of the plot before.

    Attributes:
        curves: What playback calls them.
        title: With the unit.
        names: Of its lines; None: those of the arm's joints.
    """

    curves: str
    title: str
    names: tuple[str, ...] | None = None


@dataclass(frozen=True, kw_only=True)
class Sensed:
    """A sensed quantity, which datasets have only when they are asked for it by name.

    One with a topic has messages of its own, one a frame; the others are part of those of /joint_states or /gripper.

    Attributes:
        quantity: What observations and columns call it.
        meaning: In words, with units and coordinate frame.
        names: Of the D elements that datasets have: the first ones of the quantity.
        units: Of these elements.
        plots: Of all D elements, in order.
        topic: Where its own messages are.
        components: Names of their elements, as tables of frames have them.
        layout: Of them: "wrench" is a force and a torque on the hand, along the axes of its link
            (geometry_msgs/WrenchStamped); "array" is any vector (std_msgs/Float64MultiArray).
    """

    quantity: str
    meaning: str
    names: Callable[[RobotSpec], tuple[str, ...]]
    units: Callable[[RobotSpec], tuple[str, ...]]
    plots: tuple[Plot, ...]
    topic: str = ""
    components: Callable[[RobotSpec], tuple[str, ...]] = lambda robot: ()
    layout: Literal["wrench", "array"] = "array"

    def values(self, sensed: Mapping[str, Array], robot: RobotSpec) -> Array | None:
        """(T, D) of quantities (T, ...); None where it was not sensed."""
        found = sensed.get(self.quantity)
        return None if found is None else found.reshape(len(found), -1)[:, : len(self.names(robot))]


SENSED: Mapping[str, Sensed] = {
    "observation.effort": Sensed(
        quantity="joint_effort",
        meaning="motor torques of the arm's joints (N m)",
        names=lambda robot: tuple(f"{joint}.effort" for joint in robot.arm_joints),
        units=lambda robot: ("N m",) * len(robot.arm_joints),
        plots=(Plot(curves="effort", title="joint effort (N m)"),),
    ),
    "observation.contact_force": Sensed(
        quantity="contact_force",
        meaning="sum of the normal forces on the fingers (N)",
        names=lambda robot: ("gripper.force",),
        units=lambda robot: ("N",),
        plots=(Plot(curves="force", title="contact force (N)", names=("contact force",)),),
    ),
    # As a force-torque sensor at the hand's mount feels it: about the origin of the hand's link, nothing taken off; the
    # weight and the inertia of hand, fingers and what they hold are in it.
    "observation.wrench": Sensed(
        quantity="wrench",
        meaning="force (N) and torque (N m) with which the arm holds the hand, along the axes of the hand's link",
        names=lambda robot: tuple(f"hand.{kind}.{axis}" for kind in ("force", "torque") for axis in ("x", "y", "z")),
        units=lambda robot: ("N", "N", "N", "N m", "N m", "N m"),
        plots=(
            Plot(curves="hand force", title="force on the hand (N)", names=("x", "y", "z")),
            Plot(curves="hand torque", title="torque on the hand (N m)", names=("x", "y", "z")),
        ),
        topic="/wrench",
        components=lambda robot: ("fx", "fy", "fz", "tx", "ty", "tz"),
        layout="wrench",
    ),
}
"""Feature -> what it is."""

STREAMS: Mapping[str, Sensed] = {row.quantity: row for row in SENSED.values() if row.topic}
"""Quantity -> the row of one that has messages of its own."""
