"""Make text from outside (file names, recordings, run.json, datasets) safe for a terminal or a log."""

from __future__ import annotations

import re
import unicodedata

_VISIBLE = {"\n": "\\n", "\r": "\\r", "\t": "\\t"}
_INVISIBLE_KINDS = ("Cc", "Cf", "Cs", "Zl", "Zp")
"""Unicode categories that a terminal obeys or reorders instead of displaying: control characters (escape codes begin
with one), format characters (including those that change the writing direction), surrogates (bytes of a file name that
are not UTF-8), and line and paragraph separators.
"""


def printable(text: str) -> str:
    r"""Return the text with every control character escaped (\x1b, \n, \u202e), so that it is only displayed.

    All foreign text passes through here before it reaches a terminal; `demorec.cli.shared.output` ensures that.
    """
    if text.isprintable():  # the usual case; a plain space counts as printable
        return text
    return "".join(_spelt(character) for character in text)


_MARKS = re.compile(r"^[#+=-]|[\\`*\[\]|~$#]|(?<![^\W_])_|_(?![^\W_])")
"""Characters with a meaning in a line of Markdown; an underscore within a word has none."""
_ENTITIES = {ord("&"): "&amp;", ord("<"): "&lt;", ord(">"): "&gt;"}


def markdown(text: str) -> str:
    """Escape text for a line of Markdown: no HTML, link, table or emphasis."""
    return _MARKS.sub(r"\\\g<0>", printable(text)).translate(_ENTITIES)


def _spelt(character: str) -> str:
    if unicodedata.category(character) not in _INVISIBLE_KINDS:
        return character
    code = ord(character)
    width, letter = (2, "x") if code < 0x100 else (4, "u") if code < 0x10000 else (8, "U")
    return _VISIBLE.get(character) or f"\\{letter}{code:0{width}x}"
