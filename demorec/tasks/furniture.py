"""Elements of scenes: table, floor, target marks and cubes; the named colours; objects in words."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from demorec.core.geometry import Pose
from demorec.episode.scene import Body, Rgba, RobotPlacement, Shape, Vector3
from demorec.episode.words import NOUNS
from demorec.robots.robot import RobotSpec
from demorec.tasks.sampling import Sampler

TABLE_HEIGHT = 0.62
MARK_THICKNESS = 0.001

COLORS: Mapping[str, Rgba] = {
    "red": (0.82, 0.14, 0.12, 1.0),
    "green": (0.16, 0.62, 0.24, 1.0),
    "blue": (0.13, 0.33, 0.78, 1.0),
    "yellow": (0.93, 0.76, 0.13, 1.0),
    "orange": (0.93, 0.47, 0.10, 1.0),
    "purple": (0.48, 0.22, 0.62, 1.0),
}
"""Colours that have a name in instructions."""


def floor(height: float) -> Body:
    """Make a floor with its upper face at z = `height`, metres."""
    return Body(
        name="floor",
        role="fixture",
        shape=Shape(kind="box", size=(8.0, 8.0, 0.02)),
        world_from_body=Pose(position=np.array([0.0, 0.0, height - 0.01])),
        lateral_friction=1.0,
        rgba=(0.47, 0.49, 0.52, 1.0),
    )


def table_and_floor() -> tuple[Body, Body]:
    """Make the floor and a table with its top at z = 0."""
    table = Body(
        name="table",
        role="support",
        shape=Shape(kind="box", size=(1.0, 1.5, TABLE_HEIGHT)),
        world_from_body=Pose(position=np.array([0.35, 0.0, -TABLE_HEIGHT / 2])),
        lateral_friction=0.6,
        rgba=(0.80, 0.70, 0.57, 1.0),
    )
    return floor(-TABLE_HEIGHT), table


def mark(name: str, point: tuple[float, float], yaw: float, *, side: float, color_name: str) -> Body:
    """Make a thin visual-only square on the table, its top a millimetre above it."""
    return Body(
        name=name,
        role="target",
        shape=Shape(kind="box", size=(side, side, MARK_THICKNESS)),
        world_from_body=Pose.from_yaw((point[0], point[1], MARK_THICKNESS / 2), yaw),
        rgba=COLORS[color_name],
        color_name=color_name,
        collides=False,
        yaw_symmetry=4,
    )


def green_target(point: tuple[float, float], yaw: float, *, side: float = 0.08) -> Body:
    """Make the target mark of instructions."""
    return mark("green_target", point, yaw, side=side, color_name="green")


def cube(
    name: str,
    point: tuple[float, float],
    yaw: float,
    *,
    side: float,
    mass: float,
    friction: float,
    color_name: str,
    z: float = 0.0,
) -> Body:
    """Make a cube with its lower face at height `z`, metres."""
    position: Vector3 = (point[0], point[1], z + side / 2 + 5e-4)
    return Body(
        name=name,
        role="object",
        shape=Shape(kind="box", size=(side, side, side)),
        world_from_body=Pose.from_yaw(position, yaw),
        mass=mass,
        lateral_friction=friction,
        rgba=COLORS[color_name],
        color_name=color_name,
        yaw_symmetry=4,
    )


def robot_at_origin(robot: RobotSpec, sampler: Sampler) -> RobotPlacement:
    """Place the robot at the world's origin, near its home configuration (range joint_spread), gripper open.

    A joint with its home near a limit starts within the limit.
    """
    spread = sampler.ranges.number("joint_spread")
    drawn = [q + sampler.uniform(-spread, spread) for q in robot.home_q]
    return RobotPlacement(
        name=robot.name,
        world_from_base=Pose(),
        joint_position=tuple(map(float, np.clip(drawn, robot.position_lower, robot.position_upper))),
        gripper_width=robot.gripper.open_width,
    )


def words_for(body: Body) -> str:
    """Describe an object in words ("red cube", "duck"); one of an unknown kind by its body's name."""
    kinds = [NOUNS[part] for part in body.name.split("_") if part in NOUNS]
    return f"{body.color_name} {kinds[0]}".strip() if kinds else body.name.replace("_", " ")
