"""Recovery from an arbitrary state: the expert takes over from a policy or a person, and finishes the task.

A script begins at rest, hand open and high, objects where the layout put them. None of that is guaranteed here: the arm
may be moving, tilted or low, the gripper closed next to an object or around one, objects displaced or put down in a
wrong place. So the arm is stopped and moved to where a script can begin, and every unmet goal is served.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from demorec.episode.episode import HALT_PHASE
from demorec.episode.scene import Goal
from demorec.robots.motion import plan_joints
from demorec.sim.world import World
from demorec.tasks.grasping import hand_down, hand_yaw, is_above, nearest_first, symmetric_yaws
from demorec.tasks.reach import JOINT_SPEED
from demorec.tasks.script import ExpertFailure, Step
from demorec.tasks.skills import Expert
from demorec.tasks.success import placement_checks, resting_half_height

TAKE_OVER = "take_over"
"""Phase in which the stopped arm moves to where a script can begin."""
_STOP_SECONDS = 0.3
"""Maximum time for which the arm is held, s."""
_STOPPED = 0.05
"""Maximum joint speed, rad/s, at which the arm counts as stopped."""
_CLEARANCE = 0.03
"""Clearance, metres, of the finger tips over all objects at which the hand moves freely."""
_HEIGHTS = (0.16, 0.12, 0.08, _CLEARANCE)
"""Heights, metres above all objects, to which the hand tries to rise; it uses the first one in reach."""
_ROUNDS = 2
"""Number of passes over all goals: serving one may disturb another."""


def finish(expert: Expert, goals: Sequence[Goal]) -> Iterator[Step]:
    """Serve every goal, in order, from any state of the world, without touching those already met.

    The expert is made for the current world and does not miss on purpose. Raises ExpertFailure if an object or goal is
    out of reach, or after several attempts.
    """
    held = next((body.name for body in expert.world.scene.movable if expert.holds(body.name)), "")
    yield from _stop(expert, holding=bool(held))
    if held and expert.holds(held):
        yield from _place_held(expert, held, goals)
    begun = _begun(expert, goals)
    if begun is None and not _is_clear(expert):
        yield from _rise(expert)
    for _ in range(_ROUNDS):
        for goal in goals:
            if not is_served(expert.world, goal):
                yield from _serve(expert, goal, is_begun=goal is begun)
                begun = None
        if all(is_served(expert.world, goal) for goal in goals):
            return
    unserved = next(goal for goal in goals if not is_served(expert.world, goal))
    raise ExpertFailure(expert.phase, f"unserved_{unserved.object}")


def _begun(expert: Expert, goals: Sequence[Goal]) -> Goal | None:
    """Return the first goal to serve if the open hand is above its object and can descend directly.

    A policy that stops there is shown how to continue: rising and approaching again would contradict every
    demonstration.
    """
    goal = next((goal for goal in goals if not is_served(expert.world, goal)), None)
    if goal is None or not _is_open(expert):
        return None
    above_by = expert.world.robot.task_scale * expert.behaviour.approach_height
    grasp = expert.first_reachable(expert.grasps(goal.object), above_by)
    return goal if grasp is not None and is_above(expert.tcp(), grasp) else None


def begin_again(expert: Expert) -> Iterator[Step]:
    """Stop, release any held object, and move the hand to where a script can begin."""
    yield from _stop(expert, holding=False)
    if not _is_clear(expert):
        yield from _rise(expert)


def _serve(expert: Expert, goal: Goal, *, is_begun: bool) -> Iterator[Step]:
    """Pick and place; if the arm cannot follow a straight line from here, once more from home."""
    try:
        yield from expert.pick_and_place(goal, is_begun=is_begun)
    except ExpertFailure as error:
        if error.reason != "unreachable":
            raise
        expert.phase = TAKE_OVER
        yield from _rise(expert)
        yield from _go_home(expert)
        yield from expert.pick_and_place(goal)


def is_served(world: World, goal: Goal) -> bool:
    """Check whether an object is at its goal, at rest and released."""
    return all(check.passed for check in placement_checks(world, goal))


def put_back(world: World, name: str) -> Goal:
    """Make the goal of an object at its initial position."""
    body = world.body(name)
    return Goal(object=name, onto="", onto_from_goal=body.world_from_body, yaw_symmetry=body.yaw_symmetry)


def _stop(expert: Expert, *, holding: bool) -> Iterator[Step]:
    """Hold the arm in place until it is at rest, with the hand closed around a held object."""
    world = expert.world
    expert.phase = HALT_PHASE
    if holding:
        expert.gripper_target = world.robot.gripper.min_width
    number = len(expert.joint_target)
    expert.joint_target = world.arm.arm_position()
    for _ in range(max(1, round(_STOP_SECONDS * world.fps))):
        yield expert.step()
        _, velocity, _ = world.arm.joint_states()
        if float(np.abs(velocity[:number]).max()) < _STOPPED:
            break
    expert.phase = TAKE_OVER


def _place_held(expert: Expert, name: str, goals: Sequence[Goal]) -> Iterator[Step]:
    """Bring the held object to its goal if it is next, else to its initial position; else release it."""
    goal = put_back(expert.world, name)
    for wanted in goals:
        if wanted.object == name:
            goal = wanted
            break
        if not is_served(expert.world, wanted):
            break
    try:
        yield from expert.place(goal, is_begun=True)
    except ExpertFailure:
        expert.phase = TAKE_OVER


def _is_clear(expert: Expert) -> bool:
    """Check whether the hand is high enough to move anywhere, and open or empty (it then opens while moving)."""
    is_empty = not any(expert.holds(body.name) for body in expert.world.scene.movable)
    return (is_empty or _is_open(expert)) and expert.tcp().position[2] >= _lowest_clear(expert)


def _is_open(expert: Expert) -> bool:
    return expert.world.arm.gripper_width() > expert.open_width - 0.01


def _lowest_clear(expert: Expert) -> float:
    """Compute the TCP height, metres, at which the finger tips pass over every movable object and every goal."""
    world = expert.world
    placed = [(body, world.pose(body.name)) for body in world.scene.bodies]
    tops = [pose.position[2] + resting_half_height(body, pose) for body, pose in placed]
    return max(tops, default=0.0) + world.robot.gripper.finger_depth + _CLEARANCE


def _rise(expert: Expert) -> Iterator[Step]:
    """Open the hand and rise, straightened, above everything; if no such line can be followed, move home."""
    yield from expert.open_gripper(max_seconds=0.5)
    here = expert.tcp()
    yaws = nearest_first(symmetric_yaws(hand_yaw(here), 8), hand_yaw(here))
    lowest = _lowest_clear(expert) - _CLEARANCE
    for height in _HEIGHTS:
        for yaw in yaws[:3]:
            above = hand_down((*here.position[:2].tolist(), max(lowest + height, here.position[2])), yaw)
            if not expert.reaches(above):
                continue
            try:
                yield from expert.move(above, speed=0.3)
            except ExpertFailure:
                continue
            return
    yield from _go_home(expert)


def _go_home(expert: Expert) -> Iterator[Step]:
    """Move joint by joint to the home configuration."""
    home = np.array(expert.world.robot.home_q)
    dt = 1.0 / expert.world.fps
    for joint_target in plan_joints(
        start=expert.joint_target, goal=home, speed=JOINT_SPEED, limits=expert.reach.limits, dt=dt
    ):
        expert.joint_target = joint_target
        yield expert.step()
