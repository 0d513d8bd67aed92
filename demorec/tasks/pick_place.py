"""A cube goes to a target mark on the table."""

from __future__ import annotations

from demorec.tasks.furniture import mark
from demorec.tasks.placing import Layout, TableTask, on_table, random_cube
from demorec.tasks.sampling import WORKSPACE, Sampler


class PickPlace(TableTask):
    """Pick up the cube and place it on the mark.

    Task: one cube, one square mark on the table.
    Randomised: the cube's place (0.30 x 0.50 m), yaw, size (3-6 cm), mass (20-200 g) and friction (0.4-1.2); the
        mark's place and yaw, 12 cm from the cube or more; the arm's initial joints (0.05 rad).
    Success: the cube's centre within 2 cm of the mark's, on the table, upright within 5 degrees, at rest
        (1 cm/s, 0.1 rad/s), not touched, the gripper open; what else stands there (a variation) has stayed.
    """

    summary = "a cube to a target mark on the table"
    wordings = (
        "pick up the {moved[0]} cube and place it on the {targets[0]} target",
        "put the {moved[0]} cube on the {targets[0]} target",
        "move the {moved[0]} cube to the {targets[0]} target",
    )

    def layout(self, sampler: Sampler) -> Layout:
        """Draw it."""
        start = sampler.point(WORKSPACE, what="the cube")
        cube_yaw = sampler.yaw()
        place = sampler.point(WORKSPACE, away_from=[start], min_distance=0.12, what="the target")
        place_yaw = sampler.yaw()
        body = random_cube(sampler, "red", start, cube_yaw, sides=(0.03, 0.06))
        target = mark("green_target", place, place_yaw, side=0.08, color_name="green")
        return [target, body], [on_table(body, place, place_yaw)]
