"""Things of many shapes, small household meshes among them, go to a mark."""

from __future__ import annotations

from demorec.tasks.furniture import COLORS, mark
from demorec.tasks.placing import Layout, TableTask, on_table
from demorec.tasks.sampling import WORKSPACE, Sampler
from demorec.tasks.things import THINGS, make_thing

KINDS = tuple(kind for kind in THINGS if kind != "cube")


class PickShapes(TableTask):
    """Pick up a thing of any shape and place it on the mark.

    Task: one of a block, a cylinder, a wooden plank, a toy brick, a duck or a mug; a square mark on the table.
    Randomised: which thing, its size, place, yaw, mass (20-150 g), friction (0.5-1.2) and colour where it has
        none of its own; the mark's place and yaw; the arm's initial joints.
    Success: the thing's centre within 2 cm of the mark's, on the table, upright within 5 degrees, at rest, not
        touched, the gripper open.
    """

    summary = "blocks, cylinders and small household things to a mark"
    wordings = (
        "pick up the {thing} and place it on the green target",
        "put the {thing} on the green target",
        "move the {thing} to the green target",
    )

    def layout(self, sampler: Sampler) -> Layout:
        """Draw it."""
        kind = sampler.choice(KINDS)
        color = sampler.choice([name for name in COLORS if name != "green"])
        start = sampler.point(WORKSPACE, what="the thing")
        yaw = sampler.yaw()
        place = sampler.point(WORKSPACE, away_from=[start], min_distance=0.14, what="the target")
        place_yaw = sampler.yaw()
        name = f"{color}_{kind}" if THINGS[kind].painted else kind
        thing = make_thing(sampler, kind, name, start, yaw, color_name=color, role="object")
        target = mark("green_target", place, place_yaw, side=0.10, color_name="green")
        return [target, thing], [on_table(thing, place, place_yaw, yaw_symmetry=0)]
