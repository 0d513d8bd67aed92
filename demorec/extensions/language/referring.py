"""Objects of a scene, phrases that refer to them ("the smaller red cube"), and the resolver of such phrases.

The resolver sees only the words and the scene, not the source of a phrase. A phrase refers to an object only by a clear
margin, so that none depends on a millimetre. Left and right are the robot's: it looks along its base frame's x axis,
and left is +y.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from demorec.core.geometry import Array
from demorec.episode.scene import Body, Goal, Scene
from demorec.episode.words import COLOR_WORDS, NOUNS, VESSELS

MIN_GAP = 0.04
"""Minimum distance, metres, by which an object must be farther to a side, or nearer, than the next one."""
MIN_SIZE_RATIO = 1.15
"""Minimum ratio by which an object must be larger than the next one."""
_AT_THE_PLACE = 0.01
"""Maximum distance, metres, of a mark's centre from a goal on that mark."""

_SYNONYMS: Mapping[str, tuple[str, ...]] = {
    "target": ("target", "mark", "square"),
    "mark": ("mark", "target", "square"),
}

_IN_FRONT = ("left", "right", "leftmost", "rightmost", "middle", "smaller", "larger", "smallest", "largest")
_BEHIND = ("nearest to the robot", "farthest from the robot")


def nouns_of(body: Body) -> tuple[str, ...]:
    """Return the nouns for a body, the usual one first: from its name, less colour and number, and from its shape."""
    words = [word for word in body.name.split("_") if not word.isdigit() and word not in (*COLOR_WORDS, "other")]
    noun = " ".join(NOUNS.get(word, word) for word in words) or "object"
    nouns = _SYNONYMS.get(noun, (noun,))
    x, y, z = body.shape.extents
    if body.movable and body.shape.kind == "box":
        nouns += ("cube",) if max(x, y, z) < 1.05 * min(x, y, z) else ("block",)
    elif body.movable and body.shape.kind in ("cylinder", "sphere", "capsule"):
        nouns += (body.shape.kind,)
    return tuple(dict.fromkeys(nouns))


class NamedThing(NamedTuple):
    """One body of the scene at one moment."""

    body: Body
    nouns: tuple[str, ...]  # possible nouns, the usual one first
    position: Array  # (3,) centre in the robot's base frame (x forward, y left, z up), metres

    @property
    def words(self) -> str:
        """Its colour and usual noun."""
        return f"{self.body.color_name} {self.nouns[0]}".strip()


Surroundings = Mapping[str, NamedThing]
"""All bodies at one moment, by name, except the floor and other fixtures."""


def situation(scene: Scene, world_from_object: Mapping[str, Array] | None = None) -> Surroundings:
    """Return the objects of a scene at one moment.

    `world_from_object` has body -> (7,) pose (xyz, quaternion xyzw); bodies left out keep the scene's pose.
    """
    places = {body.name: body.world_from_body.position for body in scene.bodies}
    places |= {name: pose[:3] for name, pose in (world_from_object or {}).items()}
    base_from_world = scene.robot.world_from_base.inverse()
    return {
        body.name: NamedThing(body, nouns_of(body), base_from_world.apply(places[body.name]))
        for body in scene.bodies
        if body.role != "fixture"
    }


def place_of(scene: Scene, goal: Goal) -> str:
    """Name of the body on or in which a goal puts its object, such as a mark, or ""."""
    if goal.onto:
        return goal.onto
    wanted = scene.world_from_goal(goal).position
    for body in scene.bodies:
        offset = np.abs(body.world_from_body.position[:2] - wanted[:2])
        if body.role == "target" and bool((offset < _AT_THE_PLACE).all()):
            return body.name
    return ""


def prepositions(scene: Scene, place: str) -> tuple[str, str]:
    """("into", "in") for a container, ("to", "at") for a place without an object, ("onto", "on") otherwise."""
    if not place:
        return "to", "at"
    return ("into", "in") if nouns_of(scene.body(place))[0] in VESSELS else ("onto", "on")


def resolve(phrase: str, situation: Surroundings) -> frozenset[str]:
    """Names of the objects that a phrase refers to: one for "the ...", all matching ones for "every ...".

    Empty if the phrase does not fit the grammar, or is ambiguous. Grammar: ARTICLE [ORDER] [COLOUR] NOUN [nearest to
    the robot | farthest from the robot], where ARTICLE is "the" or "every".
    """
    match = _grammar(situation).fullmatch(phrase.strip().lower())
    return frozenset() if match is None else _resolved(match, situation)


