"""Where a hand that points down takes hold of a body, beside it, and puts it down."""

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

# Half of the open hand, metres (of an arm of task_scale 1), along its x and y axes: the larger of the Panda's and the
# iiwa's; with the gap, that of the SO-101 at its scale.
_FINGERS = np.array([0.012, 0.07])
_PALM = np.array([0.035, 0.11])
_UP = np.array([0.0, 0.0, 1.0])
_GAP = 0.005
"""Air between the hand and what it shall not touch, metres."""
_COST_OF_TURNING = 0.1
"""Of a radian that the hand turns, in the unit of `demorec.objects.antipodal.Grasp.cost`."""
ABOVE_M = 0.01
"""Maximum distance of the hand from above its grasp at which it need not rise and come again."""
ABOVE_RAD = 0.35
"""Maximum angle between the two."""


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


def _across(yaw: float) -> Array:
    """The direction (3,) in which the fingers of a hand move that points down at a yaw, rad."""
    return hand_down((0.0, 0.0, 0.0), yaw).rotation[:, 1]


def raised(pose: Pose, height: float) -> Pose:
    """The same pose `height` metres higher."""
    return Pose(position=pose.position + np.array([0.0, 0.0, height]), quat_xyzw=pose.quat_xyzw)


def symmetric_yaws(yaw: float, symmetry: int) -> list[float]:
    """All yaws, rad, that look the same."""
    return [wrap_angle(yaw + 2 * math.pi * k / symmetry) for k in range(symmetry)]


def nearest_first(yaws: Iterable[float], now: float) -> list[float]:
    """Yaws, rad, in the order of how far the hand turns to them from its present one."""
    return sorted(yaws, key=lambda yaw: abs(wrap_angle(yaw - now)))


def is_above(here: Pose, wanted: Pose, *, beside: float = ABOVE_M) -> bool:
    """Whether the hand needs but to be lowered to get from one `world_from_tcp` to another.

    Args:
        here, wanted: Where it is, and where to.
        beside: So far aside it may be, metres; beyond a centimetre no farther than it is above.
    """
    above = float(here.position[2] - wanted.position[2])
    aside = math.dist(here.position[:2], wanted.position[:2])
    return above >= 0 and angle_between(here, wanted) < ABOVE_RAD and aside < min(beside, max(ABOVE_M, above))


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


def grasps_of(body: Body, pose: Pose, *, now: float, robot: RobotSpec, behaviour: Behaviour) -> list[Pose]:
    """`world_from_tcp` of grasps with the behaviour's offset and errors, the yaw nearest to the present one first.

    Args:
        body, pose: What is grasped, and its pose in the world.
        now: Present hand yaw, rad.
        robot: Whose hand it is.
        behaviour: How it is done.

    Of a mesh from a file those across its narrower side come before the others.
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
        # Its faces are not known. Over the ends of a long thing fingers meet points, at which it turns and comes loose.
        yaws.sort(key=lambda yaw: round(half_extent(body, pose, _across(yaw)), 4))
    for yaw in yaws:
        across = _across(yaw)
        x, y = pose.position[:2] - gripper.object_offset(2 * half_extent(body, pose, across)) * across[:2]
        found.append(_perturbed(hand_down((x, y, z), yaw), behaviour))
    return found


def found_grasps(shape: Shape, robot: RobotSpec, up: Array) -> tuple[Grasp, ...]:
    """The grasps of a solid that stands with the direction `up` (3,) of its own axes upward, best first."""
    x, y, z = np.round(up, 2).tolist()
    length = math.hypot(x, y, z)
    upward = x / length, y / length, z / length
    return antipodal_grasps(shape.mesh, robot.gripper, task_scale=robot.task_scale, scale=shape.scale, up=upward)


def _grasps_of_mesh(body: Body, pose: Pose, *, now: float, robot: RobotSpec) -> list[Pose]:
    """The same for a solid, by their cost and how far the hand has to turn."""
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
    """Grasps `world_from_tcp` in their order, but those at which the open hand would touch another body last."""
    return sorted(grasps, key=lambda grasp: not all(_is_clear(grasp, other, at, robot) for other, at in others))


def _is_clear(hand: Pose, body: Body, pose: Pose, robot: RobotSpec) -> bool:
    """Whether the open hand, pointing down at `world_from_tcp`, touches nothing of a body."""
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
    # The hand's x axis runs along the fingers' faces: a shift that way still grasps.
    shift = shift + behaviour.grasp_offset * np.array([math.cos(yaw), math.sin(yaw), 0.0])
    return hand_down(grasp.position + shift, yaw + behaviour.perception_yaw)


def places_of(body: Body, pose: Pose, wanted: Pose, *, hand: Pose, yaw_symmetry: int) -> list[Pose]:
    """`world_from_tcp` that put a held body where it is wanted, with the offset in the hand compensated.

    Args:
        body, pose: What is held, and its pose in the world.
        wanted: Its pose in the world, resting on the face that was meant.
        hand: `world_from_tcp` now.
        yaw_symmetry: How many yaws are as good; 0: the present one.
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
    """Yield poses of the open hand next to a body, where it touches nothing: grasps that miss.

    Args:
        grasps: `world_from_tcp` of grasps of it.
        body, pose: What is missed, and its pose in the world.
        x, y: From the body's centre in the hand's frame, metres. x is made longer where the fingers would touch the
            body. For each grasp the side that it points to (for 0: forward) comes first, then the other one; a side
            where something else is in the way is left out, so there may be none.
        others: All the other bodies and their poses.
        robot: Whose hand it is.
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
    """Whether a body is clear of a rectangle around the hand's middle, both seen from above along the hand's axes."""
    offset = np.abs((pose.position - hand.position) @ hand.rotation)
    return any(
        offset[axis] > half_size[axis] + half_extent(body, pose, hand.rotation[:, axis]) + _GAP for axis in (0, 1)
    )


def half_extent(body: Body, pose: Pose, direction: Array) -> float:
    """Half the extent of a body's bounding box along a unit vector of the world, metres."""
    return float(np.abs(direction @ pose.rotation) @ np.array(body.shape.extents)) / 2
