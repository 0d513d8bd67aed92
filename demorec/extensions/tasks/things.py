"""Objects of several shapes, and walls around the table."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from demorec.core.geometry import Pose
from demorec.episode.scene import Body, Role, Shape
from demorec.tasks.furniture import COLORS, TABLE_HEIGHT
from demorec.tasks.sampling import Sampler

WALL_HEIGHT = 1.6
"""Height of the walls around the table, metres; the sun of `--variation full` is above them."""
OTHER_COLORS = tuple(name for name in COLORS if name != "green")
"""Colours of objects that are moved to a green target."""


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


WHITE = (1.0, 1.0, 1.0, 1.0)
"""Colour that leaves a mesh's own unchanged."""


@dataclass(frozen=True, kw_only=True)
class Thing:
    """A kind of object."""

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
    "cube": Thing(shape=_cube, yaw_symmetry=4),
    "block": Thing(shape=_box, yaw_symmetry=2),
    "cylinder": Thing(shape=_cylinder, yaw_symmetry=0),
    "jenga": Thing(shape=_jenga, yaw_symmetry=2, painted=False),
    "lego": Thing(shape=_lego, yaw_symmetry=4),
    "duck": Thing(shape=_duck, yaw_symmetry=1, painted=False),
    "mug": Thing(shape=_mug, yaw_symmetry=1),
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
