"""Placing of one object on a target mark on the table: a cube, the named cube among others, any shape."""

from __future__ import annotations

from demorec.episode.scene import Body
from demorec.tasks.furniture import OTHER_COLORS, THINGS, green_target, make_thing
from demorec.tasks.placing import Layout, TableTask, on_table, random_cube, start_and_target
from demorec.tasks.sampling import Region, Sampler

CLUTTER = Region(x=(0.33, 0.68), y=(-0.30, 0.30))
OTHER_KINDS = ("block", "cylinder", "cube", "cube")
GAP = 0.115
"""Minimum distance between the centres of neighbours, metres: the open hand must fit between them."""
KINDS = tuple(kind for kind in THINGS if kind != "cube")


class PickPlace(TableTask):
    """Pick up the cube and place it on the mark.

    Task: one cube, one square mark on the table.
    Randomised: the cube's position (0.30 x 0.50 m), yaw, size (3-6 cm), mass (20-200 g) and friction (0.4-1.2); the
        mark's position and yaw, at least 12 cm from the cube; the arm's initial joints (0.05 rad).
    Success: the cube's centre within 2 cm of the mark's, on the table, upright within 5 degrees, at rest (1 cm/s, 0.1
        rad/s), not touched, the gripper open; other objects (a variation) undisturbed.
    """

    summary = "a cube to a target mark on the table"
    wordings = (
        "pick up the {moved[0]} cube and place it on the {targets[0]} target",
        "put the {moved[0]} cube on the {targets[0]} target",
        "move the {moved[0]} cube to the {targets[0]} target",
    )

    def layout(self, sampler: Sampler) -> Layout:
        """Draw the cube, the mark and the goal."""
        start, yaw, place, place_yaw = start_and_target(sampler, "the cube", apart=0.12)
        body = random_cube(sampler, "red", start, yaw, sides=(0.03, 0.06))
        return [green_target(place, place_yaw), body], [on_table(body, place, place_yaw)]


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