def references(text: str, situation: Surroundings) -> Iterator[frozenset[str]]:
    """Yield the objects that each phrase of a text refers to; an ambiguous phrase has none."""
    for match in _grammar(situation).finditer(text.lower()):
        yield _resolved(match, situation)


def phrases_for(name: str, situation: Surroundings) -> Iterator[str]:
    """Yield every phrase of the grammar that refers to this object alone, the simplest with a colour first."""
    thing = situation[name]
    color = thing.body.color_name
    for noun in thing.nouns:
        for colored in ([f"{color} {noun}"] if color else []) + [noun]:
            plain = f"the {colored}"
            if resolve(plain, situation) == {name}:  # if the plain noun is unambiguous, longer phrases are unnatural
                yield plain
                continue
            candidates = [f"the {order} {colored}" for order in _IN_FRONT]
            candidates += [f"the {colored} {order}" for order in _BEHIND]
            yield from (candidate for candidate in candidates if resolve(candidate, situation) == {name})


def phrase_for(name: str, situation: Surroundings) -> str:
    """The simplest phrase for an object; "a red cube" if none is unambiguous."""
    words = situation[name].words
    return next(phrases_for(name, situation), f"{'an' if words[0] in 'aeiou' else 'a'} {words}")


def joined(parts: Sequence[str]) -> str:
    """Join words as "a", "a and b", "a, b and c"."""
    return parts[0] if len(parts) == 1 else f"{', '.join(parts[:-1])} and {parts[-1]}"


def _grammar(situation: Surroundings) -> re.Pattern[str]:
    return _grammar_of(frozenset(noun for thing in situation.values() for noun in thing.nouns))


@lru_cache(maxsize=64)
def _grammar_of(known: frozenset[str]) -> re.Pattern[str]:
    nouns = "|".join(sorted((re.escape(noun) for noun in known), key=len)[::-1])
    return re.compile(
        rf"\b(?P<article>the|every) (?:(?P<order>{'|'.join(_IN_FRONT)}) )?(?:(?P<color>{'|'.join(COLOR_WORDS)}) )?"
        rf"(?P<noun>{nouns})\b(?: (?P<behind>{'|'.join(_BEHIND)})\b)?"
    )


def _resolved(match: re.Match[str], situation: Surroundings) -> frozenset[str]:
    fitting = [
        thing
        for thing in situation.values()
        if match["noun"] in thing.nouns and match["color"] in (None, thing.body.color_name)
    ]
    if match["article"] == "every":
        return frozenset(thing.body.name for thing in fitting)
    for order in (match["order"], match["behind"]):
        if order is not None:
            fitting = _ordered(order, fitting)
    return frozenset({fitting[0].body.name} if len(fitting) == 1 else ())


def _ordered(order: str, things: Sequence[NamedThing]) -> list[NamedThing]:
    """The first object in an order; empty if it is not first by the margin, or there are too few objects."""
    if order == "middle":
        return _middle(things)
    at_least, at_most, sign, measure, margin = _ORDERS[order]
    if not at_least <= len(things) <= at_most:
        return []
    return _first(things, lambda thing: sign * measure(thing), margin)


def _first(things: Sequence[NamedThing], value: Callable[[NamedThing], float], margin: float) -> list[NamedThing]:
    """The object with the smallest value; empty if the next one is not larger by the margin."""
    ordered = sorted(things, key=value)
    return ordered[:1] if value(ordered[1]) - value(ordered[0]) >= margin else []


def _middle(things: Sequence[NamedThing]) -> list[NamedThing]:
    """The middle one of three objects in a row."""
    if len(things) != 3:
        return []

    def detour(thing: NamedThing) -> float:
        """Extra length of the path between the other two if it passes this one, metres."""
        a, b = (other.position[:2].tolist() for other in things if other is not thing)
        here = thing.position[:2].tolist()
        return math.dist(a, here) + math.dist(here, b) - math.dist(a, b)

    chosen = _first(things, detour, MIN_GAP)
    return chosen if chosen and detour(chosen[0]) < MIN_GAP else []


def _leftward(thing: NamedThing) -> float:
    return float(thing.position[1])


def _size(thing: NamedThing) -> float:
    return math.log(max(thing.body.shape.extents))


def _distance(thing: NamedThing) -> float:
    return math.hypot(*thing.position[:2].tolist())


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
"""Word -> minimum and maximum number of objects to which it applies; whether the smallest (1) or largest (-1) value is
chosen, and of which quantity; and the margin.
"""
