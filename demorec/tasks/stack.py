"""Cubes onto cubes: two or three high, and off again."""

from __future__ import annotations

import numpy as np

from demorec.scene.robot import RobotSpec
from demorec.scene.scene import Scene
from demorec.tasks.furniture import cube, mark, robot_at_origin, table_and_floor
from demorec.tasks.placing import PlacingTask, on_table, onto_cube, random_cube
from demorec.tasks.sampling import WORKSPACE, Region, Sampler, wording

INNER = Region(x=(0.38, 0.60), y=(-0.22, 0.22))
"""Where a tower stands: the hand must get above it."""


class Stack(PlacingTask):
    """Pick up one cube and stack it on the other.

    Task: two cubes on the table.
    Randomised: places, yaws, sizes (3-6 cm, the lower one 4-6 cm), masses (20-200 g), frictions (0.4-1.2), which
        colour is stacked on which; the arm's initial joints.
    Success: the upper cube's centre within 2 cm of the lower one's, on it, upright within 5 degrees, at rest, not
        touched; the lower one within 2 cm of where it was; the gripper open.
    """

    summary = "a cube onto another cube"

    def sample_scene(self, robot: RobotSpec, sampler: Sampler) -> Scene:
        """Draw a layout."""
        upper_color, lower_color = sampler.choice([("red", "blue"), ("blue", "red"), ("red", "green")])
        start = sampler.point(WORKSPACE, what="the upper cube")
        yaw = sampler.yaw()
        place = sampler.point(INNER, away_from=[start], min_distance=0.13, what="the lower cube")
        lower_yaw = sampler.yaw()
        upper = random_cube(sampler, upper_color, start, yaw, sides=(0.03, 0.06))
        lower = random_cube(sampler, lower_color, place, lower_yaw, sides=(0.04, 0.06))
        return Scene(
            robot=robot_at_origin(robot, sampler),
            bodies=(*table_and_floor(), lower, upper),
            goals=(onto_cube(upper, lower),),
        )

    def instruction(self, scene: Scene, rng: np.random.Generator) -> str:
        """What to do, in words."""
        goal = scene.goals[0]
        return wording(
            rng,
            "stack the {upper} cube on the {lower} cube",
            "pick up the {upper} cube and place it on top of the {lower} cube",
            "put the {upper} cube onto the {lower} one",
            upper=scene.body(goal.object).color_name,
            lower=scene.body(goal.onto).color_name,
        )


class StackThree(PlacingTask):
    """Build a tower of three cubes.

    Task: three cubes on the table; the second goes onto the first, the third onto the second.
    Randomised: places, yaws, sizes (4-5.5 cm), masses (20-200 g), frictions (0.4-1.2), the order of the colours;
        the arm's initial joints.
    Success: each upper cube's centre within 2 cm of the one below, on it, upright within 5 degrees, at rest, not
        touched; the lowest within 2 cm of where it was; the gripper open.
    """

    summary = "a tower of three cubes"

    def sample_scene(self, robot: RobotSpec, sampler: Sampler) -> Scene:
        """Draw a layout."""
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
        return Scene(
            robot=robot_at_origin(robot, sampler),
            bodies=(*table_and_floor(), *cubes),
            goals=(onto_cube(cubes[1], cubes[0]), onto_cube(cubes[2], cubes[1])),
        )

    def instruction(self, scene: Scene, rng: np.random.Generator) -> str:
        """What to do, in words."""
        first, second = scene.goals
        return wording(
            rng,
            "stack the {middle} cube on the {bottom} cube, then the {top} cube on the {middle} cube",
            "build a tower: {bottom} at the bottom, {middle} in the middle, {top} on top",
            bottom=scene.body(first.onto).color_name,
            middle=scene.body(first.object).color_name,
            top=scene.body(second.object).color_name,
        )


class Unstack(PlacingTask):
    """Take the upper cube off the lower one and place it on the mark.

    Task: a cube that stands on another, a square mark on the table.
    Randomised: the tower's place and yaw, how the upper cube lies on the lower (5 mm, any yaw), sizes (3-6 cm, the
        lower one 4-6 cm), masses (20-200 g), frictions (0.4-1.2), the mark's place and yaw; the arm's initial joints.
    Success: the cube's centre within 2 cm of the mark's, on the table, upright within 5 degrees, at rest, not
        touched; the lower cube within 2 cm of where it was; the gripper open.
    """

    summary = "a cube off another cube and onto a mark"

    def sample_scene(self, robot: RobotSpec, sampler: Sampler) -> Scene:
        """Draw a layout."""
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
        return Scene(
            robot=robot_at_origin(robot, sampler),
            bodies=(*table_and_floor(), target, lower, upper),
            goals=(on_table(upper, place, place_yaw),),
        )

    def instruction(self, scene: Scene, rng: np.random.Generator) -> str:
        """What to do, in words."""
        return wording(
            rng,
            "take the red cube off the blue cube and place it on the green target",
            "unstack the red cube and put it on the green target",
            "lift the red cube from the blue one and set it on the green target",
        )
