"""Wordings of one task that have the same meaning and are unambiguous in its scene.

A wording is a template with phrases. The resolver (`demorec.annotate.referring`) proves each phrase: it reads the
finished text and does not know the template.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from demorec.annotate.referring import Surroundings, phrases_for, place_of, references, resolve, situation
from demorec.annotate.subtasks import joined, prepositions
from demorec.episode.scene import Goal, Scene

WORDINGS = 24
"""Number of wordings per episode, the same for every task."""
_ON = 0.01
"""Maximum gap below an object that still counts as resting on another, in metres."""

_PUT = (
    "put {o} {p}",
    "place {o} {p}",
    "set {o} {p}",
    "set {o} down {p}",
    "pick up {o} and put it {p}",
    "pick up {o} and place it {p}",
    "pick {o} up and set it down {p}",
    "grasp {o} and put it {p}",
    "take {o} and place it {p}",
    "get {o} and set it {p}",
)
_INTO = ("move {o} {i}", "bring {o} {i}", "carry {o} {i}", "transfer {o} {i}")
_OFF = (
    "take {o} off {b} and put it {p}",
    "lift {o} off {b} and place it {p}",
    "remove {o} from {b} and put it {p}",
    "unstack {o} from {b} and set it {p}",
)
_DROP = (
    "drop {o} {i}",
    "let {o} fall {i}",
    "pick up {o} and drop it {i}",
    "pick {o} up and let it fall {i}",
    "grasp {o} and drop it {i}",
    "take {o} and let it drop {i}",
)
_CLASS_VERBS = ("move", "bring", "sort", "carry")
_POLITE = ("{s}", "please {s}", "could you {s}?", "can you {s}?", "would you {s}, please?", "I want you to {s}")
_THEN = ("{a}, then {b}", "first {a}, then {b}", "{a}, and then {b}", "{a}; after that, {b}")


@dataclass(frozen=True, kw_only=True)
class _Clause:
    """Words of one goal: names of its object, its place and the object below, "" for none."""

    object: str
    place: str
    base: str


def task_wordings(scene: Scene, instruction: str, rng: np.random.Generator, *, is_dropped: bool) -> list[str]:
    """Return up to `WORDINGS` different wordings, the recorded instruction first; each is proved unambiguous.

    Args:
        scene: Scene at the episode's start.
        instruction: Recorded instruction.
        rng: Chooses among all possible wordings.
        is_dropped: Whether objects are dropped rather than set down.
    """
    start = situation(scene)
    clauses = [
        _Clause(object=goal.object, place=place_of(scene, goal), base=_base_of(goal, start)) for goal in scene.goals
    ]
    sentences = list(
        dict.fromkeys([*_by_class(scene, clauses, start), *_one_by_one(scene, clauses, start, is_dropped, rng)])
    )
    order = rng.permutation(len(sentences))
    wanted = WORDINGS - 1
    chosen = [sentences[index] for index in order[:wanted]]
    # The first round gives each sentence another polite form; further rounds are used if there are too few sentences.
    forms = rng.permutation(len(_POLITE))
    found = [instruction]
    for turn, (round_, index) in enumerate(product(range(len(_POLITE)), range(len(chosen)))):
        if len(found) >= WORDINGS:
            break
        form = _POLITE[forms[(turn + round_) % len(_POLITE)]]
        text = form.replace("{s}", chosen[index])
        if text not in found and _is_proved(text, clauses, start):
            found.append(text)
    return found


def _is_proved(text: str, clauses: Sequence[_Clause], start: Surroundings) -> bool:
    """Whether each phrase of a wording is unambiguous and all together refer to the goals' objects."""
    found = [names for _, names in references(text, start)]
    wanted = {name for clause in clauses for name in (clause.object, clause.place) if name}
    allowed = wanted | {clause.base for clause in clauses}
    return all(found) and wanted <= set().union(*found) <= allowed


def _base_of(goal: Goal, start: Surroundings) -> str:
    """Name of the movable object below a goal's object, or ""."""
    upper = start.thing(goal.object)
    for thing in start.things:
        offset = upper.position - thing.position
        air = float(offset[2]) - (upper.height + thing.height) / 2
        if (
            thing is not upper
            and thing.can_be_held
            and abs(air) < _ON
            and bool((abs(offset[:2]) < thing.size / 2).all())
        ):
            return thing.name
    return ""


def _one_by_one(
    scene: Scene, clauses: Sequence[_Clause], start: Surroundings, is_dropped: bool, rng: np.random.Generator
) -> Iterator[str]:
    """Sentences that name each goal."""
    per_goal = [list(_sentences(scene, clause, start, is_dropped)) for clause in clauses]
    if not all(per_goal):
        return
    if len(per_goal) == 1:
        yield from per_goal[0]
        return
    for number in range(4 * WORDINGS):
        parts = [options[int(rng.integers(len(options)))] for options in per_goal]
        form = _THEN[number % len(_THEN)]
        text = parts[0]
        for part in parts[1:-1]:
            text += f", then {part}"
        yield form.replace("{a}", text).replace("{b}", parts[-1])


def _sentences(scene: Scene, clause: _Clause, start: Surroundings, is_dropped: bool) -> Iterator[str]:
    objects = list(phrases_for(clause.object, start))
    places = list(phrases_for(clause.place, start)) if clause.place else []
    base = next(phrases_for(clause.base, start), "") if clause.base else ""
    into, inside = prepositions(scene, clause.place)
    is_on_cube = bool(clause.place) and start.thing(clause.place).can_be_held
    templates = _DROP if is_dropped else (*_PUT, *_INTO)
    if base and not is_dropped:
        templates = (*templates, *_OFF)
    for template, object_, place in product(templates, objects, places):
        text = template.replace("{o}", object_).replace("{i}", f"{into} {place}").replace("{p}", f"{inside} {place}")
        yield text.replace("{b}", base) if base else text
        if is_on_cube and "{p}" in template:
            yield template.replace("{o}", object_).replace("{p}", f"on top of {place}")
    if is_on_cube:
        for object_, place in product(objects, places):
            yield f"stack {object_} on {place}"


def _by_class(scene: Scene, clauses: Sequence[_Clause], start: Surroundings) -> Iterator[str]:
    """Sentences about all objects of a kind at once, if several goals share a place: "every red cube"."""
    places = list(dict.fromkeys(clause.place for clause in clauses))
    if len(places) == len(clauses) or not all(places):
        return
    parts: list[list[str]] = []
    for place in places:
        members = frozenset(clause.object for clause in clauses if clause.place == place)
        thing = start.thing(next(iter(members)))
        into, inside = prepositions(scene, place)
        words = f"every {thing.color} {thing.noun}"
        if resolve(words, start) != members or not (names := list(phrases_for(place, start))):
            return
        options = [*((verb, inside) for verb in ("put", "place", "set")), *((verb, into) for verb in _CLASS_VERBS)]
        parts.append([f"{verb} {words} {where} {name}" for name in names for verb, where in options])
    for choice in product(*parts):
        yield joined(choice)
        if len(choice) == 2:
            yield f"{choice[0]}, then {choice[1]}"
