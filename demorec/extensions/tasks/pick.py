"""Placing on a target mark: the named cube among others, any shape; and cubes in trays."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

from demorec.core.geometry import Pose
from demorec.episode.scene import Body, Goal, Role, Shape
from demorec.extensions.tasks.solid_physics import ROLLING_FRICTION
from demorec.tasks.base import Layout, TableTask, on_table, random_cube, start_and_target
from demorec.tasks.furniture import COLORS, green_target
from demorec.tasks.sampling import Region, Sampler

OTHER_COLORS = tuple(name for name in COLORS if name != "green")
"""Colours of objects that are moved to a green target."""
CLUTTER = Region(x=(0.33, 0.68), y=(-0.30, 0.30))
OTHER_KINDS = ("block", "cylinder", "cube", "cube")
GAP = 0.115
"""Minimum distance between the centres of neighbours, metres: the open hand must fit between them."""
TRAY_FLOOR = 0.004
"""Height of a tray's floor above its lower face, metres (tray.urdf)."""
IN_TRAY = (-0.13, -0.10, 0.13, 0.10)
"""Floor of a tray in its own frame: minimum x and y, maximum x and y, metres."""
CUBES = Region(x=(0.35, 0.65), y=(-0.25, 0.15))
TRAYS = Region(x=(0.40, 0.50), y=(0.36, 0.40))
"""Region of the tray's middle: its far corner must be within reach of a hand that points down."""
SORTED_CUBES = Region(x=(0.36, 0.65), y=(-0.19, 0.19))
TRAY_Y = 0.37
SLOTS = (-0.065, 0.065)
"""Positions along a tray's long side, metres: the open fingers must fit between a cube and its neighbour."""
COLOR_PAIRS = (("red", "blue"), ("green", "yellow"), ("red", "yellow"), ("blue", "green"))


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
        rolling_friction=ROLLING_FRICTION if shape.kind == "cylinder" else 0.0,
        rgba=COLORS[color_name] if thing.painted else (1.0, 1.0, 1.0, 1.0),  # white leaves a mesh its own colours
        color_name=color_name if thing.painted else "",
        yaw_symmetry=thing.yaw_symmetry,
    )


KINDS = tuple(kind for kind in THINGS if kind != "cube")


class PickFromClutter(TableTask):
    """Pick the cube of the named colour out of a clutter and place it on the mark.

    Task: three to five objects of other colours and shapes around the named cube, a square mark.
    Randomised: number and kinds of objects, their positions, yaws, sizes, masses and frictions; the named colour; the
        mark's position and yaw; the arm's initial joints.
    Success: the named cube's centre within 2 cm of the mark's, on the table, upright within 5 degrees, at rest, not
        touched; everything else within 2 cm of its initial position; the gripper open.
    """

    summary = "the cube of the named colour out of a clutter"
    wordings = (
        "pick the {thing} out of the clutter and place it on the green target",
        "find the {thing} and put it on the green target",
        "move only the {thing} to the green target",
    )

    def layout(self, sampler: Sampler) -> Layout:
        """Draw the clutter, the mark and the goal."""
        colors = [OTHER_COLORS[i] for i in sampler.rng.permutation(len(OTHER_COLORS))]
        start, yaw, place, place_yaw = start_and_target(sampler, "the wanted cube")
        wanted = make_thing(sampler, "cube", f"{colors[0]}_cube", start, yaw, color_name=colors[0], role="object")
        taken, others = [start, place], list[Body]()
        for index in range(int(sampler.rng.integers(3, 6))):
            kind = OTHER_KINDS[index % len(OTHER_KINDS)]
            point = sampler.point(CLUTTER, away_from=taken, min_distance=GAP, what="the clutter")
            taken.append(point)
            color = colors[1 + index % (len(colors) - 1)]
            name = f"{color}_{kind}" if index < len(OTHER_KINDS) else f"other_{color}_{kind}"
            others.append(make_thing(sampler, kind, name, point, sampler.yaw(), color_name=color, role="distractor"))
        return [green_target(place, place_yaw), wanted, *others], [on_table(wanted, place, place_yaw)]


class PickShapes(TableTask):
    """Pick up an object of any shape and place it on the mark.

    Task: one of a block, a cylinder, a wooden plank, a toy brick, a duck or a mug; a square mark on the table.
    Randomised: the object, its size, position, yaw, mass (20-150 g), friction (0.5-1.2) and colour unless it has a
        fixed one; the mark's position and yaw; the arm's initial joints.
    Success: the object's centre within 2 cm of the mark's, on the table, upright within 5 degrees, at rest, not
        touched, the gripper open.
    """

    summary = "blocks, cylinders and small household things to a mark"
    wordings = (
        "pick up the {thing} and place it on the green target",
        "put the {thing} on the green target",
        "move the {thing} to the green target",
    )

    def layout(self, sampler: Sampler) -> Layout:
        """Draw the object, the mark and the goal."""
        kind = sampler.choice(KINDS)
        color = sampler.choice(OTHER_COLORS)
        start, yaw, place, place_yaw = start_and_target(sampler, "the thing")
        name = f"{color}_{kind}" if THINGS[kind].painted else kind
        thing = make_thing(sampler, kind, name, start, yaw, color_name=color, role="object")
        target = green_target(place, place_yaw, side=0.10)
        return [target, thing], [on_table(thing, place, place_yaw, yaw_symmetry=0)]


