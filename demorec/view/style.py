"""Colours: one palette, the same in plots, paths, timelines and segments."""

from __future__ import annotations

from collections.abc import Iterable

Color = tuple[int, int, int]

SERIES: tuple[Color, ...] = (
    (86, 180, 233),
    (230, 159, 0),
    (0, 190, 140),
    (240, 228, 66),
    (204, 121, 167),
    (213, 94, 0),
    (120, 140, 255),
    (150, 210, 80),
    (200, 200, 200),
)
"""Colours of joints, phases and segments, in their order; after Okabe and Ito, distinguishable for colour-blind people.
"""

MEASURED: Color = (86, 180, 233)
TARGET: Color = (255, 170, 60)
ASKED: Color = (235, 235, 235)
"""Colour of all joint targets over the measured joints."""
FORCE: Color = (240, 90, 90)
GOAL: Color = (60, 230, 120)
FRUSTUM: Color = (255, 200, 60)


def series_colors(count: int) -> list[Color]:
    """Choose one colour per curve."""
    return [SERIES[index % len(SERIES)] for index in range(count)]


def name_colors(names: Iterable[str]) -> dict[str, Color]:
    """Map each name, such as that of a phase or segment, to a colour."""
    return {name: SERIES[index % len(SERIES)] for index, name in enumerate(dict.fromkeys(names))}
