"""Find sentences that a native engineer would hardly write, in docstrings, comments, messages and Markdown."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

MAX_WORDS = 35
PATTERNS = {
    "preposition or pronoun first": r"^(Of|By which|As of|From which|In which|Whose|That|Those|Which|Theirs)\b",
    "what-clause": r"\b[Ww]hat (is|was|are|were|it|they|has|had|comes|came|remains|stays)\b",
    "chain of relative clauses": r"\b(that|which)\b.*\b(that|which)\b.*\b(that|which)\b",
    "data that tells": r"\b(tells?|told)\b",
    "is no": r"(?<!there )\b(is|are) (no|none)\b(?! more| longer)",
    "lies, stands, goes": r"\b(lies|stands|goes)\b",
    "whoever": r"\b(whoever|somebody|anybody|nobody)\b|\bof (ours|theirs|one's own)\b",
    "anew, beside": r"\b(anew|beside|shall|from which on)\b",
}
"""Sign of an odd sentence -> its pattern; a sign asks for a second reading."""


class OddSentence(NamedTuple):
    path: Path
    signs: tuple[str, ...]
    sentence: str


def signs_of(sentence: str) -> tuple[str, ...]:
    """Name the signs of a sentence; empty for a good one."""
    found = [sign for sign, pattern in PATTERNS.items() if re.search(pattern, sentence)]
    return (*found, *(["too long"] if len(sentence.split()) > MAX_WORDS else []))


def read(paths: Iterable[Path]) -> tuple[list[OddSentence], int]:
    """Read Python and Markdown files; return the odd sentences and the number of all sentences."""
    odd, count = list[OddSentence](), 0
    for path in paths:
        texts = _markdown if path.suffix == ".md" else _python
        for text in texts(path.read_text(encoding="utf-8")):
            for sentence in _sentences(text):
                count += 1
                if signs := signs_of(sentence):
                    odd.append(OddSentence(path, signs, sentence))
    return odd, count


def _python(source: str) -> Iterator[str]:
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.value
    for comment in re.finditer(r"(?m)(?:^ *# .*\n)+|(?<=  )# .*", source):
        yield re.sub(r"(?m)^ *# ", "", comment[0])


def _markdown(source: str) -> Iterator[str]:
    code = r"(?ms)^ *```.*?^ *```$|^(?: {4}|!\[|<)[^\n]*$"
    prose = re.sub(code, "", source)
    for block in re.finditer(r"(?s)\S.*?(?=\n\s*\n|\n\||\n *[-*] |\n *\d+\. |\Z)", prose):
        for cell in block[0].split("|"):
            yield re.sub(r"`[^`]*`", "X", cell)


def _sentences(text: str) -> Iterator[str]:
    """Split text; a sentence has at least four words."""
    for paragraph in re.split(r"\n\s*\n|\n\s{4,}(?=\w+(?:, \w+)*: )", text):
        for sentence in re.split(r"(?<=[.!?])\s+(?=[A-Z`{])", " ".join(paragraph.split())):
            if sentence.count(" ") >= 3:
                yield sentence
