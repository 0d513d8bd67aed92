"""Motions stay within their limits for every goal, and end at the goal."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from demorec.core.geometry import Array
from demorec.robots.motion import MotionLimits, plan_joints, plan_straight
from demorec.robots.panda import PANDA
from demorec.sim.arm import arm_kinematics
from demorec.tasks.grasping import hand_down

ARM = arm_kinematics(PANDA)
HOME = np.array(PANDA.home_q)
LIMITS = MotionLimits(
    joint_velocity=0.6 * np.array(PANDA.velocity_limit), joint_acceleration=0.8 * np.array(PANDA.acceleration_limit)
)


def assert_within_limits(rows: Array, fps: int) -> None:
    """Check velocity and acceleration of joint targets (T, 7), one each control step."""
    assert (np.abs(np.diff(rows, axis=0)) * fps <= LIMITS.joint_velocity * (1 + 1e-9)).all()
    assert (np.abs(np.diff(rows, 2, axis=0)) * fps**2 <= LIMITS.joint_acceleration * (1 + 1e-9)).all()


@settings(max_examples=60)
@given(
    turns=st.lists(st.floats(-2.0, 2.0), min_size=7, max_size=7),
    speed=st.floats(0.2, 5.0),
    fps=st.sampled_from([10, 30, 60]),
)
def test_all_joints_at_once_keep_the_limits_too(turns: list[float], speed: float, fps: int) -> None:
    goal = HOME + np.array(turns)
    path = plan_joints(start=HOME, goal=goal, speed=speed, limits=LIMITS, dt=1 / fps)
    assert_within_limits(np.vstack([HOME, HOME, path, path[-1]]), fps)
    assert np.abs(path[-1] - goal).max() < 1e-9


@settings(max_examples=60)
@given(
    x=st.floats(0.32, 0.62),
    y=st.floats(-0.3, 0.3),
    z=st.floats(0.02, 0.35),
    yaw=st.floats(-1.5, 1.5),
    speed=st.floats(0.05, 3.0),
    fps=st.sampled_from([10, 30, 60]),
    start=st.lists(st.floats(-0.2, 0.2), min_size=7, max_size=7),
)
def test_velocity_and_acceleration_limits_hold(
    x: float, y: float, z: float, yaw: float, speed: float, fps: int, start: list[float]
) -> None:
    q = HOME + np.array(start)
    goal = hand_down((x, y, z), yaw)
    path = plan_straight(ARM, start=q, goal=goal, rest=HOME, speed=speed, limits=LIMITS, dt=1 / fps)
    if path is None:
        return
    rows = np.vstack([q, q, path, path[-1]])
    assert_within_limits(rows, fps)
    end = ARM.forward(path[-1])
    assert math.dist(end.position, goal.position) < 3e-4
    assert (path >= ARM.lower).all()
    assert (path <= ARM.upper).all()
    # The peak speed of the hand is at most the requested one (2 % for the time law's sampling).
    hand = np.array([ARM.forward(row).position for row in rows[1:]])
    assert np.linalg.norm(np.diff(hand, axis=0), axis=1).max() * fps <= speed * 1.02 + 2e-4 * fps