def tray(name: str, point: tuple[float, float], yaw: float, *, color_name: str) -> Body:
    """Make a fixed shallow tray, its long side (0.27 m) along x at yaw 0."""
    # Paler than the cubes, so that a cube is visible on a tray of the same colour.
    red, green, blue = (0.55 * channel + 0.45 * 0.92 for channel in COLORS[color_name][:3])
    return Body(
        name=name,
        role="target",
        shape=Shape(kind="urdf", file="demorec:tray.urdf", size=(0.27, 0.21, 0.019)),
        world_from_body=Pose.from_yaw((point[0], point[1], 0.0005), yaw),
        lateral_friction=0.6,
        rgba=(red, green, blue, 1.0),
        color_name=color_name,
        yaw_symmetry=2,
    )


def into_tray(cube: Body, target: Body, *, along: float = 0.0) -> Goal:
    """Make the goal of a cube in a tray; it is placed at the middle of the long axis, or `along` it, metres."""
    pose = Pose.from_yaw((along, 0.0, TRAY_FLOOR + cube.shape.size[2] / 2))
    return Goal(object=cube.name, onto=target.name, onto_from_goal=pose, area=IN_TRAY)


class PlaceInTray(TableTask):
    """Pick up the cube and place it in the tray.

    Task: one cube on the table, one shallow tray on the robot's left.
    Randomised: the cube's position (0.30 x 0.40 m), yaw, size (3-6 cm), mass (20-200 g), friction (0.4-1.2) and the
        tray's position and yaw (within 0.25 rad); the arm's initial joints.
    Success: the cube in the tray, on its floor, upright within 5 degrees, at rest, not touched, the gripper open.
    """

    summary = "a cube into a tray"
    wordings = (
        "pick up the {moved[0]} cube and put it into the {bases[0]} tray",
        "put the {moved[0]} cube in the {bases[0]} tray",
        "place the {moved[0]} cube inside the {bases[0]} tray",
    )

    def layout(self, sampler: Sampler) -> Layout:
        """Draw the cube, the tray and the goal."""
        point = sampler.point(CUBES, what="the cube")
        yaw = sampler.yaw()
        body = random_cube(sampler, "red", point, yaw, sides=(0.03, 0.06))
        place = sampler.point(TRAYS, what="the tray")
        target = tray("blue_tray", place, sampler.uniform(-0.25, 0.25), color_name="blue")
        return [target, body], [into_tray(body, target)]


class SortByColor(TableTask):
    """Put every cube into the tray of its colour.

    Task: two to four cubes of two colours, two trays, one on each side.
    Randomised: number of cubes, colours, which tray is left; positions, yaws, sizes (3-4.5 cm), masses (20-200 g),
        frictions (0.4-1.2); the trays' positions along the table; the arm's initial joints.
    Success: each cube in the tray of its colour, on its floor, upright within 5 degrees, at rest, not touched; the
        gripper open.
    """

    summary = "two to four cubes into the trays of their colours"
    wordings = (
        "sort the cubes into the trays of their colors",
        "put every {targets[0]} cube into the {targets[0]} tray and every {targets[1]} cube into the {targets[1]} tray",
        "sort the {targets[0]} and {targets[1]} cubes by color",
    )

    def layout(self, sampler: Sampler) -> Layout:
        """Draw the cubes, the trays and the goals."""
        colors = sampler.choice(COLOR_PAIRS)
        if sampler.uniform(0.0, 1.0) < 0.5:
            colors = (colors[1], colors[0])
        counts = sampler.choice([(1, 1), (2, 1), (1, 2), (2, 2)])
        trays = [
            tray(f"{color}_tray", (sampler.uniform(0.36, 0.44), side * TRAY_Y), 0.0, color_name=color)
            for color, side in zip(colors, (1, -1), strict=True)
        ]
        cubes: list[Body] = []
        goals: list[Goal] = []
        points: list[tuple[float, float]] = []
        for color, count, target in zip(colors, counts, trays, strict=True):
            for slot in range(count):
                point = sampler.point(SORTED_CUBES, away_from=points, min_distance=0.12, what="a cube")
                points.append(point)
                body = random_cube(sampler, color, point, sampler.yaw(), sides=(0.03, 0.045))
                body = replace(body, name=f"{color}_cube_{slot + 1}")
                cubes.append(body)
                goals.append(into_tray(body, target, along=SLOTS[slot] if count > 1 else 0.0))
        return [*trays, *cubes], goals
