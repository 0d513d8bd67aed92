"""Sensors of a simulated arm other than its joints and gripper: one row each.

Recordings list each sensor as a feature with a stream, from which they are read, checked, shown and exported. A new
sensor therefore needs a row here, and its test.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

from demorec.core.geometry import Array
from demorec.episode.info import OBSERVATION, Feature, SensorStream
from demorec.robots.robot import RobotSpec
from demorec.sim.arm import Arm


@dataclass(frozen=True, kw_only=True, eq=False)
class Sensor:
    """A vector measured at each frame.

    Attributes:
        quantity: Key in `Observation.sensed`; the feature is "observation." plus this, the topic "/" plus this.
        meaning: Description with units and coordinate frame.
        elements: Robot -> name of each element -> its unit ("" if unitless).
        sense: PyBullet client and its robot -> values at the end of the last physics step, (D,).
        layout: Message type, as in `SensorStream`.
        frame: Robot -> link along the axes of which a wrench's vectors are given.
    """

    quantity: str
    meaning: str
    elements: Callable[[RobotSpec], Mapping[str, str]]
    sense: Callable[[Any, Arm], Array]
    layout: Literal["wrench", "array"] = "array"
    frame: Callable[[RobotSpec], str] = lambda robot: ""

    def feature(self, robot: RobotSpec) -> Feature:
        """Describe the sensor of a robot."""
        elements = self.elements(robot)
        return Feature(
            name=OBSERVATION + self.quantity,
            names=tuple(elements),
            units=tuple(elements.values()),
            source=self.meaning,
            stream=SensorStream(topic=f"/{self.quantity}", layout=self.layout, frame=self.frame(robot)),
        )


_WRENCH = {
    "hand.force.x": "N",
    "hand.force.y": "N",
    "hand.force.z": "N",
    "hand.torque.x": "N m",
    "hand.torque.y": "N m",
    "hand.torque.z": "N m",
}

SENSORS: tuple[Sensor, ...] = (
    # As measured by a force-torque sensor at the hand's mount: about the origin of the hand's link, without
    # compensation. It includes the weight and inertia of hand, fingers and held object.
    Sensor(
        quantity="wrench",
        meaning="force (N) and torque (N m) with which the arm holds the hand, along the axes of the hand's link",
        elements=lambda robot: _WRENCH,
        sense=lambda client, arm: arm.hand_wrench(),
        layout="wrench",
        frame=lambda robot: robot.hand_link,
    ),
)
