"""Things of a scene, phrases that refer to them ("the smaller red cube"), and the resolver of such phrases.

The resolver reads words alone and looks at the scene; it knows nothing of who made a phrase and why. What cannot be
told apart by a clear margin refers to nothing, so that no phrase leans on a millimetre. Left and right are the
robot's: it looks along the x axis of its base frame, left is +y.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from demorec.core.geometry import Array, Pose
from demorec.episode.scene import Goal, Scene
from demorec.episode.words import COLOR_WORDS, nouns_of

MIN_GAP = 0.04
"""By how much, metres, one thing must be farther to a side, or nearer, than the next one to be called so."""
MIN_SIZE_RATIO = 1.15
"""By what factor one thing must be larger than the next one to be called so."""
_AT_THE_PLACE = 0.01
"""How far, metres, the middle of a mark may be from a goal that is meant to be on it."""

_IN_FRONT = ("left", "right", "leftmost", "rightmost", "middle", "smaller", "larger", "smallest", "largest")
_BEHIND = ("nearest to the robot", "farthest from the robot")


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


def resolve(phrase: str, situation: Surroundings) -> frozenset[str]:
    """Names of the things that a phrase refers to: one for "the ...", all that fit for "every ...".

    Nothing when the phrase is none of this grammar, or when it could mean several things: ARTICLE [ORDER] [COLOUR]
    NOUN [nearest to the robot | farthest from the robot], where ARTICLE is "the" or "every".
    """
    match = _grammar(situation.nouns).fullmatch(phrase.strip().lower())
    return frozenset() if match is None else _resolved(match, situation)


def references(text: str, situation: Surroundings) -> Iterator[tuple[str, frozenset[str]]]:
    """Each phrase of a text that refers to something, and what it refers to; nothing where that is unclear."""
    for match in _grammar(situation.nouns).finditer(text.lower()):
        yield match[0], _resolved(match, situation)


def phrases_for(name: str, situation: Surroundings) -> Iterator[str]:
    """Every phrase of the grammar that refers to this thing and nothing else; the plainest with a colour come first."""
    thing = situation.thing(name)
    for noun in thing.nouns:
        for colored in ([f"{thing.color} {noun}"] if thing.color else []) + [noun]:
            plain = f"the {colored}"
            if resolve(plain, situation) == {name}:  # where the plain words suffice, nobody says more
                yield plain
                continue
            candidates = [f"the {order} {colored}" for order in _IN_FRONT]
            candidates += [f"the {colored} {order}" for order in _BEHIND]
            for candidate in candidates:
                if resolve(candidate, situation) == {name}:
                    yield candidate


def phrase_for(name: str, situation: Surroundings) -> str:
    """The plainest phrase for a thing; "a red cube" where none tells it from the others."""
    for found in phrases_for(name, situation):
        return found
    thing = situation.thing(name)
    words = f"{thing.color} {thing.noun}".strip()
    return f"{'an' if words[0] in 'aeiou' else 'a'} {words}"


@lru_cache(maxsize=64)
def _grammar(known: frozenset[str]) -> re.Pattern[str]:
    nouns = "|".join(sorted((re.escape(noun) for noun in known), key=len)[::-1])
    return re.compile(
        rf"\b(?P<article>the|every) (?:(?P<order>{'|'.join(_IN_FRONT)}) )?(?:(?P<color>{'|'.join(COLOR_WORDS)}) )?"
        rf"(?P<noun>{nouns})\b(?: (?P<behind>{'|'.join(_BEHIND)})\b)?"
    )


def _resolved(match: re.Match[str], situation: Surroundings) -> frozenset[str]:
    fitting = [
        thing
        for thing in situation.things
        if match["noun"] in thing.nouns and (match["color"] is None or thing.color == match["color"])
    ]
    if match["article"] == "every":
        return frozenset(thing.name for thing in fitting)
    for order in (match["order"], match["behind"]):
        if order is not None:
            fitting = _ordered(order, fitting)
    return frozenset({fitting[0].name} if len(fitting) == 1 else ())


def _ordered(order: str, things: Sequence[NamedThing]) -> list[NamedThing]:
    """The one thing that is first in an order; none when it is not so by the margin, or when there are too few."""
    if order == "middle":
        return _middle(things)
    at_least, at_most, sign, measure, margin = _ORDERS[order]
    if not at_least <= len(things) <= at_most:
        return []
    return _first(things, lambda thing: sign * measure(thing), margin)


def _first(things: Sequence[NamedThing], value: Callable[[NamedThing], float], margin: float) -> list[NamedThing]:
    """The one of the smallest value, or none when the next one is not larger by the margin."""
    ordered = sorted(things, key=value)
    return ordered[:1] if value(ordered[1]) - value(ordered[0]) >= margin else []


def _middle(things: Sequence[NamedThing]) -> list[NamedThing]:
    """Of three in a row: the one between the others."""
    if len(things) != 3:
        return []

    def detour(thing: NamedThing) -> float:
        """How much longer the way between the other two is by way of this one, metres."""
        a, b = (other.position[:2].tolist() for other in things if other is not thing)
        here = thing.position[:2].tolist()
        return math.dist(a, here) + math.dist(here, b) - math.dist(a, b)

    chosen = _first(things, detour, MIN_GAP)
    return chosen if chosen and detour(chosen[0]) < MIN_GAP else []


def _leftward(thing: NamedThing) -> float:
    return float(thing.position[1])


def _size(thing: NamedThing) -> float:
    return math.log(thing.size)


def _distance(thing: NamedThing) -> float:
    return math.hypot(float(thing.position[0]), float(thing.position[1]))


_RATIO = math.log(MIN_SIZE_RATIO)
_ORDERS: dict[str, tuple[int, float, int, Callable[[NamedThing], float], float]] = {
    "left": (2, 2, -1, _leftward, MIN_GAP),
    "right": (2, 2, 1, _leftward, MIN_GAP),
    "leftmost": (3, math.inf, -1, _leftward, MIN_GAP),
    "rightmost": (3, math.inf, 1, _leftward, MIN_GAP),
    "smaller": (2, 2, 1, _size, _RATIO),
    "larger": (2, 2, -1, _size, _RATIO),
    "smallest": (3, math.inf, 1, _size, _RATIO),
    "largest": (3, math.inf, -1, _size, _RATIO),
    "nearest to the robot": (2, math.inf, 1, _distance, MIN_GAP),
    "farthest from the robot": (2, math.inf, -1, _distance, MIN_GAP),
}
"""Word -> of how many things it is said, at least and at most; whether the chosen one has least (1) or most (-1) of
what; and by how much."""
