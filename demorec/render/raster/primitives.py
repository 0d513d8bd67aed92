"""Meshes of the shapes that PyBullet describes by numbers: boxes, spheres, cylinders, capsules."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from demorec.render.raster.mesh import Floats, RasterMesh, make_mesh

SEGMENTS = 64
"""Segments around a circle: the outline of a cylinder of 10 cm radius deviates by less than 0.1 mm."""
COARSE_SEGMENTS = 24
"""Segments around a circle in the shadow map."""


def box(*size: float) -> RasterMesh:
    """Make a box of three full extents around the origin, with the texture once on each side."""
    corners = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    points: list[Floats] = []
    normals: list[Floats] = []
    uv: list[Floats] = []
    faces: list[list[int]] = []
    for axis in range(3):
        for sign in (1.0, -1.0):
            u, v = (axis + 1) % 3, (axis + 2) % 3
            side = np.zeros((4, 3))
            side[:, axis] = sign
            side[:, u], side[:, v] = corners[:, 0] * sign, corners[:, 1]
            start = len(points) * 4
            points.append(side * np.asarray(size) / 2)
            faces += [[start, start + 1, start + 2], [start, start + 2, start + 3]]
            normal = np.zeros(3)
            normal[axis] = sign
            normals += [np.tile(normal, (3, 1))] * 2
            square = (corners + 1) / 2
            uv += [square[[0, 1, 2]], square[[0, 2, 3]]]
    return make_mesh(np.concatenate(points), np.array(faces), normals=np.array(normals), uv=np.array(uv))


def roundness(segments: int) -> float:
    """Factor from a circle's radius to a polygon's, so that the polygon is as much outside the circle as inside."""
    return 1 + 2 / 3 * (1 - math.cos(math.pi / segments))


def revolve(profile: Floats, profile_normals: Floats, along: Floats, segments: int) -> RasterMesh:
    """Make a surface of revolution about z.

    Args:
        profile: (n, 2) radius and height, from the lowest point to the highest.
        profile_normals: (n, 2) outward normals, radial and axial part.
        along: (n,) texture coordinate v.
    """
    angles = np.linspace(0, 2 * math.pi, segments + 1)
    ring = np.stack([np.cos(angles), np.sin(angles)], 1)
    n, m = len(profile), segments + 1
    radial = ring[:, None, :]
    profile = profile * [roundness(segments), 1.0]
    points, normals = (
        np.concatenate([radial * line[None, :, :1], np.broadcast_to(line[None, :, 1:], (m, n, 1))], 2).reshape(-1, 3)
        for line in (profile, profile_normals)
    )
    u = np.broadcast_to((angles / (2 * math.pi))[:, None], (m, n))
    uv = np.stack([u, np.broadcast_to(along[None, :], (m, n))], 2).reshape(-1, 2)
    faces = _grid_faces(m, n)
    # At a pole one triangle of each pair is empty, which make_mesh drops.
    return make_mesh(points, faces, normals=normals[faces], uv=uv[faces])


def _grid_faces(rows: int, columns: int) -> NDArray[np.int64]:
    """Make (f, 3) faces, two triangles for each cell of a grid of points numbered row by row."""
    i, j = (a.reshape(-1) for a in np.meshgrid(np.arange(rows - 1), np.arange(columns - 1), indexing="ij"))
    a = i * columns + j
    b, c, d = a + columns, a + columns + 1, a + 1
    return np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])


def sphere(radius: float, segments: int = SEGMENTS) -> RasterMesh:
    """Make a sphere around the origin."""
    angle = np.linspace(-math.pi / 2, math.pi / 2, segments // 2 + 1)
    normals = np.stack([np.cos(angle), np.sin(angle)], 1)
    normals[[0, -1], 0] = 0.0
    # revolve corrects the circles of latitude; the meridians are polygons too.
    profile = normals * [radius, radius * roundness(segments)]
    return revolve(profile, normals, np.asarray(angle / math.pi + 0.5, dtype=np.float64), segments)


def cylinder(radius: float, length: float, segments: int = SEGMENTS) -> RasterMesh:
    """Make a closed cylinder along z around the origin."""
    h = length / 2
    profile = np.array([[0, -h], [radius, -h], [radius, -h], [radius, h], [radius, h], [0, h]], dtype=np.float64)
    normals = np.array([[0, -1], [0, -1], [1, 0], [1, 0], [0, 1], [0, 1]], dtype=np.float64)
    return revolve(profile, normals, np.array([0, 0.25, 0.25, 0.75, 0.75, 1]), segments)


def capsule(radius: float, length: float, segments: int = SEGMENTS) -> RasterMesh:
    """Make a cylinder along z of `length` between the centres of two half spheres."""
    angle = np.linspace(0, math.pi / 2, segments // 4 + 1)
    top = np.stack([np.cos(angle), np.sin(angle)], 1)
    top[-1, 0] = 0.0
    bottom = top[::-1] * [1, -1]
    h = length / 2
    size = [radius, radius * roundness(segments)]
    profile = np.concatenate([bottom * size - [0, h], top * size + [0, h]])
    height = profile[:, 1]
    along = (height - height[0]) / (height[-1] - height[0])
    return revolve(profile, np.concatenate([bottom, top]), along, segments)
