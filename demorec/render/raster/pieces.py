"""Meshes laid out for drawing: distinct vertices, face flags and groups; made once for each mesh and level."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from demorec.render.raster.kernels import layout
from demorec.render.raster.mesh import Floats, RasterMesh, unit, weld


@dataclass(frozen=True, kw_only=True, eq=False)
class Piece:
    """One mesh, ready to be scaled and merged.

    Attributes:
        vertices: (v, 8) position, normal, texture coordinates (u, v).
        faces: (f, 3) rows of `vertices`.
        flags: (f,) layout.SMOOTH or 0, and layout.TEXTURED.
        groups: (f,) faces of one colour and, where flat, direction have one number, from 0.
        colors: (f, 3) 0..1; white when textured.
        points, point_faces: (p, 3), (f, 3) positions alone, welded, for the shadow map.
    """

    vertices: Floats
    faces: NDArray[np.int64]
    flags: NDArray[np.int32]
    groups: NDArray[np.int64]
    colors: Floats
    points: Floats
    point_faces: NDArray[np.int64]

    def scaled_vertices(self, scale: Floats) -> Floats:
        """(v, 8) with each axis scaled, normals upright again."""
        result = self.vertices.copy()
        result[:, :3] *= scale
        result[:, 3:6] = unit(result[:, 3:6] / scale)
        return result

    def oriented(self, faces: NDArray[np.int64], scale: Floats) -> NDArray[np.int64]:
        """Faces that still look outward when the scale mirrors."""
        return faces[:, ::-1] if float(np.prod(scale)) < 0 else faces


def make_piece(mesh: RasterMesh, *, textured: bool) -> Piece:
    """Lay a mesh out."""
    n = mesh.num_faces
    uv = mesh.uv if textured and mesh.uv is not None else np.zeros((n, 3, 2))
    corners = np.concatenate([mesh.points[mesh.faces], mesh.normals, uv], 2).reshape(-1, 8)
    _, first, inverse = np.unique(corners.astype(np.float32), axis=0, return_index=True, return_inverse=True)
    flat = np.abs(mesh.normals - mesh.normals[:, :1]).max((1, 2)) < 1e-4
    colors = np.ones((n, 3)) if textured else mesh.colors
    direction = np.where(flat[:, None], np.round(mesh.normals[:, 0] * 50), 99)
    looks = np.concatenate([np.round(colors * 255), direction], 1)
    rows, point_inverse = weld(mesh.points)
    return Piece(
        vertices=corners[first],
        faces=inverse.reshape(-1, 3).astype(np.int64),
        flags=np.where(flat, 0, layout.SMOOTH).astype(np.int32) | (layout.TEXTURED if textured else 0),
        groups=np.unique(looks, axis=0, return_inverse=True)[1].reshape(-1),
        colors=colors,
        points=mesh.points[rows],
        point_faces=point_inverse[mesh.faces],
    )
