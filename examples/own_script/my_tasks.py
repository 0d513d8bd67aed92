"""Your own script: two finger tips push a cube to a mark, without grasping it.

cd examples/own_script
generate-dataset --task my_tasks:PushToMark --num-episodes 10 --out recordings/push
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from demorec.api import (
    Expert,
    ExpertFailure,
    Region,
    RobotSpec,
    Sampler,
    Scene,
    Step,
    SuccessCheck,
    Task,
    World,
    hand_down,
    hand_yaw,
    mark,
    on_table,
    placement_checks,
    raised,
    random_cube,
    robot_at_origin,
    steady_width,
    symmetric_yaws,
    table_and_floor,
    wording,
)

STARTS = Region(x=(0.40, 0.48), y=(-0.12, 0.12))
"""Start region of the cube: metres in front of the robot's base and to its left."""
CLEARANCE = 0.05
"""Distance between the cube and the hand before the push, metres."""
PUSH_SPEED = 0.06
"""Speed of the hand, m/s: slow enough that the cube stops with it."""


class PushToMark(Task):
    """Push the cube straight onto the mark.

    Task: one cube, one mark 10 to 15 cm ahead of one of its faces.
    Randomised: the cube's place, yaw (0.4 rad to both sides), size, mass and friction; how far the mark is; the arm's
        initial joints.
    Success: the cube within 2 cm of the mark's centre, on the table, upright, at rest, and not touched any more.
    """

    summary = "a cube pushed to a mark"

    def sample_scene(self, robot: RobotSpec, sampler: Sampler) -> Scene:
        """Draw a layout."""
        start = sampler.point(STARTS, what="the cube")
        yaw = sampler.uniform(-0.4, 0.4)
        distance = sampler.uniform(0.10, 0.15)
        place = (start[0] + distance * math.cos(yaw), start[1] + distance * math.sin(yaw))
        cube = random_cube(sampler, "red", start, yaw, sides=(0.04, 0.06))
        target = mark("green_target", place, yaw, side=0.09, color_name="green")
        return Scene(
            robot=robot_at_origin(robot, sampler),
            bodies=(*table_and_floor(), target, cube),
            goals=(on_table(cube, place, yaw),),
        )

    def instruction(self, scene: Scene, rng: np.random.Generator) -> str:
        """Describe the task in words."""
        return wording(rng, "push the red cube onto the green target", "slide the red cube to the green target")

    def script(self, expert: Expert) -> Iterator[Step]:
        """Set the finger tips apart, lower them behind the cube, push it to the mark, and retreat."""
        world, goal = expert.world, expert.world.scene.goals[0]
        start, end = world.pose(goal.object).position, goal.onto_from_goal.position
        yaw = math.atan2(end[1] - start[1], end[0] - start[0])
        ahead = np.array([math.cos(yaw), math.sin(yaw), 0.0])
        side = world.body(goal.object).shape.size[0]
        behind = start - (side / 2 + CLEARANCE) * ahead

        expert.phase = "open"
        # Two tips next to each other steer the cube; it would turn around a single one.
        yield from expert.set_gripper(side / 2, max_seconds=1.0, done=steady_width(world))
        expert.phase = "approach"
        # The fingers look the same from both sides, so the hand takes the turn that the arm can reach.
        hands = (hand_down(behind, turned) for turned in symmetric_yaws(yaw, 2))
        hand = next((hand for hand in hands if expert.reaches(hand)), None)
        if hand is None:
            raise ExpertFailure(expert.phase, "unreachable")
        yield from expert.move(raised(hand, expert.behaviour.approach_height), speed=0.5, free=True)
        expert.phase = "descend"
        yield from expert.move(hand, speed=0.25)

        expert.phase = "push"
        beyond = hand_down(end, hand_yaw(hand))
        yield from expert.move(
            beyond,
            speed=PUSH_SPEED,
            settle=False,
            until=lambda: float((end - world.pose(goal.object).position) @ ahead) < 0.002,
        )
        expert.phase = "retreat"
        away = hand_down(expert.tcp().position - CLEARANCE * ahead, hand_yaw(hand))
        yield from expert.move(away, speed=0.15)
        yield from expert.move(raised(away, 0.1), speed=0.3)

    def evaluate(self, world: World) -> tuple[SuccessCheck, ...]:
        """Check that the cube is on the mark and free of the hand; the hand's opening does not matter here."""
        return placement_checks(world, world.scene.goals[0])
