"""Kitchen objects: thirty shapes each of eleven kinds, small enough for a hand of 8 cm."""

from __future__ import annotations

import math

import numpy as np

from demorec.episode.mesh import SolidMesh
from demorec.objects.shelf import Shelf, drawn
from demorec.objects.solids import arc, board, joined, lathe, rod

Rng = np.random.Generator
SHAPES = 30


@drawn("ceramic", count=SHAPES)
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


@drawn("glass", count=SHAPES, yaw_symmetry=0)
def _glass(rng: Rng) -> SolidMesh:
    radius, height, wall = rng.uniform(0.02, 0.028), rng.uniform(0.05, 0.08), 0.0025
    foot = radius * rng.uniform(0.72, 0.9)
    return lathe([(foot, 0.0), (radius, height)], cavity=[(radius - wall, height), (foot - wall, 0.006)])


@drawn("ceramic", count=SHAPES, yaw_symmetry=0)
def _bowl(rng: Rng) -> SolidMesh:
    radius, height, wall = rng.uniform(0.026, 0.031), rng.uniform(0.03, 0.04), 0.003
    foot = radius * rng.uniform(0.5, 0.65)
    swell = [(foot + (radius - foot) * math.sin(a), height * (1 - math.cos(a))) for a in (0.0, 0.5, 0.9, 1.25)]
    outside = [*swell, (radius, height)]
    return lathe(outside, cavity=[(r - wall, max(z, wall)) for r, z in reversed(outside)])


@drawn("plastic", count=SHAPES, yaw_symmetry=0)
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


@drawn("metal", count=SHAPES, yaw_symmetry=0)
def _can(rng: Rng) -> SolidMesh:
    radius, height = rng.uniform(0.02, 0.03), rng.uniform(0.035, 0.08)
    edge = 0.0025
    return lathe([(radius - edge, 0.0), (radius, edge), (radius, height - edge), (radius - edge, height)])


@drawn("plastic", count=SHAPES, yaw_symmetry=0)
def _jar(rng: Rng) -> SolidMesh:
    radius, height = rng.uniform(0.022, 0.029), rng.uniform(0.04, 0.06)
    lid = radius * rng.uniform(0.8, 0.95)
    return lathe([(0.9 * radius, 0.0), (radius, 0.004), (radius, height), (lid, height + 0.004), (lid, height + 0.016)])


@drawn("carton", count=SHAPES, yaw_symmetry=2)
def _box(rng: Rng) -> SolidMesh:
    x, y, z = rng.uniform(0.04, 0.08), rng.uniform(0.022, 0.045), rng.uniform(0.03, 0.075)
    return board([(-x / 2, -y / 2), (x / 2, -y / 2), (x / 2, y / 2), (-x / 2, y / 2)], [(0, 1, 2, 3)], z)


@drawn("fruit", count=SHAPES, colors=("red", "yellow"), yaw_symmetry=0)
def _apple(rng: Rng) -> SolidMesh:
    radius, squash = rng.uniform(0.024, 0.03), rng.uniform(0.85, 0.95)
    angles = [math.radians(a) for a in (-63, -45, -25, -5, 15, 35, 55, 72)]
    profile = [(radius * math.cos(a), squash * radius * math.sin(a)) for a in angles]
    return lathe([*profile, (0.0, 0.8 * squash * radius)])


@drawn("fruit", count=SHAPES, colors=("yellow", "orange"), yaw_symmetry=0)
def _pear(rng: Rng) -> SolidMesh:
    radius, height = rng.uniform(0.022, 0.028), rng.uniform(0.06, 0.075)
    rows = ((0.65, 0.0), (0.9, 0.08), (1.0, 0.25), (0.95, 0.42), (0.72, 0.6), (0.52, 0.76), (0.42, 0.9), (0.22, 1.0))
    return lathe([(radius * r, height * z) for r, z in rows])


@drawn("fruit", count=SHAPES, colors=("yellow",), yaw_symmetry=2)
def _lemon(rng: Rng) -> SolidMesh:
    radius, length = rng.uniform(0.018, 0.024), rng.uniform(0.05, 0.065)
    steps = (0.0, 0.1, 0.2, 0.33, 0.67, 0.8, 0.9, 1.0)
    path = [(length * (step - 0.5), 0.0, 0.0) for step in steps]
    return rod(path, [radius * max(0.2, math.sin(math.pi * step)) ** 0.7 for step in steps], (0.0, 0.0, 1.0))


@drawn("fruit", count=SHAPES, colors=("yellow",))
def _banana(rng: Rng) -> SolidMesh:
    radius, bend = rng.uniform(0.011, 0.014), rng.uniform(0.055, 0.07)
    spine = arc((0.0, -bend), bend, math.radians(145), math.radians(35), 9)
    thick = [radius * share for share in (0.45, 0.75, 0.95, 1.0, 1.0, 1.0, 0.95, 0.75, 0.4)]
    # Its whole length touches the table: the ends are bent upward as far as they taper.
    return rod([(x, y, r) for (x, y), r in zip(spine, thick, strict=True)], thick, (0.0, 0.0, 1.0))


HOUSEHOLD = Shelf(kinds=(_mug, _glass, _bowl, _bottle, _can, _jar, _box, _apple, _pear, _lemon, _banana))
"""330 shapes."""
