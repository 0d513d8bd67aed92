"""Names of the elements of a vector, in all known notations."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence

_SUFFIX = re.compile(r"[._/](pos|position|vel|velocity|width|effort|torque)$")
"""Suffix of an element's name that is not part of its joint's name."""
VELOCITY_WORDS = frozenset(("velocity", "velocities", "vel", "qvel"))
FORCE_WORDS = frozenset(("effort", "efforts", "torque", "torques", "current", "force", "wrench", "tactile"))
_WORD = re.compile("[A-Z]?[a-z]+|[A-Z]+")
_GRIPPER = re.compile("gripper|finger", re.IGNORECASE)


def read_names(names: object, count: int) -> tuple[str, ...] | None:
    """Read the names of `count` elements; None if they are missing or their number differs.

    Known forms are a list, and nested lists, as written by Unitree. Lists may be in an object under a common word, such
    as `{"motors": [...]}` of LeRobot 2 or `{"axes": [...]}`. An object may map each name to its index.
    """
    if isinstance(names, dict) and (places := list(names.values())) and all(type(place) is int for place in places):
        names = sorted(names, key=names.__getitem__) if sorted(places) == list(range(count)) else None
    found = tuple(_flat(names))
    return found if len(found) == count and all(name and name.isprintable() for name in found) else None


def _flat(names: object) -> Iterator[str]:
    """Yield the names in nested lists and objects, in order; "" for anything that is not a name."""
    waiting = [names]
    while waiting:
        item = waiting.pop()
        if isinstance(item, dict):
            waiting += [part if isinstance(part, dict | list | tuple) else None for part in reversed(item.values())]
        elif isinstance(item, list | tuple):
            waiting += reversed(item)
        else:
            yield str(item) if isinstance(item, str) or type(item) is int else ""


def numbers(count: int) -> tuple[str, ...]:
    """Number elements without names: "0", "1", ..."""
    return tuple(map(str, range(count)))


def is_numbered(names: Sequence[str]) -> bool:
    """Check whether elements have numbers instead of names."""
    return tuple(names) == numbers(len(names))


def joint_of(name: str) -> str:
    """Remove the suffix for position, velocity or effort from an element's name."""
    return _SUFFIX.sub("", name)


def is_position(name: str) -> bool:
    """Check whether an element is not named after a velocity or a force."""
    return (VELOCITY_WORDS | FORCE_WORDS).isdisjoint(word.lower() for word in _WORD.findall(name))


def is_gripper(name: str) -> bool:
    """Check whether an element is named after a gripper or a finger."""
    return _GRIPPER.search(name) is not None
