"""Find sentences that a native engineer would hardly write, in docstrings, comments, messages and Markdown."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

MAX_WORDS = 35
SIGNALS = {
    "begins with a preposition or a pronoun": r"^(Of|By which|As of|From which|In which|Whose|That|Those|Which|Theirs)\b",
    "what-clause instead of a noun": r"(?i)\bwhat (is|was|are|were|it|they|has|had|comes|came|remains|stays)\b",
    "chain of that": r"\b(that|which)\b.*\b(that|which)\b.*\b(that|which)\b",
    "data that speaks": r"\b(tells?|told)\b",
    "is no": r"\b(is|are) (no|none)\b(?! more|thing| longer)",
    "lies, stands, goes": r"\b(lies|stands|goes)\b",
    "whoever": r"\b(whoever|somebody|anybody|nobody)\b|of (ours|one's own|theirs)\b",
    "anew, beside": r"\b(anew|beside|shall|from which on)\b",
}
"""Sign of an odd sentence -> pattern."""


class Flagged(NamedTuple):
    """An odd sentence, where it begins, and its signs."""

    path: Path
    line: int
    signs: tuple[str, ...]
    sentence: str


def signs_of(sentence: str) -> tuple[str, ...]:
    """Name the signs of a sentence; empty for a good one."""
    found = [name for name, pattern in SIGNALS.items() if re.search(pattern, sentence)]
    return (*found, *(["too long"] if len(sentence.split()) > MAX_WORDS else []))


def read(paths: Iterable[Path]) -> tuple[list[Flagged], int]:
    """Read Python and Markdown files; return the odd sentences and the number of all sentences."""
    flagged, count = list[Flagged](), 0
    for path in paths:
        texts = _markdown if path.suffix == ".md" else _python
        for line, text in texts(path.read_text(encoding="utf-8")):
            for sentence in _sentences(text):
                count += 1
                if signs := signs_of(sentence):
                    flagged.append(Flagged(path, line, signs, sentence))
    return flagged, count


def _python(source: str) -> Iterator[tuple[int, str]]:
    """(line, text) of strings and comments."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.lineno, node.value
    for comment in re.finditer(r"(?:^ *# .*\n)+|(?<=  )# .*", source, flags=re.M):
        yield source[: comment.start()].count("\n") + 1, re.sub(r"(?m)^ *# ", "", comment[0])


def _markdown(source: str) -> Iterator[tuple[int, str]]:
    """(line, text) of paragraphs and table cells, without code."""
    prose = re.sub(r"^ *```.*?^ *```|^(?: {4,}|!\[|<).*?$", lambda code: "\n" * code[0].count("\n"), source, flags=re.M | re.S)
    for paragraph in re.finditer(r"\S.*?(?=\n\s*\n|\n\||\n *[-*\d]+\.? |\Z)", prose, flags=re.S):
        for cell in paragraph[0].split("|"):
            yield prose[: paragraph.start()].count("\n") + 1, re.sub(r"`[^`]*`", "X", cell)


def _sentences(text: str) -> Iterator[str]:
    """Split text; a sentence has at least four words."""
    for paragraph in re.split(r"\n\s*\n|\n\s{4,}(?=\w+(?:, \w+)*: )", text):
        for sentence in re.split(r"(?<=[.!?])\s+(?=[A-Z`{])", " ".join(paragraph.split())):
            if sentence.count(" ") >= 3:
                yield sentence
