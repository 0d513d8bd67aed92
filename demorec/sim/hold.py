"""Holding by a rigid constraint instead of friction: the shortcut of many PyBullet tutorials.

What happens depends on the world's state and the commands alone, so that a recording replays without being told
when the constraint was made.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from demorec.sim.arm import Arm


class ConstraintHold:
    """Fixes a body to the hand while both fingers press on it, until the gripper is told to open.

    Args:
        client: The PyBullet client.
        arm: The robot.
        bodies: PyBullet indices of what may be held.
    """

    def __init__(self, client: Any, arm: Arm, bodies: Sequence[int]) -> None:
        self._client = client
        self._arm = arm
        self._bodies = tuple(bodies)
        self._constraint: int | None = None

    def update(self, *, opens: bool) -> None:
        """Make or release the constraint; called before each command with whether it opens the gripper further."""
        if opens:
            if self._constraint is not None:
                self._client.removeConstraint(self._constraint)
                self._constraint = None
        elif self._constraint is None:
            body = next((body for body in self._bodies if self._is_pressed(body)), None)
            if body is not None:
                self._constraint = self._fix(body)

    def _is_pressed(self, body: int) -> bool:
        return all(self._client.getContactPoints(self._arm.body, body, link, -1) for link in self._arm.finger_links)

    def _fix(self, body: int) -> int:
        link = self._arm.links[self._arm.spec.tcp_link]
        hand = self._client.getLinkState(self._arm.body, link, computeForwardKinematics=True)
        place = self._client.getBasePositionAndOrientation(body)
        # The constraint's frames are those of the centres of mass: [0:2] of a link state.
        position, quat = self._client.multiplyTransforms(*self._client.invertTransform(*hand[0:2]), *place)
        return int(
            self._client.createConstraint(
                self._arm.body,
                link,
                body,
                -1,
                self._client.JOINT_FIXED,
                [0, 0, 0],
                position,
                [0, 0, 0],
                quat,
            )
        )
