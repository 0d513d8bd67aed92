"""Placing on a target mark: the named cube among others, any shape; and cubes in trays."""

from __future__ import annotations

from dataclasses import replace

from demorec.core.geometry import Pose
from demorec.episode.scene import Body, Goal, Shape
from demorec.extensions.tasks.things import OTHER_COLORS, THINGS, make_thing
from demorec.tasks.base import Layout, TableTask, on_table, random_cube, start_and_target
from demorec.tasks.furniture import COLORS, green_target
from demorec.tasks.sampling import Region, Sampler

CLUTTER = Region(x=(0.33, 0.68), y=(-0.30, 0.30))
OTHER_KINDS = ("block", "cylinder", "cube", "cube")
GAP = 0.115
"""Minimum distance between the centres of neighbours, metres: the open hand must fit between them."""
KINDS = tuple(kind for kind in THINGS if kind != "cube")
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
