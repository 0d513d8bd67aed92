"""What a skill waits for: conditions that are asked once in every control step."""

from __future__ import annotations

import math
from collections.abc import Callable

from demorec.sim.world import World


def lasting(condition: Callable[[], bool], *, steps: int) -> Callable[[], bool]:
    """A condition that holds once another one has held for so many control steps in a row."""
    count = 0

    def done() -> bool:
        nonlocal count
        count = count + 1 if condition() else 0
        return count >= steps

    return done


def steady_width(world: World, *, tolerance: float = 0.006, seconds: float = 0.06) -> Callable[[], bool]:
    """A condition that holds once the opening has changed by less than `tolerance` (m/s) for some time."""
    last = math.inf

    def is_steady() -> bool:
        nonlocal last
        width = world.arm.gripper_width()
        change, last = abs(width - last) * world.fps, width
        return change < tolerance

    return lasting(is_steady, steps=max(1, round(seconds * world.fps)))
