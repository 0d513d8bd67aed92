"""Built-in object sets: toy blocks, plain cubes, and kitchen objects small enough for a hand of 8 cm."""

from __future__ import annotations

import math

import numpy as np

from demorec.episode.mesh import SolidMesh
from demorec.extensions.tasks.solids import arc, board, joined, lathe, rod
from demorec.objects.shelf import Shelf, drawn

Rng = np.random.Generator
BLOCK_SHAPES = 25
KITCHEN_SHAPES = 30


def _sizes(rng: Rng) -> tuple[float, float, float]:
    """Draw the width of a bar, the side of the whole and the depth, metres."""
    return rng.uniform(0.02, 0.026), rng.uniform(0.055, 0.075), rng.uniform(0.022, 0.04)


@drawn("wood", count=BLOCK_SHAPES, yaw_symmetry=4)
def _cube(rng: Rng) -> SolidMesh:
    h = rng.uniform(0.03, 0.05) / 2
    return board([(-h, -h), (h, -h), (h, h), (-h, h)], [(0, 1, 2, 3)], 2 * h)


@drawn("wood", count=BLOCK_SHAPES, yaw_symmetry=2)
def _brick(rng: Rng) -> SolidMesh:
    x, y = rng.uniform(0.05, 0.08) / 2, rng.uniform(0.022, 0.04) / 2
    return board([(-x, -y), (x, -y), (x, y), (-x, y)], [(0, 1, 2, 3)], rng.uniform(0.022, 0.04))


@drawn("wood", count=BLOCK_SHAPES)
def _wedge(rng: Rng) -> SolidMesh:
    _, side, depth = _sizes(rng)
    return board([(0.0, 0.0), (side, 0.0), (0.0, rng.uniform(0.5, 0.7) * side)], [(0, 1, 2)], depth, upright=True)


@drawn("wood", count=BLOCK_SHAPES)
def _corner(rng: Rng) -> SolidMesh:
    bar, side, depth = _sizes(rng)
    outline = [(0.0, 0.0), (side, 0.0), (side, bar), (bar, bar), (bar, side), (0.0, side)]
    return board(outline, [(0, 1, 2, 3), (0, 3, 4, 5)], depth)


@drawn("wood", count=BLOCK_SHAPES)
def _tee(rng: Rng) -> SolidMesh:
    bar, side, depth = _sizes(rng)
    h, s = bar / 2, side / 2
    outline = [(-h, 0.0), (h, 0.0), (h, s), (s, s), (s, s + bar), (-s, s + bar), (-s, s), (-h, s)]
    return board(outline, [(0, 1, 2, 7), (2, 3, 4, 5, 6, 7)], depth)


@drawn("wood", count=BLOCK_SHAPES, yaw_symmetry=4)
def _cross(rng: Rng) -> SolidMesh:
    bar, side, depth = _sizes(rng)
    h, s = bar / 2, side / 2
    outline: list[tuple[float, float]] = []
    corner = [(-h, -s), (h, -s), (h, -h)]
    for _ in range(4):
        outline += corner
        corner = [(-y, x) for x, y in corner]
    return board(outline, [(2, 3, 4, 5, 8, 9, 10, 11), (0, 1, 2, 11), (5, 6, 7, 8)], depth)


@drawn("wood", count=BLOCK_SHAPES, yaw_symmetry=2)
def _arch(rng: Rng) -> SolidMesh:
    bar, side, depth = _sizes(rng)
    s, z = side / 2, rng.uniform(0.015, 0.022)
    inner = s - 0.7 * bar
    right = [(inner, z), (inner, 0.0), (s, 0.0), (s, z), (s, z + bar)]
    left = [(-x, y) for x, y in reversed(right)]
    outline = [*left[2:], *right, *left[:2]]
    return board(outline, [(9, 2, 3, 6, 7, 8), (0, 1, 2, 9), (4, 5, 6, 3)], depth, upright=True)


@drawn("wood", count=BLOCK_SHAPES, yaw_symmetry=6)
def _hexagon(rng: Rng) -> SolidMesh:
    outline = arc((0.0, 0.0), rng.uniform(0.02, 0.032), 0.0, 2 * math.pi, 7)[:-1]
    return board(outline, [tuple(range(6))], rng.uniform(0.025, 0.045))


CUBES = Shelf(kinds=(_cube,))
BLOCKS = Shelf(kinds=(_cube, _brick, _wedge, _corner, _tee, _cross, _arch, _hexagon))


@drawn("ceramic", count=KITCHEN_SHAPES)
def _mug(rng: Rng) -> SolidMesh:
    radius, height, wall = rng.uniform(0.021, 0.028), rng.uniform(0.045, 0.065), rng.uniform(0.003, 0.004)
    taper = rng.uniform(0.85, 1.0)
    outside = [(taper * radius, 0.0), (radius, height)]
    inside = [(radius - wall, height), (taper * radius - wall, wall)]
    reach, low, high = rng.uniform(0.014, 0.02), 0.22 * height, 0.82 * height
    middle, half = (low + high) / 2, (high - low) / 2
    bow = [
        (0.0, 0.96 * radius - wall / 2 + reach * math.cos(a), middle + half * math.sin(a))
        for a in (math.pi * k / 6 - math.pi / 2 for k in range(7))
    ]
    thick = rng.uniform(0.003, 0.004)
    handle = rod(bow, [thick] * len(bow), (1.0, 0.0, 0.0), sides=8)
    return joined(lathe(outside, cavity=inside), handle)


