"""Strict success conditions, one function each, shared by all tasks."""

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
"""Maximum displacement of an object that is not to be moved, metres."""
MIN_OPENING = 0.875
"""Minimum ratio of the gripper's full opening at which it counts as open."""


def goal_pose(world: World, goal: Goal) -> Pose:
    """Compute the current `world_from_goal`: it moves with the body that supports the goal."""
    return _support_pose(world, goal) @ goal.onto_from_goal


def _support_pose(world: World, goal: Goal) -> Pose:
    return world.pose(goal.onto) if goal.onto else Pose()


def resting_half_height(body: Body, pose: Pose) -> float:
    """Compute half the extent, metres, of the body axis nearest to vertical."""
    vertical = int(np.argmax(np.abs(pose.rotation[2])))
    return body.shape.extents[vertical] / 2


def tilt_of(pose: Pose) -> float:
    """Compute the angle, rad, between the vertical and the body axis nearest to it."""
    return math.acos(min(1.0, float(np.abs(pose.rotation[2]).max())))


def lean_of(pose: Pose) -> float:
    """Compute the angle, rad, between the vertical and the body's z axis."""
    return math.acos(max(-1.0, min(1.0, float(pose.rotation[2, 2]))))


def at_most(name: str, value: float, limit: float, unit: str) -> SuccessCheck:
    """Make a check that passes if value <= limit."""
    return SuccessCheck(name=name, value=float(value), limit=limit, unit=unit, passed=bool(value <= limit))


def at_least(name: str, value: float, limit: float, unit: str) -> SuccessCheck:
    """Make a check that passes if value >= limit."""
    return SuccessCheck(name=name, value=float(value), limit=limit, unit=unit, passed=bool(value >= limit))


def on_support(world: World, name: str, onto: str) -> bool:
    """Check whether a body touches its intended support: `onto`, or any support for a goal in the world."""
    if onto:
        return world.touches(name, onto)
    return any(
        world.touches(name, body.name) for body in world.scene.bodies if body.role == "support" and body.collides
    )


def rest_checks(world: World, name: str, suffix: str = "") -> tuple[SuccessCheck, SuccessCheck]:
    """Check that a body is slow enough to count as at rest; the suffix ends the checks' names."""
    linear, angular = world.velocity(name)
    return (
        at_most(f"speed{suffix}", math.hypot(*linear.tolist()), MAX_SPEED, "m/s"),
        at_most(f"spin{suffix}", math.hypot(*angular.tolist()), MAX_SPIN, "rad/s"),
    )


def placement_checks(world: World, goal: Goal) -> tuple[SuccessCheck, ...]:
    """Check that one object is at its goal: near, on its support, upright, at rest and released.

    The names end in the object's name if the scene has more than one goal.
    """
    suffix = f":{goal.object}" if len(world.scene.goals) > 1 else ""
    pose, wanted = world.pose(goal.object), goal_pose(world, goal)
    distance = goal.distance(_support_pose(world, goal), pose)
    body = world.body(goal.object)
    # The target height refers to the intended resting face; a cube may rest on any face.
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
    """Check that the hand is open."""
    return at_least("gripper_width", world.arm.gripper_width(), MIN_OPENING * world.robot.gripper.open_width, "m")
