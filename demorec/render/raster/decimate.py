"""Meshes with fewer triangles for small images: geometry by quadric collapse, looks taken over from the original."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from demorec.render.raster.mesh import Faces, Floats, RasterMesh, cached_mesh, face_normals, make_mesh, unit, weld

SMALLEST = 64
"""Triangles below which nothing is decimated."""
SAMPLES = 60_000
"""Points on the original surface from which colours are taken over."""
_STUCK = 6.0
"""Times as many triangles as were asked for, from which on the mesh is coarsened before: a Panda's have up to 5.2 times
as many in small images, SO-101's as published 10 to 100 times."""
_CELL = 2.0
"""Extents of the mesh, over the triangles asked for: cells in which its points become one. A quarter of a pixel where
a mesh keeps 9 triangles for each pixel."""


def decimated(read: Callable[[], RasterMesh], num_faces: int, target: int, *, key: str) -> RasterMesh:
    """The mesh with about `target` faces, from the cache when it was made before.

    Args:
        read: Reads the whole mesh.
        num_faces: Of the whole mesh.
        target: Wanted number of faces.
        key: Digest of the mesh's source, under which it is cached.
    """
    if num_faces <= max(target, SMALLEST):
        return read()
    return cached_mesh(f"{key} {target}", lambda: decimate(read(), target))


def decimate(mesh: RasterMesh, target: int) -> RasterMesh:
    """Collapse edges until about `target` faces are left; normals, colours and texture coordinates are transferred."""
    points, kept = _collapsed(mesh, target, tolerance=1e-7)
    if len(kept) > _STUCK * target:
        # Edges that no collapse may touch: CAD programs export holes, threads and letters as they like.
        points, kept = _collapsed(mesh, target, tolerance=_CELL / target)
    kept = kept[(face_normals(points, kept) ** 2).sum(1) > 0]
    return _take_over_looks(mesh, points, kept)


def _collapsed(mesh: RasterMesh, target: int, *, tolerance: float) -> tuple[Floats, Faces]:
    """Points (v, 3) and faces (f, 3) after points within a tolerance (of the extent) became one and edges collapsed."""
    import fast_simplification

    rows, inverse = weld(mesh.points, tolerance)
    faces = inverse[mesh.faces]
    whole = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 0] != faces[:, 2])
    points, kept = fast_simplification.simplify(
        mesh.points[rows].astype(np.float32), faces[whole].astype(np.int32), target_count=int(target), agg=4
    )
    return np.asarray(points, dtype=np.float64), np.asarray(kept, dtype=np.int32)


def _take_over_looks(mesh: RasterMesh, points: Floats, faces: NDArray[np.int32]) -> RasterMesh:
    """Give the faces the looks of the original's nearest surface that looks the same way."""
    from scipy.spatial import cKDTree  # takes a third of a second to load, and is needed once for each mesh

    extent = float(np.ptp(mesh.points, axis=0).max())
    turn = 0.05 * extent  # how far away a surface may be, to be preferred to one that looks another way
    source_normals = face_normals(mesh.points, mesh.faces)
    area = np.sqrt((source_normals * source_normals).sum(1))
    random = np.random.default_rng(0)  # only chooses where the surface is sampled
    chosen = random.choice(len(area), SAMPLES, p=area / area.sum())
    share = random.random((SAMPLES, 2))
    fold = share.sum(1) > 1
    share[fold] = 1 - share[fold]
    corner = mesh.points[mesh.faces[chosen]]
    spots = corner[:, 0] + share[:, :1] * (corner[:, 1] - corner[:, 0]) + share[:, 1:] * (corner[:, 2] - corner[:, 0])
    normals = unit(face_normals(points, faces))
    surface = cKDTree(np.concatenate([spots, unit(source_normals)[chosen] * turn], 1))

    # Colours and palette places: the median of four spots of the face, so that a stray one does not decide.
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
    # One that looks away from its face would blacken a corner.
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
