"""The task of placing a cube on a target mark."""

from __future__ import annotations

from demorec.tasks.base import Layout, TableTask, on_table, random_cube, start_and_target
from demorec.tasks.furniture import green_target
from demorec.tasks.sampling import Sampler


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
