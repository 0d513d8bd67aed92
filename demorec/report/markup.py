"""HTML and SVG in which nothing foreign can act: whatever is not markup of ours is escaped where it is put in."""

from __future__ import annotations

import html
from collections.abc import Iterable

from demorec.safety.text import printable


class Markup(str):
    """Text that is HTML already."""

    __slots__ = ()


def text(value: object) -> Markup:
    """A value as text of a page: characters that mean something in HTML are escaped, invisible ones spelt out."""
    return value if isinstance(value, Markup) else Markup(html.escape(printable(str(value))))


def joined(parts: Iterable[object]) -> Markup:
    """Parts one after another, each as `text` takes it; None is left out."""
    return Markup("".join(text(part) for part in parts if part is not None))


def tag(name: str, /, *content: object, **attributes: str | float | None) -> Markup:
    """An element with everything in it escaped: `tag("a", "3 < 4", href="#x", class_="note")`.

    Args:
        name: Of the element.
        content: As `joined` takes it.
        attributes: Underscores stand for hyphens, one at the end is dropped (`class_`); those that are None are left
            out, "" is an attribute without a value.
    """
    words = [name]
    for key, value in attributes.items():
        if value is None:
            continue
        label = key.rstrip("_").replace("_", "-")
        shown = f"{value:.6g}" if isinstance(value, float) else str(value)
        words.append(label if shown == "" else f'{label}="{text(shown)}"')
    opening = f"<{' '.join(words)}>"
    return Markup(opening) if name in _VOID else Markup(f"{opening}{joined(content)}</{name}>")


_VOID = ("img", "meta", "input", "br")


def table(head: Iterable[object], rows: Iterable[Iterable[object]]) -> Markup:
    """A table that scrolls by itself where the window is narrow."""
    heading = tag("thead", tag("tr", *(tag("th", cell, scope="col") for cell in head)))
    body = tag("tbody", *(tag("tr", *(tag("td", cell) for cell in row)) for row in rows))
    return tag("div", tag("table", heading, body), class_="wide")
