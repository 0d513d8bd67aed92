"""Cubes into the trays of their colours."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from demorec.geometry import Pose
from demorec.scene.robot import RobotSpec
from demorec.scene.scene import Body, Goal, Scene
from demorec.tasks.furniture import robot_at_origin, table_and_floor
from demorec.tasks.placing import TRAY_FLOOR, PlacingTask, random_cube, tray
from demorec.tasks.sampling import Region, Sampler, wording

CUBES = Region(x=(0.36, 0.65), y=(-0.19, 0.19))
TRAY_Y = 0.37
SLOTS = (-0.065, 0.065)
"""Along a tray's long side, metres: the open fingers must fit between a cube and its neighbour."""
COLOR_PAIRS = (("red", "blue"), ("green", "yellow"), ("red", "yellow"), ("blue", "green"))


class SortByColor(PlacingTask):
    """Put every cube into the tray of its colour.

    Task: two to four cubes of two colours, two trays, one on either side.
    Randomised: how many cubes, which colours, which tray is left; places, yaws, sizes (3-4.5 cm), masses
        (20-200 g), frictions (0.4-1.2); the trays' places along the table; the arm's initial joints.
    Success: each cube within 2 cm of its place in the tray of its colour, on the floor of the tray, upright within
        5 degrees, at rest, not touched; the gripper open.
    """

    summary = "two to four cubes into the trays of their colours"

    def sample_scene(self, robot: RobotSpec, sampler: Sampler) -> Scene:
        """Draw a layout."""
        colors = sampler.choice(COLOR_PAIRS)
        if sampler.uniform(0.0, 1.0) < 0.5:
            colors = (colors[1], colors[0])
        counts = sampler.choice([(1, 1), (2, 1), (1, 2), (2, 2)])
        trays = [
            tray(f"{color}_tray", (sampler.uniform(0.36, 0.44), side * TRAY_Y), 0.0, color_name=color)
            for color, side in zip(colors, (1, -1), strict=True)
        ]
        cubes: list[Body] = []
        goals: list[Goal] = []
        points: list[tuple[float, float]] = []
        for color, count, target in zip(colors, counts, trays, strict=True):
            for slot in range(count):
                point = sampler.point(CUBES, away_from=points, min_distance=0.12, what="a cube")
                points.append(point)
                body = random_cube(sampler, color, point, sampler.yaw(), sides=(0.03, 0.045))
                body = replace(body, name=f"{color}_cube_{slot + 1}")
                offset = SLOTS[slot] if count > 1 else sampler.uniform(-0.05, 0.05)
                place = (offset, sampler.uniform(-0.01, 0.01), TRAY_FLOOR + body.shape.size[2] / 2)
                cubes.append(body)
                goals.append(Goal(object=body.name, onto=target.name, onto_from_goal=Pose.from_yaw(place)))
        return Scene(
            robot=robot_at_origin(robot, sampler),
            bodies=(*table_and_floor(), *trays, *cubes),
            goals=tuple(goals),
        )

    def instruction(self, scene: Scene, rng: np.random.Generator) -> str:
        """What to do, in words."""
        colors = [body.color_name for body in scene.bodies if body.role == "target"]
        return wording(
            rng,
            "sort the cubes into the trays of their colors",
            "put every {first} cube into the {first} tray and every {second} cube into the {second} tray",
            "sort the {first} and {second} cubes by color",
            first=colors[0],
            second=colors[1],
        )
