"""Poses of a hand that points down: to grasp a body, to miss it, and to put it down."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator, Sequence

import numpy as np

from demorec.core.geometry import Array, Pose, angle_between, wrap_angle
from demorec.episode.scene import Body, Shape, yaw_of
from demorec.objects.antipodal import TIP_CLEARANCE, Grasp, antipodal_grasps, standing_rotation
from demorec.robots.robot import RobotSpec
from demorec.tasks.script import Behaviour
from demorec.tasks.success import resting_half_height

# Half of the open hand, metres (of an arm of task_scale 1), along its x and y axes: the maximum of the Panda's and the
# iiwa's; with the gap, it also covers the SO-101's at its scale.
_FINGERS = np.array([0.012, 0.07])
_PALM = np.array([0.035, 0.11])
_UP = np.array([0.0, 0.0, 1.0])
_GAP = 0.005
"""Clearance between the hand and bodies that it must not touch, metres."""
_COST_OF_TURNING = 0.1
"""Cost per radian of turning the hand, in the unit of `demorec.objects.antipodal.Grasp.cost`."""
ABOVE_M = 0.01
"""Maximum horizontal distance of the hand from its grasp at which it can descend directly, metres."""
ABOVE_RAD = 0.35
"""Maximum angle between the two, rad."""


def hand_down(position: Sequence[float] | Array, yaw: float) -> Pose:
    """Build `world_from_tcp` of a hand that points down; at yaw 0 its x axis is the world's."""
    return Pose(
        position=np.asarray(position, dtype=np.float64),
        quat_xyzw=np.array([math.cos(yaw / 2), math.sin(yaw / 2), 0.0, 0.0]),
    )


def hand_yaw(world_from_tcp: Pose) -> float:
    """Compute the yaw, rad, of a hand that points (roughly) down: the angle of its x axis."""
    rotation = world_from_tcp.rotation
    return math.atan2(rotation[1, 0], rotation[0, 0])


def _across(yaw: float) -> Array:
    """Compute the direction (3,) of finger motion of a hand that points down at a yaw, rad."""
    return hand_down((0.0, 0.0, 0.0), yaw).rotation[:, 1]


def raised(pose: Pose, height: float) -> Pose:
    """Raise a pose by `height` metres."""
    return Pose(position=pose.position + np.array([0.0, 0.0, height]), quat_xyzw=pose.quat_xyzw)


def symmetric_yaws(yaw: float, symmetry: int) -> list[float]:
    """List all equivalent yaws, rad."""
    return [wrap_angle(yaw + 2 * math.pi * k / symmetry) for k in range(symmetry)]


def nearest_first(yaws: Iterable[float], now: float) -> list[float]:
    """Sort yaws, rad, by how far the hand turns to them from its current one."""
    return sorted(yaws, key=lambda yaw: abs(wrap_angle(yaw - now)))


def is_above(here: Pose, wanted: Pose, *, beside: float = ABOVE_M) -> bool:
    """Check whether the hand can get from one `world_from_tcp` to another just by descending.

    The horizontal distance may be up to `beside` metres; beyond 1 cm it is also limited by the height above.
    """
    above = float(here.position[2] - wanted.position[2])
    aside = math.dist(here.position[:2], wanted.position[:2])
    return above >= 0 and angle_between(here, wanted) < ABOVE_RAD and aside < min(beside, max(ABOVE_M, above))


def grasp_yaws(body: Body, pose: Pose, now: float, open_width: float) -> list[float]:
    """List the hand yaws, rad, at which the fingers close over two opposite faces that fit between them.

    For round bodies they include the current one, `now`.
    """
    vertical = int(np.argmax(np.abs(pose.rotation[2])))
    if body.yaw_symmetry == 0 and vertical == 2:
        return symmetric_yaws(now, 8)
    yaws: list[float] = []
    for axis in range(3):
        # One centimetre of play for noise and for the perceived yaw.
        if axis == vertical or body.shape.extents[axis] > open_width - 0.01:
            continue
        angle = math.atan2(pose.rotation[1, axis], pose.rotation[0, axis])
        # The fingers move along the hand's y axis, a quarter turn from its x axis.
        yaws += symmetric_yaws(angle + math.pi / 2, 2)
    return yaws


