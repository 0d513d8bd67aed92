"""Meshes with fewer triangles for small images: quadric collapse, with the original's appearance."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from demorec.render.raster.mesh import Faces, Floats, RasterMesh, cached_mesh, face_normals, make_mesh, unit, weld

SMALLEST = 64
"""Number of triangles below which nothing is decimated."""
SAMPLES = 60_000
"""Number of points on the original surface at which colours are sampled."""
_STUCK = 6.0
"""Ratio of triangles to the target above which the mesh is coarsened first; a Panda's meshes reach 5.2 in small images,
the published SO-101's 10 to 100."""
_CELL = 2.0
"""Size of the cells in which points are merged: this times the mesh's extent, divided by the target. A quarter of a
pixel at 9 triangles a pixel."""


def decimated(read: Callable[[], RasterMesh], num_faces: int, target: int, *, key: str) -> RasterMesh:
    """Decimate a mesh to about `target` faces, or read the result from the cache.

    Args:
        read: Reads the whole mesh.
        num_faces: Faces of the whole mesh.
        target: Target number of faces.
        key: Digest of the mesh's source; its key in the cache.
    """
    if num_faces <= max(target, SMALLEST):
        return read()
    return cached_mesh(f"{key} {target}", lambda: decimate(read(), target))


def decimate(mesh: RasterMesh, target: int) -> RasterMesh:
    """Collapse edges until about `target` faces remain; normals, colours and texture coordinates are transferred."""
    points, kept = _collapsed(mesh, target, tolerance=1e-7)
    if len(kept) > _STUCK * target:
        # Some edges cannot be collapsed: CAD programs export holes, threads and letters with disconnected vertices.
        points, kept = _collapsed(mesh, target, tolerance=_CELL / target)
    kept = kept[(face_normals(points, kept) ** 2).sum(1) > 0]
    return _take_over_looks(mesh, points, kept)


def _collapsed(mesh: RasterMesh, target: int, *, tolerance: float) -> tuple[Floats, Faces]:
    """Merge points within a tolerance (times the extent) and collapse edges; returns points (v, 3), faces (f, 3)."""
    import fast_simplification

    rows, inverse = weld(mesh.points, tolerance)
    faces = inverse[mesh.faces]
    whole = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 0] != faces[:, 2])
    points, kept = fast_simplification.simplify(
        mesh.points[rows].astype(np.float32), faces[whole].astype(np.int32), target_count=int(target), agg=4
    )
    return np.asarray(points, dtype=np.float64), np.asarray(kept, dtype=np.int32)


def _take_over_looks(mesh: RasterMesh, points: Floats, faces: NDArray[np.int32]) -> RasterMesh:
    """Transfer the appearance of the nearest original surface with a similar direction to the faces."""
    from scipy.spatial import cKDTree  # slow import (0.3 s), needed once for each mesh

    extent = float(np.ptp(mesh.points, axis=0).max())
    turn = 0.05 * extent  # distance at which a surface is still preferred to one that faces another direction
    source_normals = face_normals(mesh.points, mesh.faces)
    area = np.sqrt((source_normals * source_normals).sum(1))
    random = np.random.default_rng(0)  # only for the sample points on the surface
    chosen = random.choice(len(area), SAMPLES, p=area / area.sum())
    share = random.random((SAMPLES, 2))
    fold = share.sum(1) > 1
    share[fold] = 1 - share[fold]
    corner = mesh.points[mesh.faces[chosen]]
    spots = corner[:, 0] + share[:, :1] * (corner[:, 1] - corner[:, 0]) + share[:, 1:] * (corner[:, 2] - corner[:, 0])
    normals = unit(face_normals(points, faces))
    surface = cKDTree(np.concatenate([spots, unit(source_normals)[chosen] * turn], 1))

    # Colours and palette positions: the median of four points of the face, so that one outlier does not decide.
    weights = np.array([[1, 1, 1], [4, 1, 1], [1, 4, 1], [1, 1, 4]], dtype=np.float64)
    weights /= weights.sum(1, keepdims=True)
    inside = np.einsum("kc,fcx->fkx", weights, points[faces]).reshape(-1, 3)
    nearest = surface.query(np.concatenate([inside, np.repeat(normals, 4, axis=0) * turn], 1))[1]
    votes = chosen[nearest].reshape(-1, 4)
    looks = mesh.colors if mesh.uv is None else np.concatenate([mesh.colors, mesh.uv.mean(1)], 1)
    found = looks[votes]
    middle = np.argmin(np.abs(found[:, :, None] - found[:, None]).sum((2, 3)), 1)
    winner = votes[np.arange(len(faces)), middle]

    # Normals: those of the nearest original corner, so that shading shows the detail that the geometry has lost.
    corner_normals = mesh.normals.reshape(-1, 3)
    corners = cKDTree(np.concatenate([mesh.points[mesh.faces].reshape(-1, 3), corner_normals * turn], 1))
    queries = np.concatenate([points[faces].reshape(-1, 3), np.repeat(normals, 3, axis=0) * turn], 1)
    taken = corner_normals[corners.query(queries)[1]].reshape(-1, 3, 3)
    # A normal that faces away from its face would blacken a corner.
    away = (taken * normals[:, None, :]).sum(2) < 0.3
    taken[away] = np.broadcast_to(normals[:, None, :], taken.shape)[away]
    return make_mesh(
        points,
        faces,
        normals=taken,
        uv=None if mesh.uv is None else np.repeat(mesh.uv.mean(1)[winner][:, None], 3, axis=1),
        colors=mesh.colors[winner],
        texture=mesh.texture,
    )
