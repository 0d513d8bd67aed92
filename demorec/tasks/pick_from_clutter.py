"""The named cube among other things."""

from __future__ import annotations

from demorec.episode.scene import Body
from demorec.tasks.furniture import COLORS, mark
from demorec.tasks.placing import Layout, TableTask, on_table
from demorec.tasks.sampling import WORKSPACE, Region, Sampler
from demorec.tasks.things import make_thing

CLUTTER = Region(x=(0.33, 0.68), y=(-0.30, 0.30))
OTHER_KINDS = ("block", "cylinder", "cube", "cube")
GAP = 0.115
"""Between the centres of neighbours, metres: the open hand must fit between them."""


class PickFromClutter(TableTask):
    """Pick the cube of the named colour out of a clutter and place it on the mark.

    Task: three to five things of other colours and shapes around the wanted cube, a square mark.
    Randomised: how many things, which, their places, yaws, sizes, masses and frictions; the wanted colour; the
        mark's place and yaw; the arm's initial joints.
    Success: the wanted cube's centre within 2 cm of the mark's, on the table, upright within 5 degrees, at rest,
        not touched; everything else within 2 cm of where it was; the gripper open.
    """

    summary = "the cube of the named colour out of a clutter"
    wordings = (
        "pick the {thing} out of the clutter and place it on the green target",
        "find the {thing} and put it on the green target",
        "move only the {thing} to the green target",
    )

    def layout(self, sampler: Sampler) -> Layout:
        """Draw it."""
        colors = [name for name in COLORS if name != "green"]
        order = sampler.rng.permutation(len(colors))
        colors = [colors[i] for i in order]
        start = sampler.point(WORKSPACE, what="the wanted cube")
        yaw = sampler.yaw()
        place = sampler.point(WORKSPACE, away_from=[start], min_distance=0.14, what="the target")
        place_yaw = sampler.yaw()
        wanted = make_thing(sampler, "cube", f"{colors[0]}_cube", start, yaw, color_name=colors[0], role="object")
        taken, others = [start, place], list[Body]()
        for index in range(int(sampler.rng.integers(3, 6))):
            kind = OTHER_KINDS[index % len(OTHER_KINDS)]
            point = sampler.point(CLUTTER, away_from=taken, min_distance=GAP, what="the clutter")
            taken.append(point)
            color = colors[1 + index % (len(colors) - 1)]
            name = f"{color}_{kind}" if index < len(OTHER_KINDS) else f"other_{color}_{kind}"
            others.append(make_thing(sampler, kind, name, point, sampler.yaw(), color_name=color, role="distractor"))
        target = mark("green_target", place, place_yaw, side=0.08, color_name="green")
        return [target, wanted, *others], [on_table(wanted, place, place_yaw)]
