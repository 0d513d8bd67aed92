"""Where a hand that points down takes hold of a body."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from demorec.geometry import Array, Pose, wrap_angle
from demorec.scene import Body


def hand_down(position: Sequence[float] | Array, yaw: float) -> Pose:
    """`world_from_tcp` with the hand pointing down; at yaw 0 its x axis is the world's."""
    return Pose(
        position=np.asarray(position, dtype=np.float64),
        quat_xyzw=np.array([math.cos(yaw / 2), math.sin(yaw / 2), 0.0, 0.0]),
    )


def hand_yaw(world_from_tcp: Pose) -> float:
    """Yaw, rad, of a hand that points down (roughly): the angle of its x axis."""
    rotation = world_from_tcp.rotation
    return math.atan2(rotation[1, 0], rotation[0, 0])


def raised(pose: Pose, height: float) -> Pose:
    """The same pose `height` metres higher."""
    return Pose(position=pose.position + np.array([0.0, 0.0, height]), quat_xyzw=pose.quat_xyzw)


def symmetric_yaws(yaw: float, symmetry: int) -> list[float]:
    """All yaws, rad, that look the same."""
    return [wrap_angle(yaw + 2 * math.pi * k / symmetry) for k in range(symmetry)]


def grasp_yaws(body: Body, pose: Pose, now: float, open_width: float) -> list[float]:
    """Hand yaws, rad, at which the fingers close over two opposite faces that fit between them.

    Args:
        body, pose: What is grasped, and its pose in the world.
        now: Present hand yaw, allowed for round bodies.
        open_width: Of the gripper, metres.
    """
    vertical = int(np.argmax(np.abs(pose.rotation[2])))
    if body.yaw_symmetry == 0 and vertical == 2:
        return symmetric_yaws(now, 8)
    yaws: list[float] = []
    for axis in range(3):
        # A centimetre of play for noise and for the perceived yaw.
        if axis == vertical or body.shape.extents[axis] > open_width - 0.01:
            continue
        angle = math.atan2(pose.rotation[1, axis], pose.rotation[0, axis])
        # The fingers move along the hand's y axis, a quarter turn from its x axis.
        yaws += symmetric_yaws(angle + math.pi / 2, 2)
    return yaws
