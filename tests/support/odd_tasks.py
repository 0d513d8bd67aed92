"""Tasks with one fault each, for the tests of `demorec.testing`; otherwise like pick_place."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from demorec.core.geometry import Pose
from demorec.episode.scene import Scene
from demorec.robots.robot import RobotSpec
from demorec.tasks.base import Layout, on_table, random_cube
from demorec.tasks.grasping import hand_down, raised
from demorec.tasks.pick import PickPlace
from demorec.tasks.sampling import Region, Sampler
from demorec.tasks.script import Step, steady_width
from demorec.tasks.skills import Expert

_CALLS = itertools.count()


class NeverTheSame(PickPlace):
    def sample_scene(self, robot: RobotSpec, sampler: Sampler) -> Scene:
        scene = super().sample_scene(robot, sampler)
        return replace(scene, robot=replace(scene.robot, gripper_width=0.07 + 1e-6 * next(_CALLS)))


class AlwaysTheSame(PickPlace):
    def sample_scene(self, robot: RobotSpec, sampler: Sampler) -> Scene:
        return super().sample_scene(robot, Sampler(np.random.default_rng(0), ranges=sampler.ranges))


class Wordless(PickPlace):
    def instruction(self, scene: Scene, rng: np.random.Generator) -> str:
        return " "


class Aimless(PickPlace):
    def sample_scene(self, robot: RobotSpec, sampler: Sampler) -> Scene:
        return replace(super().sample_scene(robot, sampler), goals=())

    def instruction(self, scene: Scene, rng: np.random.Generator) -> str:
        return "enjoy the day"


class Crowded(PickPlace):
    def sample_scene(self, robot: RobotSpec, sampler: Sampler) -> Scene:
        scene = super().sample_scene(robot, sampler)
        (cube,) = scene.movable
        return replace(scene, bodies=(*scene.bodies, replace(cube, name="another_cube")))


class OutOfReach(PickPlace):
    def sample_scene(self, robot: RobotSpec, sampler: Sampler) -> Scene:
        scene = super().sample_scene(robot, sampler)
        return replace(scene, goals=(replace(scene.goals[0], onto_from_goal=Pose.from_yaw((1.4, 0.0, 0.02))),))


class FarAway(PickPlace):
    """The cube is out of the arm's reach in every layout."""

    def sample_scene(self, robot: RobotSpec, sampler: Sampler) -> Scene:
        scene = super().sample_scene(robot, sampler)
        (cube,) = scene.movable
        x, y, z = cube.world_from_body.position.tolist()
        cube = replace(cube, world_from_body=Pose.from_yaw((x + 0.5, y, z), 0.0))
        return replace(scene, bodies=tuple(cube if body.name == cube.name else body for body in scene.bodies))


class Wide(PickPlace):
    """The cube is up to 1.1 m from the base, largely out of any arm's reach."""

    def layout(self, sampler: Sampler) -> Layout:
        start = sampler.point(Region(x=(0.4, 1.1), y=(-0.1, 0.1), max_radius=1.2))
        body = random_cube(sampler, "red", start, sampler.yaw(), sides=(0.03, 0.06))
        return [body], [on_table(body, (0.4, 0.3), 0.0)]

    def instruction(self, scene: Scene, rng: np.random.Generator) -> str:
        return "move the cube"


class DoneAlready(PickPlace):
    def sample_scene(self, robot: RobotSpec, sampler: Sampler) -> Scene:
        scene = super().sample_scene(robot, sampler)
        (cube,) = scene.movable
        return replace(scene, goals=(replace(scene.goals[0], onto_from_goal=cube.world_from_body),))


class Idle(PickPlace):
    """Rise a little, then stop."""

    def script(self, expert: Expert) -> Iterator[Step]:
        yield from expert.move(raised(expert.tcp(), 0.02), speed=0.3)


class HeavyHanded(PickPlace):
    """Press down on the cube with closed fingers."""

    def script(self, expert: Expert) -> Iterator[Step]:
        (cube,) = expert.world.scene.movable
        expert.phase = "press"
        yield from expert.set_gripper(0.0, max_seconds=1.0, done=steady_width(expert.world))
        on_it = hand_down(expert.world.pose(cube.name).position, 0.0)
        yield from expert.move(raised(on_it, 0.1), speed=0.3)
        yield from expert.move(on_it, speed=0.1)


class Moody(PickPlace):
    """Rise by a different height each time."""

    def script(self, expert: Expert) -> Iterator[Step]:
        yield from expert.move(raised(expert.tcp(), 0.02 + 0.01 * next(_CALLS)), speed=0.3)


class Hasty(PickPlace):
    """Turn the first joint by a radian in one step."""

    def script(self, expert: Expert) -> Iterator[Step]:
        for step in expert.move(raised(expert.tcp(), 0.02), speed=0.3):
            turned = step.action.joint_target + np.array([1.0, *[0.0] * 6])
            yield step
            yield replace(step, action=replace(step.action, joint_target=turned))
