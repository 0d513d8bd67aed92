"""Toy blocks: 25 shapes each of eight kinds, and plain cubes."""

from __future__ import annotations

import math

import numpy as np

from demorec.episode.mesh import SolidMesh
from demorec.objects.shelf import Shelf, drawn
from demorec.objects.solids import arc, board

Rng = np.random.Generator
SHAPES = 25


def _sizes(rng: Rng) -> tuple[float, float, float]:
    """Draw the width of a bar, the side of the whole and the depth, metres."""
    return rng.uniform(0.02, 0.026), rng.uniform(0.055, 0.075), rng.uniform(0.022, 0.04)


@drawn("wood", count=SHAPES, yaw_symmetry=4)
def _cube(rng: Rng) -> SolidMesh:
    h = rng.uniform(0.03, 0.05) / 2
    return board([(-h, -h), (h, -h), (h, h), (-h, h)], [(0, 1, 2, 3)], 2 * h)


@drawn("wood", count=SHAPES, yaw_symmetry=2)
def _brick(rng: Rng) -> SolidMesh:
    x, y = rng.uniform(0.05, 0.08) / 2, rng.uniform(0.022, 0.04) / 2
    return board([(-x, -y), (x, -y), (x, y), (-x, y)], [(0, 1, 2, 3)], rng.uniform(0.022, 0.04))


@drawn("wood", count=SHAPES)
def _wedge(rng: Rng) -> SolidMesh:
    _, side, depth = _sizes(rng)
    return board([(0.0, 0.0), (side, 0.0), (0.0, rng.uniform(0.5, 0.7) * side)], [(0, 1, 2)], depth, upright=True)


@drawn("wood", count=SHAPES)
def _corner(rng: Rng) -> SolidMesh:
    bar, side, depth = _sizes(rng)
    outline = [(0.0, 0.0), (side, 0.0), (side, bar), (bar, bar), (bar, side), (0.0, side)]
    return board(outline, [(0, 1, 2, 3), (0, 3, 4, 5)], depth)


@drawn("wood", count=SHAPES)
def _tee(rng: Rng) -> SolidMesh:
    bar, side, depth = _sizes(rng)
    h, s = bar / 2, side / 2
    outline = [(-h, 0.0), (h, 0.0), (h, s), (s, s), (s, s + bar), (-s, s + bar), (-s, s), (-h, s)]
    return board(outline, [(0, 1, 2, 7), (2, 3, 4, 5, 6, 7)], depth)


@drawn("wood", count=SHAPES, yaw_symmetry=4)
def _cross(rng: Rng) -> SolidMesh:
    bar, side, depth = _sizes(rng)
    h, s = bar / 2, side / 2
    outline = [
        (-h, -s),
        (h, -s),
        (h, -h),
        (s, -h),
        (s, h),
        (h, h),
        (h, s),
        (-h, s),
        (-h, h),
        (-s, h),
        (-s, -h),
        (-h, -h),
    ]
    return board(outline, [(2, 3, 4, 5, 8, 9, 10, 11), (0, 1, 2, 11), (5, 6, 7, 8)], depth)


@drawn("wood", count=SHAPES, yaw_symmetry=2)
def _arch(rng: Rng) -> SolidMesh:
    bar, side, depth = _sizes(rng)
    s, z = side / 2, rng.uniform(0.015, 0.022)
    inner = s - 0.7 * bar
    outline = [
        (-s, 0.0),
        (-inner, 0.0),
        (-inner, z),
        (inner, z),
        (inner, 0.0),
        (s, 0.0),
        (s, z),
        (s, z + bar),
        (-s, z + bar),
        (-s, z),
    ]
    return board(outline, [(9, 2, 3, 6, 7, 8), (0, 1, 2, 9), (4, 5, 6, 3)], depth, upright=True)


@drawn("wood", count=SHAPES, yaw_symmetry=6)
def _hexagon(rng: Rng) -> SolidMesh:
    outline = arc((0.0, 0.0), rng.uniform(0.02, 0.032), 0.0, 2 * math.pi, 7)[:-1]
    return board(outline, [tuple(range(6))], rng.uniform(0.025, 0.045))


CUBES = Shelf(kinds=(_cube,))
BLOCKS = Shelf(kinds=(_cube, _brick, _wedge, _corner, _tee, _cross, _arch, _hexagon))
