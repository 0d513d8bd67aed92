"""Interface of tasks, and those made of pick-and-place goals: script, strict success conditions, common bodies."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import ClassVar

import numpy as np

from demorec.core.geometry import Pose
from demorec.episode.episode import SuccessCheck
from demorec.episode.scene import Body, Goal, Scene
from demorec.render.cameras import CameraPreset
from demorec.robots.robot import RobotSpec
from demorec.sim.arm import arm_kinematics
from demorec.sim.world import World
from demorec.tasks.furniture import cube, robot_at_origin, table_and_floor, words_for
from demorec.tasks.reach import serves
from demorec.tasks.recovery import begin_again, finish, is_served, put_back
from demorec.tasks.sampling import WORKSPACE, Region, Sampler, wording
from demorec.tasks.script import Behaviour, Step
from demorec.tasks.skills import Expert
from demorec.tasks.success import MAX_DISTURBANCE, at_most, gripper_open_check, placement_checks

TALLEST = 0.07
"""Maximum height of objects on the table, metres."""
HAND_AND_THING = 0.07
"""Half the width of a finger plus half the diagonal of an object, metres, with a small margin."""

Layout = tuple[Sequence[Body], Sequence[Goal]]
"""Objects on the table, and the goals."""


class Task(ABC):
    """A task to demonstrate: a random layout, an instruction, a script and strict success conditions.

    A task is stateless: `sample_scene` puts everything into the scene, and the other methods read it from there, so
    that one instance serves many episodes.
    """

    summary: ClassVar[str]
    """One line for `demorec list tasks`."""
    has_fixed_layout: ClassVar[bool] = False
    """Whether `--fixed` selects one exact layout instead of a random one."""
    shelves: ClassVar[tuple[str, ...]] = ()
    """Rows of `OBJECTS` that it draws from unless --objects names others; empty if it has its own objects."""
    draws_distractors: ClassVar[bool] = False
    """Whether `sample_scene` itself adds the number of distractors given by the ranges."""
    camera_presets: ClassVar[Mapping[str, CameraPreset]] = {}
    """Camera name -> preset that replaces the table's, for scenes outside the usual view."""

    @classmethod
    def refusal(cls, robot: RobotSpec) -> str:
        """Return why a robot cannot do the task, in words; "" if it may."""
        del robot
        return ""

    @abstractmethod
    def sample_scene(self, robot: RobotSpec, sampler: Sampler) -> Scene:
        """Draw a layout without cameras. SceneError if none is found."""

    def is_in_reach(self, scene: Scene, robot: RobotSpec, behaviour: Behaviour) -> bool:
        """Check whether the arm can do the task in this layout; if not, another one is drawn.

        `robot` is at the scene's scale.
        """
        del scene, robot, behaviour
        return True

    @abstractmethod
    def instruction(self, scene: Scene, rng: np.random.Generator) -> str:
        """Return the instruction, in words."""

    @abstractmethod
    def script(self, expert: Expert) -> Iterator[Step]:
        """Yield the control steps of the task; the world has advanced when the generator resumes."""

    def resume(self, expert: Expert) -> Iterator[Step]:
        """Yield the remaining control steps from any state of the world; `expert` is made for that state.

        The default releases everything and runs the script from its beginning, unless the scene's goals are met
        already. Tasks that consist of their goals continue from the current state (`demorec.tasks.recovery.finish`).
        """
        yield from begin_again(expert)
        goals = expert.world.scene.goals
        if not goals or not all(is_served(expert.world, goal) for goal in goals):
            yield from self.script(expert)

    @abstractmethod
    def evaluate(self, world: World) -> tuple[SuccessCheck, ...]:
        """Evaluate the success conditions now."""


class PlacingTask(Task):
    """A task that serves its goals one after the other, in the order of the scene.

    Success: every goal's object is at its goal (`placement_checks`), other objects are within 2 cm of their initial
        positions, and the gripper is open.
    """

    def is_in_reach(self, scene: Scene, robot: RobotSpec, behaviour: Behaviour) -> bool:
        """Check whether the arm reaches everything that the goals require, in order."""
        return serves(scene, scene.goals, robot, behaviour)

    def script(self, expert: Expert) -> Iterator[Step]:
        """Yield the steps of one pick-and-place per goal."""
        for goal in expert.world.scene.goals:
            yield from expert.pick_and_place(goal)

    def resume(self, expert: Expert) -> Iterator[Step]:
        """Yield the steps of the remaining goals, then of moving displaced bystanders back."""
        world = expert.world
        yield from finish(expert, world.scene.goals)
        moved = [
            put_back(world, check.name.partition(":")[2]) for check in undisturbed_checks(world) if not check.passed
        ]
        if moved:
            yield from finish(expert, (*moved, *world.scene.goals))

    def evaluate(self, world: World) -> tuple[SuccessCheck, ...]:
        """Check goals, bystanders and gripper."""
        placed = [check for goal in world.scene.goals for check in placement_checks(world, goal)]
        return (*placed, *undisturbed_checks(world), gripper_open_check(world))


class TableTask(PlacingTask):
    """A placing task with objects on the table in front of the robot."""

    wordings: ClassVar[tuple[str, ...]]
    """Wordings of the instruction. `thing` is the first goal's object; `moved`, `bases` and `targets` are the colours
    of the goals' objects, of their supports or containers, and of marks and trays."""

    @abstractmethod
    def layout(self, sampler: Sampler) -> Layout:
        """Draw the objects on the table, and the goals; SceneError if no layout is found."""

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
        """Fill in one of the wordings."""
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
    """Make a check that a point (x, y) of an unscaled layout is clear of the open hand at the start.

    Arms of scale 1 rest with the hand above everything; a small one may rest with it among the objects, each joint up
    to `joint_spread` rad from the home configuration.
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
    """Scale a body's lengths and its mass, since a small hand handles small objects."""
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
    """Check that each movable body without a goal is still at its initial position."""
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
    """Draw point and yaw of an object in a region, and those of its target in the workspace, `apart` metres away.

    `what` names the object in error messages.
    """
    start, yaw = sampler.point(region, what=what), sampler.yaw()
    place = sampler.point(WORKSPACE, away_from=[start], min_distance=apart, what="the target")
    return start, yaw, place, sampler.yaw()


def random_cube(
    sampler: Sampler, color_name: str, point: tuple[float, float], yaw: float, *, sides: tuple[float, float]
) -> Body:
    """Make a cube on the table with drawn side (m), mass (20-200 g) and friction (0.4-1.2)."""
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
    """Make the goal of a cube centred on another."""
    height = (base.shape.size[2] + object_.shape.size[2]) / 2
    return Goal(object=object_.name, onto=base.name, onto_from_goal=Pose.from_yaw((0.0, 0.0, height), yaw))


def on_table(object_: Body, point: tuple[float, float], yaw: float, *, yaw_symmetry: int = 4) -> Goal:
    """Make the goal of an object standing upright at a point of the table."""
    pose = Pose.from_yaw(np.array([point[0], point[1], object_.shape.extents[2] / 2]), yaw)
    return Goal(object=object_.name, onto="", onto_from_goal=pose, yaw_symmetry=yaw_symmetry)
