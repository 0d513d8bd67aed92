"""Somebody interrupts: the expert goes for the wrong thing, is corrected, and does what was meant."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from demorec.core.geometry import Array
from demorec.episode.episode import CORRECTED_PHASE, INTERJECTION_EVENT, MISTAKEN_PHASE
from demorec.episode.scene import Scene
from demorec.tasks.grasping import hand_down, hand_yaw
from demorec.tasks.script import Step
from demorec.tasks.skills import FREE_SPEED, Expert, GaveUp

_SHARES = (0.4, 0.9)
"""Of the way to the wrong thing, after which the correction comes."""
_LISTENING_SECONDS = 0.4
"""How long the arm is held after it: it comes to rest."""


@dataclass(frozen=True, kw_only=True)
class Interjection:
    """What is mistaken, and when that is said.

    Attributes:
        wanted: Name of the first goal's object.
        mistaken: Name of the thing that the expert goes for at first.
        share: Of the way to it, after which the correction comes.
    """

    wanted: str
    mistaken: str
    share: float


def draw_interjection(scene: Scene, rng: np.random.Generator) -> Interjection | None:
    """One of the things that no goal moves is taken for the first goal's object; None where there is no such thing."""
    wanted = {goal.object for goal in scene.goals}
    others = [body.name for body in scene.movable if body.name not in wanted]
    if not wanted or not others:
        return None
    chosen = others[int(rng.integers(len(others)))]
    return Interjection(wanted=scene.goals[0].object, mistaken=chosen, share=float(rng.uniform(*_SHARES)))


def mistake(expert: Expert, interjection: Interjection) -> Iterator[Step]:
    """Go for the wrong thing, be corrected, stop; nothing at all where the hand does not reach above that thing."""
    thing = expert.world.pose(interjection.mistaken).position
    above = hand_down(thing + np.array([0.0, 0.0, expert.behaviour.approach_height]), hand_yaw(expert.tcp()))
    left = (1.0 - interjection.share) * math.dist(expert.tcp().position, above.position)
    expert.phase = MISTAKEN_PHASE
    expert.gripper_target = expert.open_width
    before: Array = expert.joint_target
    velocity: Array = np.zeros(len(before))
    try:
        for step in expert.move(above, speed=FREE_SPEED, free=True):
            before, velocity = expert.joint_target, expert.joint_target - before
            yield step
            if math.dist(expert.tcp().position, above.position) < left:
                break
    except GaveUp:
        return
    expert.note(INTERJECTION_EVENT, f"{interjection.wanted} is meant, not {interjection.mistaken}")
    expert.phase = CORRECTED_PHASE
    yield from _brake(expert, velocity)


def _brake(expert: Expert, velocity: Array) -> Iterator[Step]:
    """Bring the arm to rest within half of the acceleration that a motion has, and hold it; velocity in rad a frame."""
    dt = 1.0 / expert.world.fps
    most = 0.5 * expert.reach.limits.joint_acceleration * dt * dt
    count = max(1, math.ceil(float((np.abs(velocity) / most).max())))
    for number in range(1, count + 1):
        expert.joint_target = expert.joint_target + velocity * (1.0 - number / count)
        yield expert.step()
    for _ in range(max(1, round(_LISTENING_SECONDS / dt) - count)):
        yield expert.step()