@drawn("glass", count=KITCHEN_SHAPES, yaw_symmetry=0)
def _glass(rng: Rng) -> SolidMesh:
    radius, height, wall = rng.uniform(0.02, 0.028), rng.uniform(0.05, 0.08), 0.0025
    foot = radius * rng.uniform(0.72, 0.9)
    return lathe([(foot, 0.0), (radius, height)], cavity=[(radius - wall, height), (foot - wall, 0.006)])


@drawn("ceramic", count=KITCHEN_SHAPES, yaw_symmetry=0)
def _bowl(rng: Rng) -> SolidMesh:
    radius, height, wall = rng.uniform(0.026, 0.031), rng.uniform(0.03, 0.04), 0.003
    foot = radius * rng.uniform(0.5, 0.65)
    swell = [(foot + (radius - foot) * math.sin(a), height * (1 - math.cos(a))) for a in (0.0, 0.5, 0.9, 1.25)]
    outside = [*swell, (radius, height)]
    return lathe(outside, cavity=[(r - wall, max(z, wall)) for r, z in reversed(outside)])


@drawn("plastic", count=KITCHEN_SHAPES, yaw_symmetry=0)
def _bottle(rng: Rng) -> SolidMesh:
    radius, height = rng.uniform(0.018, 0.024), rng.uniform(0.07, 0.085)
    neck, shoulder = rng.uniform(0.01, 0.012), height * rng.uniform(0.42, 0.5)
    profile = [
        (0.92 * radius, 0.0),
        (radius, 0.003),
        (radius, shoulder),
        (0.85 * radius, shoulder + 0.006),
        (neck, shoulder + 0.014),
        (neck, height - 0.002),
        (neck - 0.002, height),
    ]
    return lathe(profile)


@drawn("metal", count=KITCHEN_SHAPES, yaw_symmetry=0)
def _can(rng: Rng) -> SolidMesh:
    radius, height = rng.uniform(0.02, 0.03), rng.uniform(0.035, 0.08)
    edge = 0.0025
    return lathe([(radius - edge, 0.0), (radius, edge), (radius, height - edge), (radius - edge, height)])


@drawn("plastic", count=KITCHEN_SHAPES, yaw_symmetry=0)
def _jar(rng: Rng) -> SolidMesh:
    radius, height = rng.uniform(0.022, 0.029), rng.uniform(0.04, 0.06)
    lid = radius * rng.uniform(0.8, 0.95)
    return lathe([(0.9 * radius, 0.0), (radius, 0.004), (radius, height), (lid, height + 0.004), (lid, height + 0.016)])


@drawn("carton", count=KITCHEN_SHAPES, yaw_symmetry=2)
def _box(rng: Rng) -> SolidMesh:
    x, y, z = rng.uniform(0.04, 0.08), rng.uniform(0.022, 0.045), rng.uniform(0.03, 0.075)
    return board([(-x / 2, -y / 2), (x / 2, -y / 2), (x / 2, y / 2), (-x / 2, y / 2)], [(0, 1, 2, 3)], z)


@drawn("fruit", count=KITCHEN_SHAPES, colors=("red", "yellow"), yaw_symmetry=0)
def _apple(rng: Rng) -> SolidMesh:
    radius, squash = rng.uniform(0.024, 0.03), rng.uniform(0.85, 0.95)
    angles = [math.radians(a) for a in (-63, -45, -25, -5, 15, 35, 55, 72)]
    profile = [(radius * math.cos(a), squash * radius * math.sin(a)) for a in angles]
    return lathe([*profile, (0.0, 0.8 * squash * radius)])


@drawn("fruit", count=KITCHEN_SHAPES, colors=("yellow", "orange"), yaw_symmetry=0)
def _pear(rng: Rng) -> SolidMesh:
    radius, height = rng.uniform(0.022, 0.028), rng.uniform(0.06, 0.075)
    rows = ((0.65, 0.0), (0.9, 0.08), (1.0, 0.25), (0.95, 0.42), (0.72, 0.6), (0.52, 0.76), (0.42, 0.9), (0.22, 1.0))
    return lathe([(radius * r, height * z) for r, z in rows])


@drawn("fruit", count=KITCHEN_SHAPES, colors=("yellow",), yaw_symmetry=2)
def _lemon(rng: Rng) -> SolidMesh:
    radius, length = rng.uniform(0.018, 0.024), rng.uniform(0.05, 0.065)
    steps = (0.0, 0.1, 0.2, 0.33, 0.67, 0.8, 0.9, 1.0)
    path = [(length * (step - 0.5), 0.0, 0.0) for step in steps]
    return rod(path, [radius * max(0.2, math.sin(math.pi * step)) ** 0.7 for step in steps], (0.0, 0.0, 1.0))


@drawn("fruit", count=KITCHEN_SHAPES, colors=("yellow",))
def _banana(rng: Rng) -> SolidMesh:
    radius, bend = rng.uniform(0.011, 0.014), rng.uniform(0.055, 0.07)
    spine = arc((0.0, -bend), bend, math.radians(145), math.radians(35), 9)
    thick = [radius * share for share in (0.45, 0.75, 0.95, 1.0, 1.0, 1.0, 0.95, 0.75, 0.4)]
    # Its whole length touches the table: the ends are bent upward as far as they taper.
    return rod([(x, y, r) for (x, y), r in zip(spine, thick, strict=True)], thick, (0.0, 0.0, 1.0))


HOUSEHOLD = Shelf(kinds=(_mug, _glass, _bowl, _bottle, _can, _jar, _box, _apple, _pear, _lemon, _banana))
"""330 shapes."""
