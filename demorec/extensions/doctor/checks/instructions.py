"""Checks of instructions: empty ones, and those that contradict each other."""

from __future__ import annotations

import difflib
import re
from collections import Counter
from collections.abc import Iterator

from demorec.check.base import Fault, NotMeasuredError, check
from demorec.extensions.doctor.evidence import Evidence

_PLACEHOLDERS = frozenset(("", "none", "null", "nan", "task", "todo", "test", "unknown", "n/a", "default"))
MIN_COMMON = 5
"""Minimum number of episodes with the common instruction for a single other one to be questioned."""
MIN_SIMILARITY = 0.8
"""Minimum ratio of equal letters of two words that differ by a typing error."""


@check(
    family="set",
    needs="instructions",
    measures="episodes without an instruction",
    unit="episodes",
    why="A policy that reads instructions learns that none of them matters.",
    do="demorec dataset set-task {path} --task 'WORDS' --out NEW",
)
def empty_instructions(evidence: Evidence) -> Iterator[Fault]:
    """Find episodes with an empty instruction or a placeholder."""
    words = {episode.number: episode.instruction.strip() for episode in evidence.episodes}
    empty = [number for number, text in words.items() if text.lower() in _PLACEHOLDERS]
    if not words:
        raise NotMeasuredError("no episode can be read")
    if len(empty) == len(words):
        yield Fault(
            severity="look",
            value=f"{len(empty)} episodes",
            message=f"no episode has an instruction ({words[empty[0]]!r})",
        )
        return
    for number in empty:
        yield Fault(
            severity="look",
            episode=number,
            message=f"its instruction is {words[number]!r}",
            do="demorec dataset set-task {path} --task 'WORDS' --episodes {episode} --out NEW",
        )


@check(
    family="set",
    needs="instructions",
    measures="a task in different words, or in unique words",
    unit="episodes",
    why="Words that differ by a typing error are two tasks for a policy; unique ones are often an operator's error.",
    do="demorec dataset set-task {path} --task 'WORDS' --episodes {episode} --out NEW",
)
def odd_instructions(evidence: Evidence) -> Iterator[Fault]:
    """Find instructions that differ only by a typing error, and one that only a single episode has."""
    counts = Counter(each.instruction for each in evidence.episodes if each.instruction.strip())
    if len(counts) < 2:
        return
    common = counts.most_common()
    for text, count in common[1:]:
        usual = next((other for other, number in common if number > count and _is_misspelled(text, other)), None)
        lone = len(counts) == 2 and count == 1 and common[0][1] >= MIN_COMMON
        if usual is None and not lone:
            continue
        reason = f"{counts[usual]} others have {usual!r}" if usual is not None else f"all others have {common[0][0]!r}"
        for episode in evidence.episodes:
            if episode.instruction == text:
                yield Fault(
                    severity="look",
                    episode=episode.number,
                    value=f"{count} of {len(evidence.episodes)}",
                    message=f"its instruction is {text!r}, {reason}",
                )


def _is_misspelled(text: str, other: str) -> bool:
    """Check whether two instructions differ only in case, punctuation, or a letter within a word."""
    one, two = (re.sub(r"\W+", " ", each.lower()).split() for each in (text, other))
    if one == two:
        return True
    if len(one) != len(two):
        return False
    different = [(a, b) for a, b in zip(one, two, strict=True) if a != b]
    return len(different) == 1 and _is_one_word(*different[0])


def _is_one_word(one: str, two: str) -> bool:
    """Check whether two words of five letters or more differ by a typing error; "left1" and "left2" do not."""
    if min(len(one), len(two)) < 5 or any(letter.isdigit() for letter in one + two):
        return False
    return difflib.SequenceMatcher(None, one, two).ratio() >= MIN_SIMILARITY
