"""A cube goes to a target mark on the table."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from demorec.geometry import Pose
from demorec.scene.episode import SuccessCheck
from demorec.scene.robot import RobotSpec
from demorec.scene.scene import Goal, Scene
from demorec.sim.world import World
from demorec.tasks.base import Task
from demorec.tasks.checks import gripper_open_check, placement_checks
from demorec.tasks.furniture import cube, mark, robot_at_origin, table_and_floor
from demorec.tasks.recovery import finish
from demorec.tasks.sampling import WORKSPACE, Sampler, wording
from demorec.tasks.script import Step
from demorec.tasks.skills import Expert


class PickPlace(Task):
    """Pick up the cube and place it on the mark.

    Task: one cube, one square mark on the table.
    Randomised: the cube's place (0.30 x 0.50 m), yaw, size (3-6 cm), mass (20-200 g) and friction (0.4-1.2); the
        mark's place and yaw, 12 cm from the cube or more; the arm's initial joints (0.05 rad).
    Success: the cube's centre within 2 cm of the mark's, on the table, upright within 5 degrees, at rest
        (1 cm/s, 0.1 rad/s), not touched, the gripper open.
    """

    summary = "a cube to a target mark on the table"

    def sample_scene(self, robot: RobotSpec, sampler: Sampler) -> Scene:
        """Draw a layout."""
        start = sampler.point(WORKSPACE, what="the cube")
        cube_yaw = sampler.yaw()
        place = sampler.point(WORKSPACE, away_from=[start], min_distance=0.12, what="the target")
        place_yaw = sampler.yaw()
        side = sampler.named("cube_side", 0.03, 0.06)
        body = cube(
            "red_cube",
            start,
            cube_yaw,
            side=side,
            mass=sampler.named("cube_mass", 0.02, 0.2),
            friction=sampler.named("cube_friction", 0.4, 1.2),
            color_name="red",
        )
        target = mark("green_target", place, place_yaw, side=0.08, color_name="green")
        goal = Goal(object="red_cube", onto="", onto_from_goal=Pose.from_yaw((*place, side / 2), place_yaw))
        return Scene(
            robot=robot_at_origin(robot, sampler),
            bodies=(*table_and_floor(), target, body),
            goals=(goal,),
        )

    def instruction(self, scene: Scene, rng: np.random.Generator) -> str:
        """What to do, in words."""
        goal = scene.goals[0]
        color = scene.body(goal.object).color_name
        target = next(body for body in scene.bodies if body.role == "target")
        return wording(
            rng,
            "pick up the {color} cube and place it on the {mark} target",
            "put the {color} cube on the {mark} target",
            "move the {color} cube to the {mark} target",
            color=color,
            mark=target.color_name,
        )

    def script(self, expert: Expert) -> Iterator[Step]:
        """One pick-and-place."""
        for goal in expert.world.scene.goals:
            yield from expert.pick_and_place(goal)

    def resume(self, expert: Expert) -> Iterator[Step]:
        """On from where the cube is."""
        yield from finish(expert, expert.world.scene.goals)

    def evaluate(self, world: World) -> tuple[SuccessCheck, ...]:
        """The cube lies on the mark and the hand has let go."""
        placed = [check for goal in world.scene.goals for check in placement_checks(world, goal)]
        return (*placed, gripper_open_check(world))
