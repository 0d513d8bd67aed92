"""Wordings of one task that have the same meaning and are unambiguous in its scene.

A wording is a template with phrases. The resolver (`referring.py`) proves each phrase: it reads the finished text and
does not know the template.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import product
from typing import NamedTuple

import numpy as np

from demorec.episode.scene import Scene
from demorec.extensions.language.referring import (
    Surroundings,
    joined,
    phrases_for,
    place_of,
    prepositions,
    references,
    resolve,
    situation,
)

WORDINGS = 24
"""Number of wordings per episode, the same for every task."""

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


class _Clause(NamedTuple):
    """Names of a goal's object and of its place, "" for none."""

    object: str
    place: str


def task_wordings(scene: Scene, instruction: str, rng: np.random.Generator, *, is_dropped: bool) -> list[str]:
    """Return up to `WORDINGS` different wordings, the recorded instruction first; each is proved unambiguous.

    `rng` chooses among all possible wordings; with `is_dropped`, objects are dropped rather than set down.
    """
    start = situation(scene)
    clauses = [_Clause(goal.object, place_of(scene, goal)) for goal in scene.goals]
    options = [list(_sentences(scene, clause, start, is_dropped)) for clause in clauses]
    sentences = list(dict.fromkeys([*_by_class(scene, clauses, start), *_one_by_one(options, rng)]))
    chosen = [sentences[index] for index in rng.permutation(len(sentences))[: WORDINGS - 1]]
    # The first round gives each sentence another polite form; further rounds are used if there are too few sentences.
    forms = rng.permutation(len(_POLITE))
    found = [instruction]
    for turn, (round_, sentence) in enumerate(product(range(len(_POLITE)), chosen)):
        if len(found) >= WORDINGS:
            break
        text = _POLITE[forms[(turn + round_) % len(_POLITE)]].format(s=sentence)
        if text not in found and _is_proved(text, clauses, start):
            found.append(text)
    return found


def _is_proved(text: str, clauses: Sequence[_Clause], start: Surroundings) -> bool:
    """Whether each phrase of a wording is unambiguous and all together refer to the goals' objects."""
    found = list(references(text, start))
    wanted = {name for clause in clauses for name in (clause.object, clause.place) if name}
    return all(found) and wanted == set().union(*found)


def _one_by_one(options: Sequence[Sequence[str]], rng: np.random.Generator) -> Iterator[str]:
    """Sentences that name each goal, from the possible ones for each."""
    if not all(options):
        return
    if len(options) == 1:
        yield from options[0]
        return
    for number in range(4 * WORDINGS):
        *first, last = [sentences[int(rng.integers(len(sentences)))] for sentences in options]
        yield _THEN[number % len(_THEN)].format(a=", then ".join(first), b=last)


def _sentences(scene: Scene, clause: _Clause, start: Surroundings, is_dropped: bool) -> Iterator[str]:
    objects = list(phrases_for(clause.object, start))
    places = list(phrases_for(clause.place, start)) if clause.place else []
    into, inside = prepositions(scene, clause.place)
    is_on_cube = bool(clause.place) and start[clause.place].body.movable
    templates = _DROP if is_dropped else (*_PUT, *_INTO)
    for template, object_, place in product(templates, objects, places):
        yield template.format(o=object_, i=f"{into} {place}", p=f"{inside} {place}")
        if is_on_cube and "{p}" in template:
            yield template.format(o=object_, p=f"on top of {place}")
    if is_on_cube:
        yield from (f"stack {object_} on {place}" for object_, place in product(objects, places))


def _by_class(scene: Scene, clauses: Sequence[_Clause], start: Surroundings) -> Iterator[str]:
    """Sentences about all objects of a kind at once, if several goals share a place: "every red cube"."""
    places = list(dict.fromkeys(clause.place for clause in clauses))
    if len(places) == len(clauses) or not all(places):
        return
    parts: list[list[str]] = []
    for place in places:
        members = frozenset(clause.object for clause in clauses if clause.place == place)
        into, inside = prepositions(scene, place)
        words = f"every {start[next(iter(members))].words}"
        names = list(phrases_for(place, start))
        if resolve(words, start) != members or not names:
            return
        options = [*((verb, inside) for verb in ("put", "place", "set")), *((verb, into) for verb in _CLASS_VERBS)]
        parts.append([f"{verb} {words} {where} {name}" for name in names for verb, where in options])
    for choice in product(*parts):
        yield joined(choice)
        if len(choice) == 2:
            yield f"{choice[0]}, then {choice[1]}"
