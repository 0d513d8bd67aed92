"""Scene of the tutorial that this project grew from: a big cube as table, a robot next to it, a small cube."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import ClassVar

import numpy as np

from demorec.core.geometry import Pose
from demorec.episode.episode import SuccessCheck
from demorec.episode.scene import Body, Goal, RobotPlacement, Scene, Shape
from demorec.render.cameras import FRONT, TOP, WORKSPACE, CameraPreset
from demorec.robots.robot import RobotSpec
from demorec.sim.world import World
from demorec.tasks.base import Task
from demorec.tasks.furniture import COLORS, floor
from demorec.tasks.grasping import grasps_of, hand_yaw, raised
from demorec.tasks.reach import Reach, within
from demorec.tasks.sampling import Sampler, wording
from demorec.tasks.script import Behaviour, Step, lasting, steady_width
from demorec.tasks.skills import Expert
from demorec.tasks.success import MAX_TILT, at_least, at_most, gripper_open_check, rest_checks, tilt_of

ROBOT_SCALE = 1.3
BASE = (1.0, 0.0, 0.1)
CUBE_SIDE = 0.05 * 1.5
CUBE_START = (1.0, 1.0, 0.1)
TABLE_SIDE = 0.5
ABOVE_CUBE = 0.25
SINKS = 0.005
"""Depth, metres, below its nominal height to which the cube must be in reach; it comes to rest 1.4 mm lower."""
RELEASE_POINT = (0.16, 0.14, 0.80)
MAX_FALL_SECONDS = 3.0
REST_SECONDS = 0.17


class Tutorial(Task):
    """Carry the cube over the table and drop it.

    Task: cube.urdf scaled by 0.5 is fixed at the origin as a table; the Panda, scaled by 1.3, is at [1, 0, 0.1]; a red
        cube_small.urdf scaled by 1.5 is at [1, 1, 0.1]. The steps are the tutorial's: open the hand, move to 25 cm
        above the cube with the hand down, close, hold by a fixed constraint, carry to 80 cm above the table, open,
        release.
    Randomised: the cube's position (an arc of 0.5 rad, 8 cm wide, within the tutorial's point), yaw, the arm's initial
        joints; nothing with `--fixed`.
    Success: the cube on the table, at rest (1 cm/s, 0.1 rad/s), on a face (5 degrees), not touched, the gripper open.

    Changes, since the listing cannot work as printed: unscaled, the cube is 1.0 m from the base and the hand-down reach
    is 0.80 m, so only the scale of the full listing (1.3) is used. Closing 25 cm above the cube grips nothing, so a
    step "descend" precedes "close". The cube (75 mm) is too wide for the unscaled hand, and fits the scaled one (104
    mm). "80 cm above the table" is measured from its origin (55 cm above its top), over the half nearer to the robot:
    higher or farther is out of reach.
    """

    summary = "the tutorial's scene: a cube dropped onto a table from 80 cm, held by a constraint"
    has_fixed_layout = True
    camera_presets: ClassVar[Mapping[str, CameraPreset]] = {
        "front": replace(FRONT, eye=(-1.35, 1.75, 1.55), target=(0.66, 0.38, 0.42), fov_y=math.radians(36.0)),
        "top": replace(TOP, eye=(0.5, 0.45, 2.6), target=(0.5, 0.45, 0.0), up=(0.0, 1.0, 0.0)),
        "workspace": replace(
            WORKSPACE,
            eye=(-0.75, 1.75, 2.0),
            target=(0.42, 0.44, 0.30),
            fov_y=math.radians(33.0),
            fov_x=math.radians(45.0),
        ),
    }

    @classmethod
    def refusal(cls, robot: RobotSpec) -> str:
        """Refuse small arms: the lengths are the listing's."""
        return "" if robot.task_scale == 1.0 else "its table and cube have fixed sizes, which a small arm cannot reach"

    def sample_scene(self, robot: RobotSpec, sampler: Sampler) -> Scene:
        """Draw a layout, or return the tutorial's own."""
        angle, radius, yaw = math.pi / 2, 1.0, 0.0
        spread = sampler.ranges.number("joint_spread")
        if sampler.fixed:
            spread = 0.0
        else:
            angle += sampler.placement(-0.25, 0.25)
            radius = sampler.placement(0.90, 0.98)  # 1.0 is beyond the reach of the iiwa
            yaw = sampler.yaw()
        # Turned towards the side of cube and table.
        joints = (robot.home_q[0] + 2.0, *robot.home_q[1:])
        table = Body(
            name="table",
            role="support",
            shape=Shape(kind="urdf", file="cube.urdf", scale=0.5, size=(TABLE_SIDE,) * 3),
            world_from_body=Pose(),
            rgba=(0.80, 0.70, 0.57, 1.0),
        )
        place = (BASE[0] + radius * math.cos(angle), BASE[1] + radius * math.sin(angle), CUBE_START[2])
        cube = Body(
            name="red_cube",
            role="object",
            shape=Shape(kind="urdf", file="cube_small.urdf", scale=1.5, size=(CUBE_SIDE,) * 3),
            world_from_body=Pose.from_yaw(place, yaw),
            mass=0.1,
            lateral_friction=0.8,
            rgba=COLORS["red"],
            color_name="red",
            yaw_symmetry=4,
        )
        top = TABLE_SIDE / 2 + CUBE_SIDE / 2
        goal = Goal(
            object=cube.name,
            onto=table.name,
            onto_from_goal=Pose.from_yaw((RELEASE_POINT[0], RELEASE_POINT[1], top)),
            yaw_symmetry=0,
        )
        return Scene(
            robot=RobotPlacement(
                name=robot.name,
                world_from_base=Pose(position=np.array(BASE)),
                scale=ROBOT_SCALE,
                joint_position=tuple(q + sampler.uniform(-spread, spread) for q in joints),
                gripper_width=robot.gripper.scaled(ROBOT_SCALE).open_width,
            ),
            bodies=(floor(0.0), table, cube),
            goals=(goal,),
            hold="constraint",
        )

    def is_in_reach(self, scene: Scene, robot: RobotSpec, behaviour: Behaviour) -> bool:
        """Check a grasp of the cube at its resting position, from 25 cm above it."""
        reach, cube = Reach(scene, robot), scene.body(scene.goals[0].object)
        fallen = raised(cube.world_from_body, CUBE_SIDE / 2 - SINKS - CUBE_START[2])
        now = hand_yaw(reach.tcp(reach.start))
        grasps = grasps_of(cube, fallen, now=now, robot=robot, behaviour=behaviour)
        found = within(reach.at_all, grasps, up_to=ABOVE_CUBE)
        return any(reach.descends(grasp, by=ABOVE_CUBE, start=reach.start) for grasp in found)

    def instruction(self, scene: Scene, rng: np.random.Generator) -> str:
        """Choose a wording of the instruction."""
        return wording(rng, "drop the red cube onto the table", "carry the red cube over the table and let it drop")

    def script(self, expert: Expert) -> Iterator[Step]:
        """Yield the tutorial's steps."""
        world = expert.world
        goal = world.scene.goals[0]
        expert.phase = "open"
        yield from expert.open_gripper(max_seconds=1.0)
        grasp = expert.reachable_grasp(goal.object, above_by=ABOVE_CUBE)
        expert.phase = "above_cube"
        yield from expert.move(raised(grasp, ABOVE_CUBE), speed=0.6, free=True)
        expert.phase = "descend"
        yield from expert.move(grasp, speed=0.3)
        expert.phase = "close"
        yield from expert.set_gripper(world.robot.gripper.min_width, max_seconds=1.5, done=steady_width(world))
        expert.phase = "hold"
        yield from expert.move(raised(grasp, ABOVE_CUBE), speed=0.3)
        expert.phase = "carry"
        release = expert.reachable_place(RELEASE_POINT)
        yield from expert.move(release, speed=0.5)
        expert.phase = "release"
        # The cube must rest for some time: at the moment of landing it can be as slow as at rest. The last state has no
        # frame; so at least that one and two recorded ones are at rest.
        rests = lasting(
            lambda: all(check.passed for check in self.evaluate(world)), steps=max(3, round(REST_SECONDS * world.fps))
        )
        yield from expert.set_gripper(expert.open_width, max_seconds=MAX_FALL_SECONDS, done=rests)

    def evaluate(self, world: World) -> tuple[SuccessCheck, ...]:
        """Check that the cube is on the table."""
        name = world.scene.goals[0].object
        return (
            at_least("on_table", world.touches(name, "table"), 1.0, ""),
            *rest_checks(world, name),
            at_most("tilt", tilt_of(world.pose(name)), MAX_TILT, "rad"),
            at_most("touched_by_robot", world.touches_robot(name), 0.0, ""),
            gripper_open_check(world),
        )