def grasps_of(body: Body, pose: Pose, *, now: float, robot: RobotSpec, behaviour: Behaviour) -> list[Pose]:
    """List `world_from_tcp` of grasps with the behaviour's offset and errors, nearest to the current yaw first.

    For a mesh from a file, grasps across its narrower side come first.
    """
    if body.shape.mesh:
        return [_perturbed(grasp, behaviour) for grasp in _grasps_of_mesh(body, pose, now=now, robot=robot)]
    gripper, half = robot.gripper, resting_half_height(body, pose)
    top, bottom = pose.position[2] + half, pose.position[2] - half
    # At the centre, but no deeper than the palm allows, and with the finger tips above the support.
    above_support = gripper.finger_depth + TIP_CLEARANCE * robot.task_scale
    z = max(pose.position[2], top - (gripper.palm_clearance - 0.007), bottom + above_support)
    found = []
    yaws = nearest_first(grasp_yaws(body, pose, now, gripper.open_width), now)
    if body.shape.kind == "mesh":
        # Its faces are unknown. Over the ends of an elongated object fingers touch points, where it turns and comes
        # loose.
        yaws.sort(key=lambda yaw: round(half_extent(body, pose, _across(yaw)), 4))
    for yaw in yaws:
        across = _across(yaw)
        x, y = pose.position[:2] - gripper.object_offset(2 * half_extent(body, pose, across)) * across[:2]
        found.append(_perturbed(hand_down((x, y, z), yaw), behaviour))
    return found


def found_grasps(shape: Shape, robot: RobotSpec, up: Array) -> tuple[Grasp, ...]:
    """Compute the grasps of a solid resting with its direction `up` (3,) upward, best first."""
    x, y, z = np.round(up, 2).tolist()
    length = math.hypot(x, y, z)
    upward = x / length, y / length, z / length
    return antipodal_grasps(shape.mesh, robot.gripper, task_scale=robot.task_scale, scale=shape.scale, up=upward)


def _grasps_of_mesh(body: Body, pose: Pose, *, now: float, robot: RobotSpec) -> list[Pose]:
    """Sort the grasps of a solid by cost and by how far the hand has to turn."""
    up = pose.rotation[2]
    found = found_grasps(body.shape, robot, up)
    x, y, z = up.tolist()
    turned = pose.rotation @ standing_rotation((x, y, z)).T
    heading = math.atan2(turned[1, 0], turned[0, 0])
    cos, sin = math.cos(heading), math.sin(heading)
    grasps: list[tuple[float, Pose]] = []
    for grasp in found:
        for yaw in symmetric_yaws(heading + grasp.yaw, 2):
            across = _across(yaw)
            offset = np.array([cos * grasp.x - sin * grasp.y, sin * grasp.x + cos * grasp.y, grasp.z])
            place = pose.position + offset - robot.gripper.object_offset(grasp.width) * across
            grasps.append((grasp.cost + _COST_OF_TURNING * abs(wrap_angle(yaw - now)), hand_down(place, yaw)))
    return [grasp for _, grasp in sorted(grasps, key=lambda entry: entry[0])]


def clear_first(grasps: Sequence[Pose], others: Sequence[tuple[Body, Pose]], robot: RobotSpec) -> list[Pose]:
    """Move grasps `world_from_tcp` at which the open hand would touch another body to the end."""
    return sorted(grasps, key=lambda grasp: not all(_is_clear(grasp, other, at, robot) for other, at in others))


