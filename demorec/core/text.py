"""Text that came from outside (file names, recordings, run.json, datasets) made fit for a terminal or a log."""

from __future__ import annotations

import re
import unicodedata

_VISIBLE = {"\n": "\\n", "\r": "\\r", "\t": "\\t"}
_INVISIBLE_KINDS = ("Cc", "Cf", "Cs", "Zl", "Zp")
"""Unicode's categories of what a terminal obeys or reorders instead of showing it: control characters (escape codes
begin with one), format characters (among them those that turn the direction of writing), surrogates (bytes of a file
name that are no UTF-8) and separators of lines and paragraphs."""


def printable(text: str) -> str:
    r"""The same text with every control character spelt out (\x1b, \n, \u202e), so that it can do nothing but be read.

    All foreign text goes through here before it reaches a terminal; `demorec.cli.shared.output` sees to that.
    """
    if text.isprintable():  # nearly always; a plain space counts as printable
        return text
    return "".join(_spelt(character) for character in text)


_MARKS = re.compile(r"^[#+=-]|[\\`*\[\]|~$#]|(?<![^\W_])_|_(?![^\W_])")
"""What acts in a line of Markdown; an underscore within a word does not."""
_ENTITIES = {ord("&"): "&amp;", ord("<"): "&lt;", ord(">"): "&gt;"}


def markdown(text: str) -> str:
    """The same text for a line of Markdown, which can do nothing but be read: no HTML, link, table or emphasis."""
    return _MARKS.sub(r"\\\g<0>", printable(text)).translate(_ENTITIES)


def display_width(text: str) -> int:
    """How many columns of a terminal a printable text takes: wide characters (CJK) take two, combining marks none."""
    if text.isascii():
        return len(text)
    return sum(_columns(character) for character in text)


def _columns(character: str) -> int:
    if unicodedata.category(character) in ("Mn", "Me"):
        return 0
    return 2 if unicodedata.east_asian_width(character) in "WF" else 1


def _spelt(character: str) -> str:
    if unicodedata.category(character) not in _INVISIBLE_KINDS:
        return character
    code = ord(character)
    width, letter = (2, "x") if code < 0x100 else (4, "u") if code < 0x10000 else (8, "U")
    return _VISIBLE.get(character) or f"\\{letter}{code:0{width}x}"
