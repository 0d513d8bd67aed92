"""Tasks with cubes: stacking two or three, unstacking, and lining up three."""

from __future__ import annotations

import math

from demorec.episode.episode import SuccessCheck
from demorec.sim.world import World
from demorec.tasks.base import Layout, TableTask, on_table, onto_cube, random_cube, start_and_target
from demorec.tasks.furniture import cube, green_target, mark
from demorec.tasks.sampling import WORKSPACE, Region, Sampler
from demorec.tasks.success import at_most

INNER = Region(x=(0.38, 0.60), y=(-0.22, 0.22))
"""Region of towers: the hand must reach above them."""
ROW = Region(x=(0.40, 0.60), y=(-0.10, 0.10))
ROW_CUBES = Region(x=(0.33, 0.68), y=(-0.33, 0.33))
REACHABLE = Region(x=WORKSPACE.x, y=(-0.30, 0.30), min_radius=0.33, max_radius=0.70)
COLORS_IN_ORDER = (("red", "green", "blue"), ("green", "blue", "red"), ("blue", "red", "green"))
MAX_UNEVENNESS = 0.015


class Stack(TableTask):
    """Pick up one cube and stack it on the other.

    Task: two cubes on the table.
    Randomised: positions, yaws, sizes (3-6 cm, the lower one 4-6 cm), masses (20-200 g), frictions (0.4-1.2), which
        colour is stacked on which; the arm's initial joints.
    Success: the upper cube's centre within 2 cm of the lower one's, on it, upright within 5 degrees, at rest, not
        touched; the lower one within 2 cm of its initial position; the gripper open.
    """

    summary = "a cube onto another cube"
    wordings = (
        "stack the {moved[0]} cube on the {bases[0]} cube",
        "pick up the {moved[0]} cube and place it on top of the {bases[0]} cube",
        "put the {moved[0]} cube onto the {bases[0]} one",
    )

    def layout(self, sampler: Sampler) -> Layout:
        """Draw both cubes and the goal."""
        upper_color, lower_color = sampler.choice([("red", "blue"), ("blue", "red"), ("red", "green")])
        start = sampler.point(WORKSPACE, what="the upper cube")
        yaw = sampler.yaw()
        place = sampler.point(INNER, away_from=[start], min_distance=0.13, what="the lower cube")
        lower_yaw = sampler.yaw()
        upper = random_cube(sampler, upper_color, start, yaw, sides=(0.03, 0.06))
        lower = random_cube(sampler, lower_color, place, lower_yaw, sides=(0.04, 0.06))
        return [lower, upper], [onto_cube(upper, lower)]


class StackThree(TableTask):
    """Build a tower of three cubes.

    Task: three cubes on the table; the second is placed on the first, the third on the second.
    Randomised: positions, yaws, sizes (4-5.5 cm), masses (20-200 g), frictions (0.4-1.2), the order of the colours; the
        arm's initial joints.
    Success: each upper cube's centre within 2 cm of the one below, on it, upright within 5 degrees, at rest, not
        touched; the lowest within 2 cm of its initial position; the gripper open.
    """

    summary = "a tower of three cubes"
    wordings = (
        "stack the {moved[0]} cube on the {bases[0]} cube, then the {moved[1]} cube on the {moved[0]} cube",
        "build a tower: {bases[0]} at the bottom, {moved[0]} in the middle, {moved[1]} on top",
    )

    def layout(self, sampler: Sampler) -> Layout:
        """Draw the cubes and the goals."""
        colors = sampler.choice([("red", "green", "blue"), ("blue", "red", "green"), ("green", "blue", "red")])
        base = sampler.point(INNER, what="the lowest cube")
        base_yaw = sampler.yaw()
        second = sampler.point(WORKSPACE, away_from=[base], min_distance=0.13, what="the middle cube")
        second_yaw = sampler.yaw()
        third = sampler.point(WORKSPACE, away_from=[base, second], min_distance=0.13, what="the top cube")
        third_yaw = sampler.yaw()
        cubes = [
            random_cube(sampler, color, point, yaw, sides=(0.04, 0.055))
            for color, point, yaw in zip(colors, (base, second, third), (base_yaw, second_yaw, third_yaw), strict=True)
        ]
        return cubes, [onto_cube(cubes[1], cubes[0]), onto_cube(cubes[2], cubes[1])]