def _is_clear(hand: Pose, body: Body, pose: Pose, robot: RobotSpec) -> bool:
    """Check that the open hand, pointing down at `world_from_tcp`, does not touch a body."""
    gripper, scale = robot.gripper, robot.task_scale
    tips, palm = hand.position[2] - gripper.finger_depth, hand.position[2] + gripper.palm_clearance
    offset = gripper.object_offset(gripper.open_width)  # a jaw opens to one side of the TCP
    around = Pose(position=hand.position + offset * hand.rotation[:, 1], quat_xyzw=hand.quat_xyzw)
    return (
        _is_lower(body, pose, tips)
        or (_is_beside(around, scale * _FINGERS, body, pose) and _is_lower(body, pose, palm))
        or _is_beside(around, scale * _PALM, body, pose)
    )


def _perturbed(grasp: Pose, behaviour: Behaviour) -> Pose:
    yaw = hand_yaw(grasp)
    shift = np.array([behaviour.perception_x, behaviour.perception_y, 0.0])
    # The hand's x axis runs along the fingers' faces: a shift in that direction still grasps.
    shift = shift + behaviour.grasp_offset * np.array([math.cos(yaw), math.sin(yaw), 0.0])
    return hand_down(grasp.position + shift, yaw + behaviour.perception_yaw)


def places_of(body: Body, pose: Pose, wanted: Pose, *, hand: Pose, yaw_symmetry: int) -> list[Pose]:
    """List `world_from_tcp` that put a held body at its target, compensating its offset in the hand.

    At the target (`wanted`) it rests on the intended face; with a `yaw_symmetry` of 0 only the current yaw is listed.
    """
    hand_from_object = (hand.inverse() @ pose).position
    now = hand_yaw(hand)
    height = wanted.position[2] - resting_half_height(body, wanted) + resting_half_height(body, pose)
    centre = np.array([wanted.position[0], wanted.position[1], height])
    yaws = [now]
    if yaw_symmetry:
        yaws = nearest_first(symmetric_yaws(yaw_of(wanted) + now - yaw_of(pose), yaw_symmetry), now)
    return [hand_down(centre - hand_down((0.0, 0.0, 0.0), y).apply(hand_from_object), y) for y in yaws]


def grasps_beside(
    grasps: Iterable[Pose],
    body: Body,
    pose: Pose,
    *,
    x: float,
    y: float,
    others: Collection[tuple[Body, Pose]],
    robot: RobotSpec,
) -> Iterator[Pose]:
    """Yield poses of the open hand next to a body that touch neither it nor other bodies: grasps that miss.

    x and y are the offset from the body's centre in the hand's frame, metres; x is increased where the fingers would
    touch the body. For each grasp the side of its sign (for 0: forward) comes first, then the other one; a blocked
    side is omitted, so there may be none.
    """
    for grasp in grasps:
        hand_x, hand_y = grasp.rotation[:, 0], grasp.rotation[:, 1]
        distance = max(abs(x), half_extent(body, pose, hand_x) + _FINGERS[0] + _GAP)
        offset = robot.gripper.object_offset(2 * half_extent(body, pose, hand_y))
        centre = np.array([*(pose.position - offset * hand_y)[:2], grasp.position[2]])
        for side in (1.0, -1.0):
            position = centre + side * math.copysign(distance, x) * hand_x + y * hand_y
            missed = Pose(position=position, quat_xyzw=grasp.quat_xyzw)
            if all(_is_clear(missed, other, at, robot) for other, at in others):
                yield missed


def _is_lower(body: Body, pose: Pose, height: float) -> bool:
    return not body.collides or pose.position[2] + half_extent(body, pose, _UP) < height


def _is_beside(hand: Pose, half_size: Array, body: Body, pose: Pose) -> bool:
    """Check that a body is clear of a rectangle around the hand's middle, seen from above along the hand's axes."""
    offset = np.abs((pose.position - hand.position) @ hand.rotation)
    return any(
        offset[axis] > half_size[axis] + half_extent(body, pose, hand.rotation[:, axis]) + _GAP for axis in (0, 1)
    )


def half_extent(body: Body, pose: Pose, direction: Array) -> float:
    """Compute half the extent of a body's bounding box along a unit vector of the world, metres."""
    return float(np.abs(direction @ pose.rotation) @ np.array(body.shape.extents)) / 2
