"""Somebody who presses keys to do a pick_place, watching the scene: LeRobot's `keyboard` hears them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np

from demorec.core.geometry import Array
from demorec.episode.scene import yaw_of
from demorec.tasks.grasping import hand_yaw
from lerobot_robot_demorec import DemorecSO101

Press = Callable[[str, bool], None]
"""Presses a key (True) or lets it go."""

NEAR, ALIGNED = 0.003, 0.03
"""Metres beside a place, rad beside a direction, at which a key is let go."""
WAYS = (("w", "s"), ("a", "d"), ("r", "f"), ("q", "e"))
"""Keys that move the hand along x, y, z and turn it, forth and back."""
OPEN, CLOSE = "o", "c"
HIGH, LOW = 0.06, 0.012
"""Of the TCP above the table, metres."""
PATIENCE = 150
"""Control steps."""


class KeyboardOperator:
    """Holds keys down until the hand is where it shall be.

    Args:
        robot: The arm in its scene of pick_place.
        press: How a key is pressed.
    """

    def __init__(self, robot: DemorecSO101, press: Press) -> None:
        self._world, self._press = robot._env.world, press
        self._held: set[str] = set()
        self._plan = self._steps()

    def look(self) -> bool:
        """Look at the scene and press or let go of keys; whether there is more to do."""
        wanted = next(self._plan, None)
        keys = wanted or set()
        for key in sorted(self._held ^ keys):
            self._press(key, key in keys)
        self._held = set(keys)
        return wanted is not None

    def _steps(self) -> Iterator[set[str]]:
        world = self._world
        goal = world.scene.goals[0]
        width = world.body(goal.object).shape.size[0]

        def above() -> Array:
            """Where the fixed finger comes down beside the cube."""
            hand = world.arm.world_from_tcp()
            return world.pose(goal.object).position - world.robot.gripper.object_offset(width) * hand.rotation[:, 1]

        def with_cube() -> Array:
            """Where the hand brings what it holds to its goal."""
            return goal.onto_from_goal.position + self._hand() - world.pose(goal.object).position

        yield from self._go(self._hand, HIGH)
        yield from self._turn(yaw_of(world.pose(goal.object)))
        yield from self._go(above, HIGH)
        yield from self._go(above, max(LOW, world.pose(goal.object).position[2]))
        yield from ({CLOSE} for _ in range(25))
        yield from self._go(self._hand, HIGH)
        yield from self._go(with_cube, HIGH)
        yield from self._go(with_cube, float(with_cube()[2]) + 0.001)
        yield from ({OPEN} for _ in range(25))
        yield from self._go(self._hand, HIGH)
        yield from (set() for _ in range(10))

    def _hand(self) -> Array:
        return np.asarray(self._world.arm.world_from_tcp().position)

    def _turn(self, yaw: float) -> Iterator[set[str]]:
        """Until the fingers close over two faces of a cube."""
        for _ in range(PATIENCE):
            off = math.remainder(yaw - hand_yaw(self._world.arm.world_from_tcp()), math.pi / 2)
            if abs(off) < ALIGNED:
                return
            yield {WAYS[3][0 if off > 0 else 1]}

    def _go(self, place: Callable[[], Array], height: float) -> Iterator[set[str]]:
        """To x and y of a place, seen again at every step, and to a height."""
        for _ in range(PATIENCE):
            off = np.array([*place()[:2], height]) - self._hand()
            keys = {ways[0 if away > 0 else 1] for ways, away in zip(WAYS, off, strict=False) if abs(away) > NEAR}
            if not keys:
                return
            yield keys
