"""Colours: one palette for joints, one for the phases of a motion, the same in plots, paths and timelines."""

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
"""Colours of the joints, base to fingers; after Okabe and Ito, distinguishable for colour-blind people."""

PHASES: tuple[Color, ...] = (
    (70, 130, 255),
    (0, 200, 200),
    (255, 200, 40),
    (60, 200, 90),
    (190, 110, 255),
    (255, 130, 50),
    (240, 80, 110),
    (150, 160, 180),
    (165, 105, 60),
    (255, 170, 205),
)
"""Colours of the phases, in the order of their appearance."""

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


def phase_colors(phases: Iterable[str]) -> dict[str, Color]:
    """Map each phase to a colour."""
    return {name: PHASES[index % len(PHASES)] for index, name in enumerate(dict.fromkeys(phases))}


def segment_colors(names: Iterable[str]) -> dict[str, Color]:
    """Map each segment to a colour."""
    return {name: SERIES[index % len(SERIES)] for index, name in enumerate(names)}
