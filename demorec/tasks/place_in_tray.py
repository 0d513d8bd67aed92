"""A cube goes into a tray."""

from __future__ import annotations

import numpy as np

from demorec.core.geometry import Pose
from demorec.episode.scene import Goal
from demorec.tasks.placing import TRAY_FLOOR, Layout, TableTask, random_cube, tray
from demorec.tasks.sampling import Region, Sampler

CUBES = Region(x=(0.35, 0.65), y=(-0.25, 0.15))
TRAYS = Region(x=(0.40, 0.50), y=(0.36, 0.40))
"""Of the tray's middle: its far corner must be within the reach of a hand that points down."""


class PlaceInTray(TableTask):
    """Pick up the cube and put it into the tray.

    Task: one cube on the table, one shallow tray at the robot's left.
    Randomised: the cube's place (0.30 x 0.40 m), yaw, size (3-6 cm), mass (20-200 g), friction (0.4-1.2) and the
        tray's place and yaw (within 0.25 rad); where in the tray (3 cm about its middle); the arm's initial joints.
    Success: the cube's centre within 2 cm of the place, on the tray's floor, upright within 5 degrees, at rest, not
        touched, the gripper open.
    """

    summary = "a cube into a tray"
    wordings = (
        "pick up the {moved[0]} cube and put it into the {bases[0]} tray",
        "put the {moved[0]} cube in the {bases[0]} tray",
        "place the {moved[0]} cube inside the {bases[0]} tray",
    )

    def layout(self, sampler: Sampler) -> Layout:
        """Draw it."""
        point = sampler.point(CUBES, what="the cube")
        yaw = sampler.yaw()
        body = random_cube(sampler, "red", point, yaw, sides=(0.03, 0.06))
        target = tray(
            "blue_tray",
            sampler.point(TRAYS, what="the tray"),
            sampler.uniform(-0.25, 0.25),
            color_name="blue",
        )
        offset = (sampler.uniform(-0.03, 0.03), sampler.uniform(-0.02, 0.02))
        height = TRAY_FLOOR + body.shape.size[2] / 2
        goal = Goal(
            object=body.name,
            onto=target.name,
            onto_from_goal=Pose.from_yaw((*offset, height), sampler.uniform(-np.pi, np.pi)),
        )
        return [target, body], [goal]
