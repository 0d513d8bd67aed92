"""What tasks made of pick-and-place goals share: their script, their strict conditions, common bodies."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import ClassVar

import numpy as np

from demorec.core.geometry import Pose
from demorec.episode.episode import SuccessCheck
from demorec.episode.scene import Body, Goal, Scene
from demorec.robots.robot import RobotSpec
from demorec.sim.arm import arm_kinematics
from demorec.sim.world import World
from demorec.tasks.base import Task
from demorec.tasks.furniture import cube, robot_at_origin, table_and_floor, words_for
from demorec.tasks.reach import serves
from demorec.tasks.recovery import finish, put_back
from demorec.tasks.sampling import WORKSPACE, Region, Sampler, wording
from demorec.tasks.script import Behaviour, Step
from demorec.tasks.skills import Expert
from demorec.tasks.success import MAX_DISTURBANCE, at_most, gripper_open_check, placement_checks

TALLEST = 0.07
"""Height, metres, above which no thing on the table reaches."""
HAND_AND_THING = 0.07
"""Half the width of a finger and half the diagonal of a thing, metres, with a little air between."""

Layout = tuple[Sequence[Body], Sequence[Goal]]
"""What is on the table, and the goals."""


class PlacingTask(Task):
    """A task whose goals are served one after the other, in the order of the scene.

    Success: every goal's object lies at its goal (`placement_checks`), whatever was not to be moved is where it
    was (2 cm), and the gripper is open.
    """

    def is_in_reach(self, scene: Scene, robot: RobotSpec, behaviour: Behaviour) -> bool:
        """All that the goals ask of it, one after the other."""
        return serves(scene, scene.goals, robot, behaviour)

    def script(self, expert: Expert) -> Iterator[Step]:
        """One pick-and-place per goal."""
        for goal in expert.world.scene.goals:
            yield from expert.pick_and_place(goal)

    def resume(self, expert: Expert) -> Iterator[Step]:
        """What is left of the goals, then bystanders that were moved back to where they lay."""
        world = expert.world
        yield from finish(expert, world.scene.goals)
        moved = [
            put_back(world, check.name.partition(":")[2]) for check in undisturbed_checks(world) if not check.passed
        ]
        if moved:
            yield from finish(expert, (*moved, *world.scene.goals))

    def evaluate(self, world: World) -> tuple[SuccessCheck, ...]:
        """Goals, bystanders, gripper."""
        placed = [check for goal in world.scene.goals for check in placement_checks(world, goal)]
        return (*placed, *undisturbed_checks(world), gripper_open_check(world))


class TableTask(PlacingTask):
    """A placing task of things on the table behind which the robot stands."""

    wordings: ClassVar[tuple[str, ...]]
    """Of the instruction: `thing` is what the first goal moves; `moved`, `bases` and `targets` are the colours of what
    the goals move, of what they put it on or into, and of marks and trays."""

    @abstractmethod
    def layout(self, sampler: Sampler) -> Layout:
        """Draw what is on the table, and the goals; SceneError when none is found."""

    def sample_scene(self, robot: RobotSpec, sampler: Sampler) -> Scene:
        """Draw a layout."""
        scale = robot.task_scale
        if scale != 1.0:
            sampler.is_free = _beside_the_hand(robot, joint_spread=sampler.ranges.number("joint_spread"))
        bodies, goals = self.layout(sampler)
        if scale != 1.0:
            bodies = [_scaled_body(body, scale) for body in bodies]
            goals = [_scaled_goal(goal, scale) for goal in goals]
        return Scene(robot=robot_at_origin(robot, sampler), bodies=(*table_and_floor(), *bodies), goals=tuple(goals))

    def instruction(self, scene: Scene, rng: np.random.Generator) -> str:
        """One of the wordings, filled in."""
        moved = [scene.body(goal.object) for goal in scene.goals]
        return wording(
            rng,
            *self.wordings,
            thing=words_for(moved[0]),
            moved=[body.color_name for body in moved],
            bases=[scene.body(goal.onto).color_name for goal in scene.goals if goal.onto],
            targets=[body.color_name for body in scene.bodies if body.role == "target"],
        )


def _beside_the_hand(robot: RobotSpec, *, joint_spread: float) -> Callable[[tuple[float, float]], bool]:
    """Whether a thing at a point (x, y) of a layout, before it is scaled, is not where the open hand is at the start.

    Arms of scale 1 rest with the hand above everything; a small one may rest with it among the things.

    Args:
        robot: Whose hand it is.
        joint_spread: By how much each joint may be off the home configuration, rad.
    """
    home, gripper, scale = arm_kinematics(robot).forward(np.array(robot.home_q)), robot.gripper, robot.task_scale
    off = joint_spread * math.hypot(*home.position.tolist())
    if home.position[2] - gripper.finger_depth - off > scale * TALLEST:
        return lambda point: True
    # Seen from above, in the hand's axes: a jaw opens to one side of the TCP.
    middle = home.apply(np.array([0.0, gripper.object_offset(gripper.open_width), 0.0]))
    half = np.array([scale * HAND_AND_THING, gripper.open_width / 2 + scale * HAND_AND_THING]) + off

    def is_free(point: tuple[float, float]) -> bool:
        away = np.array([scale * point[0], scale * point[1], middle[2]]) - middle
        return bool((np.abs(away @ home.rotation)[:2] > half).any())

    return is_free


def _scaled_body(body: Body, scale: float) -> Body:
    """A body with its lengths and its mass multiplied: a small hand takes small things."""
    shape = body.shape
    is_file = shape.kind in ("mesh", "urdf")
    shape = replace(
        shape, size=tuple(scale * v for v in shape.size), scale=scale * shape.scale if is_file else shape.scale
    )
    return replace(body, shape=shape, mass=scale * body.mass, world_from_body=_scaled_pose(body.world_from_body, scale))


def _scaled_goal(goal: Goal, scale: float) -> Goal:
    area = goal.area
    if area is not None:
        least_x, least_y, most_x, most_y = (scale * end for end in area)
        area = (least_x, least_y, most_x, most_y)
    return replace(goal, onto_from_goal=_scaled_pose(goal.onto_from_goal, scale), area=area)


def _scaled_pose(pose: Pose, scale: float) -> Pose:
    return Pose(position=scale * pose.position, quat_xyzw=pose.quat_xyzw)


def undisturbed_checks(world: World) -> tuple[SuccessCheck, ...]:
    """That each movable body without a goal of its own still lies where it lay."""
    moved = {goal.object for goal in world.scene.goals}
    return tuple(
        at_most(
            f"disturbed:{body.name}",
            math.dist(world.pose(body.name).position[:2], body.world_from_body.position[:2]),
            MAX_DISTURBANCE,
            "m",
        )
        for body in world.scene.movable
        if body.name not in moved
    )


def start_and_target(
    sampler: Sampler, what: str, *, apart: float = 0.14, region: Region = WORKSPACE
) -> tuple[tuple[float, float], float, tuple[float, float], float]:
    """Point and yaw at which a thing lies, and those of its target, at least `apart` metres away.

    Args:
        sampler: Draws them.
        what: The thing, in words for an error.
        apart: Metres.
        region: Where it lies; its target is anywhere in the workspace.
    """
    start, yaw = sampler.point(region, what=what), sampler.yaw()
    place = sampler.point(WORKSPACE, away_from=[start], min_distance=apart, what="the target")
    return start, yaw, place, sampler.yaw()


def random_cube(
    sampler: Sampler, color_name: str, point: tuple[float, float], yaw: float, *, sides: tuple[float, float]
) -> Body:
    """A cube on the table with drawn side (m), mass (20-200 g) and friction (0.4-1.2)."""
    return cube(
        f"{color_name}_cube",
        point,
        yaw,
        side=sampler.named("cube_side", *sides),
        mass=sampler.named("cube_mass", 0.02, 0.2),
        friction=sampler.named("cube_friction", 0.4, 1.2),
        color_name=color_name,
    )


def onto_cube(object_: Body, base: Body, *, yaw: float = 0.0) -> Goal:
    """The goal that one cube stands centred on another."""
    height = (base.shape.size[2] + object_.shape.size[2]) / 2
    return Goal(object=object_.name, onto=base.name, onto_from_goal=Pose.from_yaw((0.0, 0.0, height), yaw))


def on_table(object_: Body, point: tuple[float, float], yaw: float, *, yaw_symmetry: int = 4) -> Goal:
    """The goal that an object stands upright at a point of the table."""
    pose = Pose.from_yaw(np.array([point[0], point[1], object_.shape.extents[2] / 2]), yaw)
    return Goal(object=object_.name, onto="", onto_from_goal=pose, yaw_symmetry=yaw_symmetry)
