"""Closed meshes from a few numbers, each with its convex parts: lathed, cut from a board, or bent from a rod.

Angles come from `math`, and points are rounded to the recorded precision, so that the same numbers give the same mesh
on every machine.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from demorec.episode.mesh import SolidMesh

Point2 = tuple[float, float]
SIDES = 24
"""Number of points in each ring of a solid of revolution."""


def lathe(profile: Sequence[Point2], *, cavity: Sequence[Point2] = ()) -> SolidMesh:
    """Make a solid of revolution about z.

    Args:
        profile: (radius, z) of the outside from bottom to top, metres; radius 0 at an end is a point on the axis.
        cavity: (radius, z) of the inside of a vessel, from the rim down to its floor. Physics treats it as filled:
            fingers that cannot grip a wall do not enter.
    """
    points: list[tuple[float, float, float]] = []
    rings: list[list[int]] = []
    for radius, z in (*profile, *cavity):
        around = [2 * math.pi * k / SIDES for k in range(SIDES)] if radius > 0 else [0.0]
        rings.append(list(range(len(points), len(points) + len(around))))
        points += [(radius * math.cos(a), radius * math.sin(a), z) for a in around]
    faces = [face for below, above in pairwise(rings) for face in _band(below, above)]
    parts = [[row for ring in rings[first : last + 1] for row in ring] for first, last in _convex_runs(profile)]
    return _solid(points, _with_ends(faces, rings[0], rings[-1]), parts)


def dish(floor: float, rim: float, height: float, *, thickness: float) -> SolidMesh:
    """Make a vessel with a flat floor and an outward-leaning wall, hollow in physics too, its floor at z = 0.

    `floor` and `rim` are inner radii; all lengths are metres.
    """
    solid = lathe([(floor, 0.0), (rim, height)], cavity=[(rim - thickness, height), (floor, thickness)])
    rings = np.arange(4 * SIDES).reshape(4, SIDES)
    wall = [np.concatenate([rings[:, k], rings[:, (k + 1) % SIDES]]) for k in range(SIDES)]
    return replace(solid, parts=(np.concatenate([rings[0], rings[3]]), *wall))


def board(
    outline: Sequence[Point2], pieces: Sequence[Sequence[int]], depth: float, *, upright: bool = False
) -> SolidMesh:
    """Make a flat shape of even depth.

    Args:
        outline: (x, y) corners, counter-clockwise, metres.
        pieces: Convex pieces of the shape, each as rows of `outline`, counter-clockwise.
        depth: Extent along z, metres; with `upright` along y, with the outline's y pointing up.
        upright: Whether it rests on an edge of the outline instead of flat.
    """
    n = len(outline)
    if upright:
        points = [(x, side * depth / 2, z) for side in (1, -1) for x, z in outline]
    else:
        points = [(x, y, side * depth / 2) for side in (-1, 1) for x, y in outline]
    faces = _band(list(range(n)), list(range(n, 2 * n)))
    for piece in pieces:
        for a, b in pairwise(piece[1:]):
            faces += [(piece[0], b, a), (piece[0] + n, a + n, b + n)]
    return _solid(points, faces, [[row + end for row in piece for end in (0, n)] for piece in pieces])


def rod(
    path: Sequence[tuple[float, float, float]], radii: Sequence[float], up: Sequence[float], *, sides: int = 10
) -> SolidMesh:
    """Make a bent rod of round section with flat ends; each segment is one convex part.

    Args:
        path: (x, y, z) of its axis, metres, in one plane.
        radii: Radius at each point, metres.
        up: (3,) unit normal of that plane.
    """
    axis, normal = np.array(path), np.array(up)
    points: list[tuple[float, float, float]] = []
    for row, radius in enumerate(radii):
        along = axis[min(row + 1, len(axis) - 1)] - axis[max(row - 1, 0)]
        side = np.cross(normal, along / math.sqrt(float((along * along).sum())))
        for k in range(sides):
            angle = 2 * math.pi * k / sides
            x, y, z = (axis[row] + radius * (math.cos(angle) * side + math.sin(angle) * normal)).tolist()
            points.append((x, y, z))
    rings = [list(range(sides * row, sides * (row + 1))) for row in range(len(axis))]
    faces = [face for below, above in pairwise(rings) for face in _band(below, above)]
    parts = [[*below, *above] for below, above in pairwise(rings)]
    return _solid(points, _with_ends(faces, rings[0], rings[-1]), parts)


def joined(*solids: SolidMesh) -> SolidMesh:
    """Merge several solids into one; overlaps count twice."""
    starts = np.cumsum([0, *(len(solid.points) for solid in solids)]).tolist()
    return SolidMesh(
        points=np.concatenate([solid.points for solid in solids]),
        faces=np.concatenate([solid.faces + start for solid, start in zip(solids, starts, strict=False)]),
        parts=tuple(part + start for solid, start in zip(solids, starts, strict=False) for part in solid.parts),
    )


Face = tuple[int, int, int]


def _solid(points: Sequence[Sequence[float]], faces: Sequence[Face], parts: Sequence[Sequence[int]]) -> SolidMesh:
    made = SolidMesh(
        points=np.array(points, dtype=np.float64),
        faces=np.array(faces, dtype=np.int64),
        parts=tuple(np.array(part, dtype=np.int64) for part in parts),
    )
    return made.moved(np.eye(3), np.zeros(3))  # rounded


def _band(below: Sequence[int], above: Sequence[int]) -> list[Face]:
    """Build the faces between two rings, counter-clockwise from above; one of them may be a single point."""
    n = max(len(below), len(above))
    faces: list[Face] = []
    for k in range(n):
        a, b = below[k % len(below)], below[(k + 1) % len(below)]
        c, d = above[k % len(above)], above[(k + 1) % len(above)]
        if a != b:
            faces.append((a, b, d))
        if c != d:
            faces.append((a, d, c))
    return faces


def _with_ends(faces: list[Face], first: Sequence[int], last: Sequence[int]) -> list[Face]:
    """Add the faces of flat ends."""
    lower = [(first[0], b, a) for a, b in pairwise(first[1:])]
    return faces + lower + [(last[0], a, b) for a, b in pairwise(last[1:])]


def _convex_runs(profile: Sequence[Point2]) -> list[tuple[int, int]]:
    """Split a profile into segments with convex solids of revolution; returns their first and last rows, in order."""
    runs, first = [], 0
    for row in range(1, len(profile) - 1):
        (r0, z0), (r1, z1), (r2, z2) = profile[row - 1 : row + 2]
        if row > first and (r1 - r0) * (z2 - z1) - (z1 - z0) * (r2 - r1) < -1e-9:
            runs.append((first, row))
            first = row
    return [*runs, (first, len(profile) - 1)]


def arc(centre: Point2, radius: float, start: float, end: float, count: int) -> list[Point2]:
    """Compute `count` points on a circular arc between two angles, rad, both ends included."""
    angles = [start + (end - start) * k / (count - 1) for k in range(count)]
    return [(centre[0] + radius * math.cos(a), centre[1] + radius * math.sin(a)) for a in angles]
