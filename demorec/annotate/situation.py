"""The things of a scene as people speak of them: what they are called, how large they are and where they are."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from demorec.core.geometry import Array, Pose
from demorec.episode.scene import Goal, Scene
from demorec.episode.words import nouns_of

_AT_THE_PLACE = 0.01
"""How far, metres, the middle of a mark may be from a goal that is meant to be on it."""


@dataclass(frozen=True, kw_only=True, eq=False)
class NamedThing:
    """One body of the scene.

    Attributes:
        name: Of the body.
        nouns: What it may be called, the usual word first.
        color: The word for its colour, or "".
        size: Its largest extent, metres.
        position: (3,) of its middle in the robot's base frame (x forward, y to the left, z up), metres.
        height: Of its bounding box, metres.
        can_be_held: Whether it is movable.
    """

    name: str
    nouns: tuple[str, ...]
    color: str
    size: float
    position: Array
    height: float
    can_be_held: bool

    @property
    def noun(self) -> str:
        """The usual word."""
        return self.nouns[0]


@dataclass(frozen=True, kw_only=True, eq=False)
class Surroundings:
    """All things at one moment, the floor and what else only carries the scene left out."""

    things: tuple[NamedThing, ...]

    @cached_property
    def nouns(self) -> frozenset[str]:
        """What any of them may be called."""
        return frozenset(noun for thing in self.things for noun in thing.nouns)

    def thing(self, name: str) -> NamedThing:
        """The thing of that name; KeyError when there is none."""
        for thing in self.things:
            if thing.name == name:
                return thing
        raise KeyError(name)


def situation(scene: Scene, world_from_object: Mapping[str, Array] | None = None) -> Surroundings:
    """Return the objects of a scene at one moment.

    Args:
        scene: At the episode's start.
        world_from_object: Body -> (7,) pose (xyz, quaternion xyzw); the scene's own where left out.
    """
    moved = world_from_object or {}
    base_from_world = scene.robot.world_from_base.inverse()
    things = []
    for body in scene.bodies:
        if body.role == "fixture":
            continue
        place = moved[body.name][:3] if body.name in moved else body.world_from_body.position
        things.append(
            NamedThing(
                name=body.name,
                nouns=nouns_of(body),
                color=body.color_name,
                size=max(body.shape.extents),
                position=base_from_world.apply(place),
                height=body.shape.extents[2],
                can_be_held=body.movable,
            )
        )
    return Surroundings(things=tuple(things))


def place_of(scene: Scene, goal: Goal) -> str:
    """Name of the body that a goal puts its object onto or into, a mark at its place, or ""."""
    if goal.onto:
        return goal.onto
    wanted: Pose = scene.world_from_goal(goal)
    for body in scene.bodies:
        offset = np.abs(body.world_from_body.position[:2] - wanted.position[:2])
        if body.role == "target" and bool((offset < _AT_THE_PLACE).all()):
            return body.name
    return ""
