"""Three cubes in a row at even distance."""

from __future__ import annotations

import math

from demorec.episode.episode import SuccessCheck
from demorec.sim.world import World
from demorec.tasks.furniture import mark
from demorec.tasks.placing import Layout, TableTask, on_table, random_cube
from demorec.tasks.sampling import WORKSPACE, Region, Sampler
from demorec.tasks.success import at_most

ROW = Region(x=(0.40, 0.60), y=(-0.10, 0.10))
CUBES = Region(x=(0.33, 0.68), y=(-0.33, 0.33))
REACHABLE = Region(x=WORKSPACE.x, y=(-0.30, 0.30), min_radius=0.33, max_radius=0.70)
COLORS_IN_ORDER = (("red", "green", "blue"), ("green", "blue", "red"), ("blue", "red", "green"))
MAX_UNEVENNESS = 0.015


class LineUp(TableTask):
    """Put three cubes on three marks in a row.

    Task: three cubes on the table, three marks in a straight row at even distance.
    Randomised: the cubes' places, yaws, sizes (3-4.5 cm), masses (20-200 g), frictions (0.4-1.2) and order; the
        row's middle, direction and spacing (12-15 cm); the arm's initial joints.
    Success: each cube's centre within 2 cm of its mark's, on the table, upright within 5 degrees, at rest, not
        touched; the two gaps equal within 1.5 cm and the middle cube within 1.5 cm of the line; the gripper open.
    """

    summary = "three cubes in a row at even distance"
    wordings = (
        "line up the cubes on the yellow marks: {moved[0]}, {moved[1]}, {moved[2]}",
        "put the {moved[0]}, {moved[1]} and {moved[2]} cubes in a row on the marks",
    )

    def layout(self, sampler: Sampler) -> Layout:
        """Draw it."""
        spacing = sampler.uniform(0.12, 0.15)
        direction = sampler.uniform(-math.pi / 2, math.pi / 2)
        along = (math.cos(direction), math.sin(direction))

        def row_at(middle: tuple[float, float]) -> list[tuple[float, float]]:
            return [(middle[0] + k * spacing * along[0], middle[1] + k * spacing * along[1]) for k in (-1, 0, 1)]

        middle = sampler.point(
            ROW, accept=lambda point: all(REACHABLE.contains(place) for place in row_at(point)), what="the row"
        )
        places = row_at(middle)
        starts: list[tuple[float, float]] = []
        for _ in places:
            starts.append(sampler.point(CUBES, away_from=[*starts, *places], min_distance=0.11, what="a cube"))
        colors = sampler.choice(COLORS_IN_ORDER)
        cubes = [
            random_cube(sampler, color, start, sampler.yaw(), sides=(0.03, 0.045))
            for color, start in zip(colors, starts, strict=True)
        ]
        marks = [
            mark(f"mark_{k + 1}", place, direction, side=0.06, color_name="yellow") for k, place in enumerate(places)
        ]
        goals = [on_table(body, place, direction) for body, place in zip(cubes, places, strict=True)]
        return [*marks, *cubes], goals

    def evaluate(self, world: World) -> tuple[SuccessCheck, ...]:
        """Each cube on its mark, the row straight and even."""
        first, second, third = (world.pose(goal.object).position[:2] for goal in world.scene.goals)
        gaps = math.dist(first, second), math.dist(second, third)
        length = math.dist(first, third)
        across = (third[0] - first[0]) * (second[1] - first[1]) - (third[1] - first[1]) * (second[0] - first[0])
        return (
            *super().evaluate(world),
            at_most("uneven_gaps", abs(gaps[0] - gaps[1]), MAX_UNEVENNESS, "m"),
            at_most("off_the_line", abs(float(across)) / length, MAX_UNEVENNESS, "m"),
        )
