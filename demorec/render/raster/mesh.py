"""Triangle meshes in the renderer's form, their one-time geometry processing, and their cache between runs."""

from __future__ import annotations

import functools
import hashlib
import logging
import math
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from demorec.core.files import cache_folder, folder_lock, write_whole

log = logging.getLogger(__name__)
Floats = NDArray[np.float64]
Faces = NDArray[np.int32]
CREASE_ANGLE = math.radians(35)
"""Angle between faces, rad, above which they are shaded as an edge."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RasterMesh:
    """Triangles with a normal and a texture coordinate at each corner.

    Attributes:
        points: (v, 3) metres, in the shape's frame.
        faces: (f, 3) rows of `points`, counter-clockwise from outside.
        normals: (f, 3, 3) unit normal at each corner.
        uv: (f, 3, 2) texture coordinates at each corner, v upward; None if missing.
        colors: (f, 3) colour of each face, 0..1, multiplied by the shape's colour.
        texture: Image that covers the faces, or None.
    """

    points: Floats
    faces: Faces
    normals: Floats
    uv: Floats | None
    colors: Floats
    texture: Path | None

    @property
    def num_faces(self) -> int:
        """Number of faces, f."""
        return len(self.faces)


def make_mesh(
    points: Floats,
    faces: NDArray[np.integer],
    *,
    normals: Floats | None = None,
    uv: Floats | None = None,
    colors: Floats | None = None,
    texture: Path | None = None,
) -> RasterMesh:
    """Build a mesh without empty faces; default normals are smooth up to the crease angle, default faces white."""
    faces = np.asarray(faces, dtype=np.int32).reshape(-1, 3)
    keep = np.flatnonzero((face_normals(points, faces) ** 2).sum(1) > 0)
    if len(keep) < len(faces):
        faces = faces[keep]
        normals, uv, colors = (None if a is None else a[keep] for a in (normals, uv, colors))
    if normals is None:
        normals = crease_normals(points, faces)
    else:
        # Zero normals, which some exporters write, are replaced by the face's.
        length = np.sqrt((normals * normals).sum(2, keepdims=True))
        flat = unit(face_normals(points, faces))[:, None, :]
        normals = np.where(length > 1e-6, normals / np.maximum(length, 1e-12), flat)
    return RasterMesh(
        points=points,
        faces=faces,
        normals=normals,
        uv=uv,
        colors=np.ones((len(faces), 3)) if colors is None else colors,
        texture=texture,
    )


def unit(vectors: Floats) -> Floats:
    """Normalise vectors (..., 3) to length 1; zero vectors are unchanged."""
    length = np.sqrt((vectors * vectors).sum(-1, keepdims=True))
    return np.asarray(vectors / np.maximum(length, 1e-30))


def face_normals(points: Floats, faces: NDArray[np.integer]) -> Floats:
    """Compute (f, 3) normals with twice the face's area as length."""
    a, b, c = points[faces[:, 0]], points[faces[:, 1]], points[faces[:, 2]]
    return np.asarray(np.cross(b - a, c - a))


def weld(points: Floats, tolerance: float = 1e-7) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Find distinct points; returns their rows, and the number of the distinct point for each point."""
    extent = float(np.ptp(points, axis=0).max()) if len(points) else 1.0
    grid = np.round((points - points.min(0)) / max(extent * tolerance, 1e-12)).astype(np.int64)
    _, rows, inverse = np.unique(grid, axis=0, return_index=True, return_inverse=True)
    return rows, inverse.reshape(-1)


def crease_normals(points: Floats, faces: Faces, angle: float = CREASE_ANGLE) -> Floats:
    """Compute (f, 3, 3) corner normals: the area-weighted mean of the faces around a point within `angle`."""
    if len(faces) == 0:
        return np.zeros((0, 3, 3))
    from scipy.sparse import coo_matrix  # slow import (0.3 s), needed once for each mesh

    _, inverse = weld(points)
    normals = face_normals(points, faces)
    units = unit(normals)
    corner_point = inverse[faces].reshape(-1)
    corner_face = np.repeat(np.arange(len(faces)), 3)
    # Pairs (corner, face) that share a point: the product of two incidence matrices.
    shape = (len(corner_point), int(inverse.max()) + 1)
    ones = np.ones(len(corner_point), dtype=np.int8)
    at_point = coo_matrix((ones, (np.arange(len(corner_point)), corner_point)), shape=shape).tocsr()
    pairs = (at_point @ at_point.T).tocoo()
    first, second = corner_face[pairs.row], corner_face[pairs.col]
    near = (units[first] * units[second]).sum(1) > math.cos(angle)
    total = np.zeros((len(corner_point), 3))
    np.add.at(total, pairs.row[near], normals[second[near]])
    empty = (total * total).sum(1) < 1e-30
    total[empty] = units[corner_face[empty]]
    return np.asarray(unit(total).reshape(-1, 3, 3))


_SOURCES = ("mesh.py", "mesh_files.py", "decimate.py", "textures.py")


@functools.cache
def _version() -> str:
    """Digest of the code that makes meshes, so that another version does not read this one's cache."""
    digest = hashlib.sha256()
    for name in _SOURCES:
        digest.update((Path(__file__).parent / name).read_bytes())
    return digest.hexdigest()[:16]


def cached_mesh(key: str, make: Callable[[], RasterMesh]) -> RasterMesh:
    """Return a mesh from the cache, or call `make` and store its result under the key.

    An unreadable cache file is replaced; an unwritable folder only costs time. If several processes ask at once, one
    makes the mesh and the others wait.
    """
    name = hashlib.sha256(key.encode()).hexdigest()[:32]
    path = cache_folder("meshes", _version()) / f"{name}.npz"
    mesh = _read(path)
    if mesh is not None:
        return mesh
    with folder_lock(path.parent):
        mesh = _read(path)
        return mesh if mesh is not None else _make(path, make)


def _make(path: Path, make: Callable[[], RasterMesh]) -> RasterMesh:
    mesh = make()
    arrays = {name: value for name, value in vars(mesh).items() if isinstance(value, np.ndarray)}
    texture = np.array("" if mesh.texture is None else str(mesh.texture))
    try:
        write_whole(path, lambda temporary: np.savez(temporary, **arrays, texture=texture))  # type: ignore[arg-type]
    except OSError as error:
        log.warning("The mesh cache cannot be written (%s): %s", error.strerror, path)
    return mesh


def _read(path: Path) -> RasterMesh | None:
    try:
        with np.load(path) as data:
            texture = str(data["texture"])
            return RasterMesh(
                points=data["points"],
                faces=data["faces"],
                normals=data["normals"],
                uv=data["uv"] if "uv" in data.files else None,
                colors=data["colors"],
                texture=Path(texture) if texture else None,
            )
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None
