"""Cubes onto cubes: two or three high, and off again."""

from __future__ import annotations

import numpy as np

from demorec.tasks.furniture import cube, mark
from demorec.tasks.placing import Layout, TableTask, on_table, onto_cube, random_cube
from demorec.tasks.sampling import WORKSPACE, Region, Sampler

INNER = Region(x=(0.38, 0.60), y=(-0.22, 0.22))
"""Where a tower stands: the hand must get above it."""


class Stack(TableTask):
    """Pick up one cube and stack it on the other.

    Task: two cubes on the table.
    Randomised: places, yaws, sizes (3-6 cm, the lower one 4-6 cm), masses (20-200 g), frictions (0.4-1.2), which
        colour is stacked on which; the arm's initial joints.
    Success: the upper cube's centre within 2 cm of the lower one's, on it, upright within 5 degrees, at rest, not
        touched; the lower one within 2 cm of where it was; the gripper open.
    """

    summary = "a cube onto another cube"
    wordings = (
        "stack the {moved[0]} cube on the {bases[0]} cube",
        "pick up the {moved[0]} cube and place it on top of the {bases[0]} cube",
        "put the {moved[0]} cube onto the {bases[0]} one",
    )

    def layout(self, sampler: Sampler) -> Layout:
        """Draw it."""
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

    Task: three cubes on the table; the second goes onto the first, the third onto the second.
    Randomised: places, yaws, sizes (4-5.5 cm), masses (20-200 g), frictions (0.4-1.2), the order of the colours;
        the arm's initial joints.
    Success: each upper cube's centre within 2 cm of the one below, on it, upright within 5 degrees, at rest, not
        touched; the lowest within 2 cm of where it was; the gripper open.
    """

    summary = "a tower of three cubes"
    wordings = (
        "stack the {moved[0]} cube on the {bases[0]} cube, then the {moved[1]} cube on the {moved[0]} cube",
        "build a tower: {bases[0]} at the bottom, {moved[0]} in the middle, {moved[1]} on top",
    )

    def layout(self, sampler: Sampler) -> Layout:
        """Draw it."""
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

    Task: a cube that stands on another, a square mark on the table.
    Randomised: the tower's place and yaw, how the upper cube lies on the lower (5 mm, any yaw), sizes (3-6 cm, the
        lower one 4-6 cm), masses (20-200 g), frictions (0.4-1.2), the mark's place and yaw; the arm's initial joints.
    Success: the cube's centre within 2 cm of the mark's, on the table, upright within 5 degrees, at rest, not
        touched; the lower cube within 2 cm of where it was; the gripper open.
    """

    summary = "a cube off another cube and onto a mark"
    wordings = (
        "take the red cube off the blue cube and place it on the green target",
        "unstack the red cube and put it on the green target",
        "lift the red cube from the blue one and set it on the green target",
    )

    def layout(self, sampler: Sampler) -> Layout:
        """Draw it."""
        tower = sampler.point(INNER, what="the tower")
        tower_yaw = sampler.yaw()
        place = sampler.point(WORKSPACE, away_from=[tower], min_distance=0.14, what="the target")
        place_yaw = sampler.yaw()
        lower = random_cube(sampler, "blue", tower, tower_yaw, sides=(0.04, 0.06))
        upper = cube(
            "red_cube",
            (tower[0] + sampler.uniform(-0.005, 0.005), tower[1] + sampler.uniform(-0.005, 0.005)),
            sampler.uniform(-np.pi, np.pi),
            side=sampler.uniform(0.03, 0.06),
            mass=sampler.uniform(0.02, 0.2),
            friction=sampler.uniform(0.4, 1.2),
            color_name="red",
            z=lower.shape.size[2] + 5e-4,
        )
        target = mark("green_target", place, place_yaw, side=0.08, color_name="green")
        return [target, lower, upper], [on_table(upper, place, place_yaw)]
