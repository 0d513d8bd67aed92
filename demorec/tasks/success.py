"""Strict conditions of success, one function each, shared by all tasks."""

from __future__ import annotations

import math

import numpy as np

from demorec.core.geometry import Pose
from demorec.episode.episode import SuccessCheck
from demorec.episode.scene import Body, Goal
from demorec.sim.world import World

MAX_DISTANCE = 0.02
MAX_HEIGHT_ERROR = 0.004
MAX_TILT = math.radians(5.0)
MAX_SPEED = 0.01
MAX_SPIN = 0.1
MAX_DISTURBANCE = 0.02
"""How far an object that is not to be moved may end from where it was, metres."""
MIN_OPENING = 0.875
"""Share of the gripper's full opening that counts as open."""


def goal_pose(world: World, goal: Goal) -> Pose:
    """`world_from_goal` now: it moves with the body that the goal lies on."""
    return _support_pose(world, goal) @ goal.onto_from_goal


def _support_pose(world: World, goal: Goal) -> Pose:
    return world.pose(goal.onto) if goal.onto else Pose()


def resting_half_height(body: Body, pose: Pose) -> float:
    """Half the extent, metres, of the body axis that is nearest to vertical."""
    vertical = int(np.argmax(np.abs(pose.rotation[2])))
    return body.shape.extents[vertical] / 2


def tilt_of(pose: Pose) -> float:
    """Angle, rad, between the vertical and the body axis nearest to it."""
    return math.acos(min(1.0, float(np.abs(pose.rotation[2]).max())))


def lean_of(pose: Pose) -> float:
    """Angle, rad, between the vertical and the body's z axis."""
    return math.acos(max(-1.0, min(1.0, float(pose.rotation[2, 2]))))


def at_most(name: str, value: float, limit: float, unit: str) -> SuccessCheck:
    """A check that holds when value <= limit."""
    return SuccessCheck(name=name, value=float(value), limit=limit, unit=unit, passed=bool(value <= limit))


def at_least(name: str, value: float, limit: float, unit: str) -> SuccessCheck:
    """A check that holds when value >= limit."""
    return SuccessCheck(name=name, value=float(value), limit=limit, unit=unit, passed=bool(value >= limit))


def on_support(world: World, name: str, onto: str) -> bool:
    """Whether a body touches what it is meant to stand on: `onto`, or any support for a place in the world."""
    if onto:
        return world.touches(name, onto)
    return any(
        world.touches(name, body.name) for body in world.scene.bodies if body.role == "support" and body.collides
    )


def rest_checks(world: World, name: str, suffix: str = "") -> tuple[SuccessCheck, SuccessCheck]:
    """That a body moves no faster than what counts as lying still; the suffix ends the checks' names."""
    linear, angular = world.velocity(name)
    return (
        at_most(f"speed{suffix}", math.hypot(*linear.tolist()), MAX_SPEED, "m/s"),
        at_most(f"spin{suffix}", math.hypot(*angular.tolist()), MAX_SPIN, "rad/s"),
    )


def placement_checks(world: World, goal: Goal) -> tuple[SuccessCheck, ...]:
    """That one object lies at its goal: near, on its support, upright, at rest and let go.

    The names end in the object's name when the scene has more than one goal.
    """
    suffix = f":{goal.object}" if len(world.scene.goals) > 1 else ""
    pose, wanted = world.pose(goal.object), goal_pose(world, goal)
    distance = goal.distance(_support_pose(world, goal), pose)
    body = world.body(goal.object)
    # The wanted height is that of the resting face that was meant; a cube may rest on any face.
    height = wanted.position[2] + resting_half_height(body, pose) - resting_half_height(body, wanted)
    return (
        at_most(f"distance_to_goal{suffix}", distance, MAX_DISTANCE, "m"),
        at_most(f"height_error{suffix}", abs(pose.position[2] - height), MAX_HEIGHT_ERROR, "m"),
        at_least(f"on_support{suffix}", on_support(world, goal.object, goal.onto), 1.0, ""),
        # A box may rest on any face, a bottle may not.
        at_most(f"tilt{suffix}", lean_of(pose) if body.shape.mesh else tilt_of(pose), MAX_TILT, "rad"),
        *rest_checks(world, goal.object, suffix),
        at_most(f"touched_by_robot{suffix}", world.touches_robot(goal.object), 0.0, ""),
    )


def gripper_open_check(world: World) -> SuccessCheck:
    """That the hand has let go."""
    return at_least("gripper_width", world.arm.gripper_width(), MIN_OPENING * world.robot.gripper.open_width, "m")
