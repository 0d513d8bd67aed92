"""Cubes into the trays of their colours."""

from __future__ import annotations

from dataclasses import replace

from demorec.core.geometry import Pose
from demorec.episode.scene import Body, Goal
from demorec.tasks.placing import TRAY_FLOOR, Layout, TableTask, random_cube, tray
from demorec.tasks.sampling import Region, Sampler

CUBES = Region(x=(0.36, 0.65), y=(-0.19, 0.19))
TRAY_Y = 0.37
SLOTS = (-0.065, 0.065)
"""Along a tray's long side, metres: the open fingers must fit between a cube and its neighbour."""
COLOR_PAIRS = (("red", "blue"), ("green", "yellow"), ("red", "yellow"), ("blue", "green"))


class SortByColor(TableTask):
    """Put every cube into the tray of its colour.

    Task: two to four cubes of two colours, two trays, one on either side.
    Randomised: how many cubes, which colours, which tray is left; places, yaws, sizes (3-4.5 cm), masses
        (20-200 g), frictions (0.4-1.2); the trays' places along the table; the arm's initial joints.
    Success: each cube within 2 cm of its place in the tray of its colour, on the floor of the tray, upright within
        5 degrees, at rest, not touched; the gripper open.
    """

    summary = "two to four cubes into the trays of their colours"
    wordings = (
        "sort the cubes into the trays of their colors",
        "put every {targets[0]} cube into the {targets[0]} tray and every {targets[1]} cube into the {targets[1]} tray",
        "sort the {targets[0]} and {targets[1]} cubes by color",
    )

    def layout(self, sampler: Sampler) -> Layout:
        """Draw it."""
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
        return [*trays, *cubes], goals
