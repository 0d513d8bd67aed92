"""A mesh as a handful of boxes, cylinders and spheres: what a viewer can draw without any file beside the recording.

Rerun draws the robot of a bare recording from its URDF, but gives up on the whole robot when one mesh file is not
where the URDF says. So the recorded description has no meshes. Primitives stand along the axes of the link, and a
part is cut in two as long as that saves enough volume; only comparisons and sums are used, so that the same mesh
gives the same text on every CPU.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from demorec.core.geometry import Array

_SPACING = 0.025
"""Of the points on the surface, as a part of the mesh's diagonal."""


@dataclass(frozen=True, kw_only=True)
class Primitive:
    """A box, cylinder or sphere.

    Attributes:
        kind: Which.
        center: (x, y, z) in the mesh's frame.
        axis: 0, 1 or 2: the cylinder's direction; 2 for the others.
        size: box: full extents; cylinder: (radius, length); sphere: (radius,).
        volume: Of one that was fitted to a mesh.
    """

    kind: Literal["box", "cylinder", "sphere"]
    size: tuple[float, ...]
    center: tuple[float, float, float] = (0.0, 0.0, 0.0)
    axis: int = 2
    volume: float = 0.0


def fit_primitives(
    vertices: Array, faces: NDArray[np.int64], *, max_parts: int = 6, min_saving: float = 0.03
) -> list[Primitive]:
    """Cover a mesh with primitives.

    Args:
        vertices: (V, 3).
        faces: (F, 3) indices of triangles.
        max_parts: At most so many.
        min_saving: A cut must save this part of the first primitive's volume.
    """
    points = surface_points(vertices, faces)
    parts = [points]
    fits = [_fit(points)]
    cuts = [_best_cut(points, fits[0])]
    threshold = min_saving * fits[0].volume
    while len(parts) < max_parts:
        best = max(range(len(parts)), key=lambda index: cuts[index][0])
        saving, left, right = cuts[best]
        if saving < threshold:
            break
        parts[best : best + 1] = [left, right]
        fits[best : best + 1] = [_fit(left), _fit(right)]
        cuts[best : best + 1] = [_best_cut(left, fits[best]), _best_cut(right, fits[best + 1])]
    return fits


def surface_points(vertices: Array, faces: NDArray[np.int64]) -> Array:
    """(N, 3) points on the triangles, about evenly spaced, the vertices included."""
    extent = vertices.max(axis=0) - vertices.min(axis=0)
    spacing = max(_SPACING * math.sqrt(float((extent * extent).sum())), 1e-6)
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    longest = np.sqrt(np.max([((p - q) ** 2).sum(axis=1) for p, q in ((a, b), (b, c), (c, a))], axis=0))
    steps = np.maximum(1, np.ceil(longest / spacing)).astype(np.int64)
    found = []
    for count in np.unique(steps).tolist():
        i, j = np.mgrid[0 : count + 1, 0 : count + 1]
        inside = i + j <= count
        u, v = (i[inside] / count)[None, :, None], (j[inside] / count)[None, :, None]
        chosen = steps == count
        pa, pb, pc = a[chosen][:, None], b[chosen][:, None], c[chosen][:, None]
        found.append((pa + (pb - pa) * u + (pc - pa) * v).reshape(-1, 3))
    points = np.concatenate(found)
    # One point in each cell is enough.
    _, first = np.unique(np.floor(points / spacing).astype(np.int64), axis=0, return_index=True)
    return np.asarray(points[np.sort(first)], dtype=np.float64)


def _fit(points: Array) -> Primitive:
    """The smallest box, cylinder along an axis or sphere around the points, in their frame."""
    low, high = points.min(axis=0), points.max(axis=0)
    extent = np.maximum(high - low, 1e-4)
    middle = (low + high) / 2
    center = (float(middle[0]), float(middle[1]), float(middle[2]))
    sides = tuple(extent.tolist())
    best = Primitive(kind="box", center=center, axis=2, size=sides, volume=math.prod(sides))
    squares = (points - middle) ** 2
    for axis in range(3):
        others = [other for other in range(3) if other != axis]
        radius = math.sqrt(float((squares[:, others[0]] + squares[:, others[1]]).max()))
        volume = math.pi * radius * radius * sides[axis]
        if volume < best.volume:
            size = (max(radius, 1e-4), sides[axis])
            best = Primitive(kind="cylinder", center=center, axis=axis, size=size, volume=volume)
    radius = math.sqrt(float(squares.sum(axis=1).max()))
    volume = 4 / 3 * math.pi * radius**3
    if volume < best.volume:
        best = Primitive(kind="sphere", center=center, axis=2, size=(radius,), volume=volume)
    return best


def _best_cut(points: Array, fit: Primitive) -> tuple[float, Array, Array]:
    """The plane across an axis that saves most volume: what it saves, and the points on its two sides."""
    best: tuple[float, Array, Array] = (0.0, points, points)
    for axis in range(3):
        values = points[:, axis]
        low, high = float(values.min()), float(values.max())
        for step in range(1, 10):
            at = low + (high - low) * step / 10
            below = values <= at
            if below.sum() < 8 or (~below).sum() < 8:
                continue
            left, right = points[below], points[~below]
            saving = fit.volume - _fit(left).volume - _fit(right).volume
            if saving > best[0]:
                best = (saving, left, right)
    return best
