"""Timed motions within the joint limits: straight lines of the tool centre point, or all joints at once.

A quintic time law (zero velocity and acceleration at both ends) along a straight line with slerp, or from one
configuration to another, slowed down until every joint respects its velocity and acceleration limits.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from demorec.core.geometry import Array, Pose, angle_between
from demorec.robots.kinematics import WHOLE_POSE, ArmKinematics

# Peaks of the quintic time law u^3 (10 - 15 u + 6 u^2) over unit time and distance.
PEAK_VELOCITY = 1.875
PEAK_ACCELERATION = 5.774

LINEAR_ACCELERATION = 1.5
"""Maximum linear acceleration of the TCP, m/s^2."""
ANGULAR_VELOCITY = 1.5
"""Maximum angular velocity of the TCP, rad/s."""
ANGULAR_ACCELERATION = 6.0
"""Maximum angular acceleration of the TCP, rad/s^2."""
MIN_SECONDS = 0.2
"""Minimum duration of a motion, s."""
_ROUNDS = 5
"""Maximum number of times that a motion is slowed down."""
_ROUNDS_WITH_FREEDOM = 20
"""The same for an arm with few joints: where a joint reaches its limit, the others take over within one step, and at
half the speed the acceleration of such a kink is half, not a quarter."""
_LONGEST_S = 60.0
"""Maximum duration of a motion, s; a longer one contains a jump of the joints, which slowing down does not reduce."""


@dataclass(frozen=True, kw_only=True, eq=False)
class MotionLimits:
    """Joint limits of a motion: (n,) rad/s, rad/s^2, already reduced by a margin."""

    joint_velocity: Array
    joint_acceleration: Array


def quintic(u: Array) -> Array:
    """Compute the fraction of the path at fraction `u` of the time, both 0..1."""
    return np.asarray(u * u * u * (10.0 + u * (6.0 * u - 15.0)), dtype=np.float64)


def plan_straight(
    arm: ArmKinematics,
    *,
    start: Array,
    goal: Pose,
    rest: Array,
    speed: float,
    turn_speed: float = 1.0,
    limits: MotionLimits,
    dt: float,
) -> Array | None:
    """Plan joint targets (T, n) of a straight motion, one per control step, start excluded; None if unreachable.

    Args:
        arm: Kinematics.
        start: (n,) current commanded configuration, rad. The path starts from its forward kinematics instead of an
            idealised pose, from which the first step would exceed the limits.
        goal: base_from_tcp at the end.
        rest: (n,) configuration towards which the goal configuration is pulled in the null space.
        speed: Peak speed of the TCP, m/s.
        turn_speed: Factor on the angular velocity limit.
        limits: Joint limits.
        dt: Control step, s.
    """
    goal_q = arm.find(goal, start=start, rest=rest)
    if goal_q is None:
        return None
    base_from_start = arm.forward(start)
    delta = goal.position - base_from_start.position
    distance = math.sqrt(float((delta * delta).sum()))
    angle = angle_between(base_from_start, goal)
    seconds = max(
        MIN_SECONDS,
        PEAK_VELOCITY * distance / speed,
        math.sqrt(PEAK_ACCELERATION * distance / LINEAR_ACCELERATION),
        PEAK_VELOCITY * angle / (ANGULAR_VELOCITY * turn_speed),
        math.sqrt(PEAK_ACCELERATION * angle / ANGULAR_ACCELERATION),
    )
    longest = max(_LONGEST_S, 2 * seconds)
    for _ in range(_ROUNDS if arm.freedom == WHOLE_POSE else _ROUNDS_WITH_FREEDOM):
        steps = max(1, math.ceil(seconds / dt))
        path = arm.straight_path(
            start=start,
            goal=goal_q,
            base_from_start=base_from_start,
            base_from_goal=goal,
            fractions=quintic(np.arange(1, steps + 1) / steps),
        )
        if path is None:
            return None
        factor = slowdown(path, start=start, limits=limits, dt=dt)
        if factor <= 1.0:
            return path
        seconds *= 1.02 * factor
        if seconds > longest:
            return None
    return None


def plan_joints(*, start: Array, goal: Array, speed: float, limits: MotionLimits, dt: float) -> Array:
    """Plan joint targets (T, n) of a motion of all joints at once, one per control step, start excluded.

    Args:
        start, goal: (n,) configurations, rad.
        speed: Peak speed of the joint with the largest motion, rad/s.
        limits: Joint limits.
        dt: Control step, s.
    """
    seconds = PEAK_VELOCITY * max(float(np.abs(goal - start).max()) / speed, MIN_SECONDS)
    while True:
        steps = max(1, math.ceil(seconds / dt))
        path = start + quintic(np.arange(1, steps + 1) / steps)[:, np.newaxis] * (goal - start)
        factor = slowdown(path, start=start, limits=limits, dt=dt)
        if factor <= 1.0:
            return path
        seconds *= 1.02 * factor


def slowdown(path: Array, *, start: Array, limits: MotionLimits, dt: float) -> float:
    """Compute the time stretch factor with which a path (T, n), at rest at both ends, respects the limits."""
    padded = np.vstack([start, start, path, path[-1:]])
    velocity = np.abs(np.diff(padded, axis=0)) / dt
    acceleration = np.abs(np.diff(padded, 2, axis=0)) / (dt * dt)
    return float(
        max(
            (velocity.max(axis=0) / limits.joint_velocity).max(),
            math.sqrt(float((acceleration.max(axis=0) / limits.joint_acceleration).max())),
        )
    )
