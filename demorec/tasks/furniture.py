"""Elements of scenes: table, floor and target marks, cubes and objects of other shapes; the named colours."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from demorec.core.geometry import Pose
from demorec.episode.scene import Body, Rgba, RobotPlacement, Role, Shape, Vector3
from demorec.robots.robot import RobotSpec
from demorec.tasks.sampling import Sampler

TABLE_HEIGHT = 0.62
WALL_HEIGHT = 1.6
"""Height of the walls around the table, metres; the sun of `--variation full` is above them."""
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
OTHER_COLORS = tuple(name for name in COLORS if name != "green")
"""Colours of objects that are moved to a green target."""


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


def walls() -> tuple[Body, ...]:
    """Make visual-only walls behind the table and on both sides, out of the arm's reach; named "wall..."."""
    places = {
        "wall_back": (-1.3, 0.0, 0.0),
        "wall_left": (0.7, 1.5, -math.pi / 2),
        "wall_right": (0.7, -1.5, math.pi / 2),
    }
    return tuple(
        Body(
            name=name,
            role="fixture",
            shape=Shape(kind="box", size=(0.02, 4.0, WALL_HEIGHT)),
            world_from_body=Pose.from_yaw((x, y, WALL_HEIGHT / 2 - TABLE_HEIGHT), yaw),
            rgba=(0.70, 0.74, 0.76, 1.0),
            collides=False,
        )
        for name, (x, y, yaw) in places.items()
    )


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


WHITE = (1.0, 1.0, 1.0, 1.0)
"""Colour that leaves a mesh's own unchanged."""


@dataclass(frozen=True, kw_only=True)
class Thing:
    """A kind of object."""

    noun: str  # its word in instructions
    shape: Callable[[Sampler], Shape]
    yaw_symmetry: int  # as in `Body.yaw_symmetry`
    painted: bool = True  # whether it gets a colour and the colour's word; a mesh keeps its colours


def _box(sampler: Sampler) -> Shape:
    size = (sampler.uniform(0.05, 0.09), sampler.uniform(0.025, 0.045), sampler.uniform(0.03, 0.045))
    return Shape(kind="box", size=size)


def _cube(sampler: Sampler) -> Shape:
    side = sampler.uniform(0.03, 0.045)
    return Shape(kind="box", size=(side, side, side))


def _cylinder(sampler: Sampler) -> Shape:
    return Shape(kind="cylinder", size=(sampler.uniform(0.015, 0.025), sampler.uniform(0.03, 0.045)))


def _jenga(sampler: Sampler) -> Shape:
    scale = sampler.uniform(0.7, 0.9)
    return Shape(kind="urdf", file="jenga/jenga.urdf", scale=scale, size=(0.15 * scale, 0.05 * scale, 0.03 * scale))


def _lego(sampler: Sampler) -> Shape:
    scale = sampler.uniform(1.0, 1.4)
    return Shape(kind="urdf", file="lego/lego.urdf", scale=scale, size=(0.032 * scale, 0.032 * scale, 0.023 * scale))


def _duck(sampler: Sampler) -> Shape:
    scale = 0.035 * sampler.uniform(0.9, 1.1)
    return Shape(
        kind="mesh",
        file="duck.obj",
        scale=scale,
        size=(1.6548 * scale, 1.1525 * scale, 1.5404 * scale),
        origin=(-0.1344, 0.8695, 0.0370),
        y_up=True,
    )


def _mug(sampler: Sampler) -> Shape:
    scale = sampler.uniform(0.52, 0.60)
    # The origin is on the mug's axis, so that the fingers close over its middle; the handle points along y.
    size = (0.082 * scale, 0.1613 * scale, 0.1 * scale)
    return Shape(kind="mesh", file="objects/mug.obj", scale=scale, size=size, origin=(0.0, 0.0, 0.05))


THINGS: Mapping[str, Thing] = {
    "cube": Thing(noun="cube", shape=_cube, yaw_symmetry=4),
    "block": Thing(noun="block", shape=_box, yaw_symmetry=2),
    "cylinder": Thing(noun="cylinder", shape=_cylinder, yaw_symmetry=0),
    "jenga": Thing(noun="wooden plank", shape=_jenga, yaw_symmetry=2, painted=False),
    "lego": Thing(noun="toy brick", shape=_lego, yaw_symmetry=4),
    "duck": Thing(noun="duck", shape=_duck, yaw_symmetry=1, painted=False),
    "mug": Thing(noun="mug", shape=_mug, yaw_symmetry=1),
}
"""All kinds that the tasks draw from."""


def make_thing(
    sampler: Sampler, kind: str, name: str, point: tuple[float, float], yaw: float, *, color_name: str, role: Role
) -> Body:
    """Make an object on the table with drawn geometry, mass (20-150 g) and friction (0.5-1.2)."""
    thing = THINGS[kind]
    shape = thing.shape(sampler)
    return Body(
        name=name,
        role=role,
        shape=shape,
        world_from_body=Pose.from_yaw((point[0], point[1], shape.extents[2] / 2 + 5e-4), yaw),
        mass=sampler.uniform(0.02, 0.15),
        lateral_friction=sampler.uniform(0.5, 1.2),
        # Rolling objects are slowed down as felt on a table would.
        rolling_friction=0.001 if shape.kind == "cylinder" else 0.0,
        rgba=COLORS[color_name] if thing.painted else WHITE,
        color_name=color_name if thing.painted else "",
        yaw_symmetry=thing.yaw_symmetry,
    )


def words_for(body: Body) -> str:
    """Describe an object in words ("red cube", "duck"); one of an unknown kind by its body's name."""
    kinds = [THINGS[part].noun for part in body.name.split("_") if part in THINGS]
    return f"{body.color_name} {kinds[0]}".strip() if kinds else body.name.replace("_", " ")