class Unstack(TableTask):
    """Take the upper cube off the lower one and place it on the mark.

    Task: a cube on top of another, a square mark on the table.
    Randomised: the tower's position and yaw, the upper cube's pose on the lower (5 mm, any yaw), sizes (3-6 cm, the
        lower one 4-6 cm), masses (20-200 g), frictions (0.4-1.2), the mark's position and yaw; the arm's initial
        joints.
    Success: the cube's centre within 2 cm of the mark's, on the table, upright within 5 degrees, at rest, not touched;
        the lower cube within 2 cm of its initial position; the gripper open.
    """

    summary = "a cube off another cube and onto a mark"
    wordings = (
        "take the red cube off the blue cube and place it on the green target",
        "unstack the red cube and put it on the green target",
        "lift the red cube from the blue one and set it on the green target",
    )

    def layout(self, sampler: Sampler) -> Layout:
        """Draw the tower, the mark and the goal."""
        tower, tower_yaw, place, place_yaw = start_and_target(sampler, "the tower", region=INNER)
        lower = random_cube(sampler, "blue", tower, tower_yaw, sides=(0.04, 0.06))
        upper = cube(
            "red_cube",
            (tower[0] + sampler.uniform(-0.005, 0.005), tower[1] + sampler.uniform(-0.005, 0.005)),
            sampler.uniform(-math.pi, math.pi),
            side=sampler.uniform(0.03, 0.06),
            mass=sampler.uniform(0.02, 0.2),
            friction=sampler.uniform(0.4, 1.2),
            color_name="red",
            z=lower.shape.size[2] + 5e-4,
        )
        return [green_target(place, place_yaw), lower, upper], [on_table(upper, place, place_yaw)]


class LineUp(TableTask):
    """Put three cubes on three marks in a row.

    Task: three cubes on the table, three marks in a straight row at even distance.
    Randomised: the cubes' positions, yaws, sizes (3-4.5 cm), masses (20-200 g), frictions (0.4-1.2) and order; the
        row's middle, direction and spacing (12-15 cm); the arm's initial joints.
    Success: each cube's centre within 2 cm of its mark's, on the table, upright within 5 degrees, at rest, not touched;
        the two gaps equal within 1.5 cm and the middle cube within 1.5 cm of the line; the gripper open.
    """

    summary = "three cubes in a row at even distance"
    wordings = (
        "line up the cubes on the yellow marks: {moved[0]}, {moved[1]}, {moved[2]}",
        "put the {moved[0]}, {moved[1]} and {moved[2]} cubes in a row on the marks",
    )

    def layout(self, sampler: Sampler) -> Layout:
        """Draw the row, the cubes and the goals."""
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
            starts.append(sampler.point(ROW_CUBES, away_from=[*starts, *places], min_distance=0.11, what="a cube"))
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
        """Check that each cube is on its mark, and the row straight and even."""
        first, second, third = (world.pose(goal.object).position[:2] for goal in world.scene.goals)
        gaps = math.dist(first, second), math.dist(second, third)
        length = math.dist(first, third)
        across = (third[0] - first[0]) * (second[1] - first[1]) - (third[1] - first[1]) * (second[0] - first[0])
        return (
            *super().evaluate(world),
            at_most("uneven_gaps", abs(gaps[0] - gaps[1]), MAX_UNEVENNESS, "m"),
            at_most("off_the_line", abs(float(across)) / length, MAX_UNEVENNESS, "m"),
        )
