"""Words of mappings: the task that a file's name tells, names that are not taken yet, texts as TOML."""

from __future__ import annotations

import re
from collections.abc import Container
from typing import Any

from numpy.typing import NDArray

SHOWN = 4
"""Of the numbers or fields of a value, in a comment."""

_NUMBER = re.compile(r"[_\-. \d]*\d$")
"""Of an episode or a day. Names are foreign: a repetition within another would take exponential time."""


def task_in_name(name: str) -> str:
    """The task that a file's name tells: "stack the cups" of "stack_the_cups_003"."""
    return _NUMBER.sub("", name).replace("_", " ").replace("-", " ").strip()


def in_natural_order(name: str) -> list[tuple[int, str]]:
    """What names are sorted by, so that run_2 comes before run_10."""
    parts = re.findall(r"[0-9]+|[^0-9]+", name)
    numbers = [(len(digits := part.lstrip("0")), digits) if part[0] in "0123456789" else (-1, part) for part in parts]
    return [*numbers, (-1, name)]


def unique_name(name: str, taken: Container[str]) -> str:
    """The name, or one like it where it is taken."""
    while name in taken:
        name += "_2"
    return name


def first_numbers(numbers: NDArray[Any]) -> str:
    """The first few of (N,), for a comment."""
    more = ", ..." if len(numbers) > SHOWN else ""
    return f"[{', '.join(f'{number:.4g}' for number in numbers[:SHOWN].tolist())}{more}]"


def quoted(text: str) -> str:
    """A TOML string that has no character which a terminal obeys, whatever the text; surrogates, which TOML cannot
    hold, become U+FFFD.
    """
    return f'"{"".join(map(_in_toml, text))}"'


def _in_toml(character: str) -> str:
    if character in '"\\':
        return f"\\{character}"
    if character.isprintable():
        return character
    code = ord(character)
    if 0xD800 <= code < 0xE000:
        return "\ufffd"
    return f"\\u{code:04x}" if code < 0x10000 else f"\\U{code:08x}"
