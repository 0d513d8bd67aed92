"""Tables and sizes as the commands print them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from demorec.core.text import display_width, printable


def aligned(rows: Iterable[Sequence[str]]) -> list[str]:
    """Columns of equal width, two spaces between them, on a terminal that shows `printable` text."""
    table = [[printable(cell) for cell in row] for row in rows]
    widths = [max(map(display_width, column)) for column in zip(*table, strict=True)]
    return [
        "  ".join(cell + " " * (width - display_width(cell)) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in table
    ]


def size_in_words(num_bytes: int) -> str:
    """In kB or MB."""
    if num_bytes < 1_000_000:
        return f"{num_bytes / 1000:.0f} kB"
    return f"{num_bytes / 1e6:.1f} MB"
