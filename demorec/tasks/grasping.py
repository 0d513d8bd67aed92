"""Where a hand that points down takes hold of a body."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np

from demorec.geometry import Array, Pose, wrap_angle
from demorec.scene import Body

FINGER_HALF_WIDTH = 0.011
"""Half the breadth of a finger along the hand's x axis, metres (Franka hand: 21 mm)."""
_HAND_HALF_LENGTH = 0.07
"""From the TCP to the outer sides of the open fingers, along the hand's y axis, metres."""
_GAP = 0.005


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


def grasps_beside(
    grasp: Pose, body: Body, pose: Pose, *, x: float, y: float, others: Iterable[tuple[Body, Pose]], finger_depth: float
) -> list[Pose]:
    """Where the open fingers go down beside a body, touching nothing: a grasp that misses.

    Args:
        grasp: `world_from_tcp` of the good grasp.
        body, pose: What is missed, and its pose in the world.
        x, y: Shift in the hand's frame, metres. x is made longer where the fingers would touch the body; the side
            that it points to comes first in the result, if nothing else stands there.
        others: All the other bodies and their poses.
        finger_depth: How far the finger tips reach beyond the TCP, metres.
    """
    hand_x, hand_y = grasp.rotation[:, 0], grasp.rotation[:, 1]
    needed = _half_extent(body, pose, hand_x) + FINGER_HALF_WIDTH + _GAP
    tips = grasp.position[2] - finger_depth
    up = np.array([0.0, 0.0, 1.0])
    in_the_way = [
        (other, at) for other, at in others if other.collides and at.position[2] + _half_extent(other, at, up) > tips
    ]
    found = []
    for side in (1.0, -1.0):
        shift = side * math.copysign(max(abs(x), needed), x) * hand_x + y * hand_y
        missed = Pose(position=grasp.position + shift, quat_xyzw=grasp.quat_xyzw)
        if all(_stands_clear(missed, other, at) for other, at in in_the_way):
            found.append(missed)
    return found


def _stands_clear(hand: Pose, body: Body, pose: Pose) -> bool:
    """Whether a body's upright bounding cylinder stays clear of the open fingers, seen from above."""
    x, y, _ = hand.inverse().apply(pose.position)
    radius = math.hypot(*(_half_extent(body, pose, np.eye(3)[axis]) for axis in (0, 1)))
    beside = max(abs(x) - FINGER_HALF_WIDTH, 0.0), max(abs(y) - _HAND_HALF_LENGTH, 0.0)
    return math.hypot(*beside) > radius + _GAP


def _half_extent(body: Body, pose: Pose, direction: Array) -> float:
    """Half the extent of a body's bounding box along a unit vector of the world, metres."""
    return float(np.abs(direction @ pose.rotation) @ np.array(body.shape.extents)) / 2
