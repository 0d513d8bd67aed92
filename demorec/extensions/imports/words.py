"""Words of mappings: the task in a file's name, unique names, and texts in TOML."""

from __future__ import annotations

import re
from collections.abc import Container

from demorec.extensions.imports.fields import FieldError
from demorec.extensions.imports.mapping import TaskText

_NUMBER = re.compile(r"[_\-. \d]*\d$")
"""Number of an episode or a day. Names are foreign: nested repetition would take exponential time."""


def task_in_name(name: str) -> str:
    """Task in a file's name: "stack the cups" for "stack_the_cups_003"."""
    return _NUMBER.sub("", name).replace("_", " ").replace("-", " ").strip()


def stated_task(task: TaskText, name: str) -> str:
    """Task in a mapping's text or a file's name; "" if it is elsewhere. Raises FieldError if the name has none."""
    if task.file_name and not task_in_name(name):
        raise FieldError(f"the mapping takes the task from the name {name!r}, which has none")
    return task_in_name(name) if task.file_name else task.text.strip()


def in_natural_order(name: str) -> list[tuple[int, str]]:
    """Sort key for natural order, so that run_2 precedes run_10."""
    parts = re.findall(r"[0-9]+|[^0-9]+", name)
    numbers = [(len(digits := part.lstrip("0")), digits) if part[0] in "0123456789" else (-1, part) for part in parts]
    return [*numbers, (-1, name)]


def unique_name(name: str, taken: Container[str]) -> str:
    """Return the name, or a similar one if it is taken."""
    while name in taken:
        name += "_2"
    return name


def quoted(text: str) -> str:
    """Quote text as a TOML string without characters that a terminal obeys; surrogates, which TOML cannot hold, become
    U+FFFD.
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
