"""Appearance of the robot and the objects: the renderer's meshes, moved, coloured and merged for Rerun."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import rerun as rr

from demorec.core.errors import DemorecError
from demorec.core.geometry import Pose
from demorec.episode.scene import Rgba
from demorec.render.raster import primitives
from demorec.render.raster.decimate import decimated
from demorec.render.raster.mesh import RasterMesh, face_normals, unit
from demorec.render.raster.shapes import ModelStore
from demorec.render.raster.textures import face_texels
from demorec.robots.assets import mesh_path
from demorec.robots.urdf import UrdfShape, read_links

MAX_FACES = 2048
"""Approximate maximum number of triangles of one mesh file: the original robot has 100,000, ten times as many as make a
visible difference."""
WHITE: Rgba = (1.0, 1.0, 1.0, 1.0)
"""Colour that leaves a mesh's own unchanged."""


def placed(
    mesh: RasterMesh, pose: Pose | None = None, scale: Sequence[float] | float = 1.0, rgba: Rgba = WHITE
) -> RasterMesh:
    """Scale, then move by `pose`, and multiply the colours by `rgba`."""
    pose, factors = pose or Pose(), np.broadcast_to(np.asarray(scale, dtype=np.float64), 3)
    return replace(
        mesh,
        points=pose.apply(mesh.points * factors),
        normals=unit(mesh.normals / factors) @ pose.rotation.T,  # display only: rounding may differ between CPUs
        colors=mesh.colors * rgba[:3],
    )


def joined(meshes: Sequence[RasterMesh]) -> RasterMesh:
    """Merge several meshes into one, without textures."""
    starts = np.cumsum([0, *(len(mesh.points) for mesh in meshes[:-1])])
    return RasterMesh(
        points=np.concatenate([mesh.points for mesh in meshes]),
        faces=np.concatenate([mesh.faces + np.int32(start) for mesh, start in zip(meshes, starts, strict=True)]),
        normals=np.concatenate([mesh.normals for mesh in meshes]),
        uv=None,
        colors=np.concatenate([mesh.colors for mesh in meshes]),
        texture=None,
    )


def as_mesh3d(mesh: RasterMesh) -> rr.Mesh3D:
    """Convert to Rerun, with one vertex for each position, normal and colour."""
    colors = np.repeat(mesh.colors[:, None], 3, axis=1)
    corners = np.concatenate([mesh.points[mesh.faces], mesh.normals, colors], axis=2).reshape(-1, 9)
    vertices, rows = np.unique(corners.astype(np.float32), axis=0, return_inverse=True)
    return rr.Mesh3D(
        vertex_positions=vertices[:, :3],
        vertex_normals=vertices[:, 3:6],
        triangle_indices=rows.reshape(-1, 3),
        vertex_colors=np.rint(255 * vertices[:, 6:]).astype(np.uint8),
    )


def urdf_meshes(
    text: str, folder: Path | None, scale: float = 1.0, *, failures: list[DemorecError] | None = None
) -> dict[str, RasterMesh]:
    """Load link -> mesh of all visible links.

    Args:
        text: The URDF.
        folder: Its folder, to find its mesh files; None if unknown, in which case only files in ROS packages or below
            the current folder are found.
        scale: Uniform scale.
        failures: Receives the errors of links, which are left out; None: they are raised.

    Raises:
        SceneError, RenderError: A mesh file is missing or cannot be read.
        ValueError: The text is not a URDF.
    """
    links = {}
    for link in read_links(text, scale=scale):
        try:
            shapes = [_shape_mesh(shape, folder) for shape in link.visuals]
        except DemorecError as error:
            if failures is None:
                raise
            failures.append(error)
            continue
        if shapes:
            links[link.name] = joined(shapes)
    return links


def _shape_mesh(shape: UrdfShape, folder: Path | None) -> RasterMesh:
    rgba = shape.rgba or WHITE
    if shape.kind == "mesh":
        return placed(mesh_file(mesh_path(folder, shape.file)), shape.link_from_shape, shape.size, rgba)
    return placed(primitive(shape.kind, shape.size), shape.link_from_shape, rgba=rgba)


@functools.lru_cache(maxsize=64)
def primitive(kind: str, size: tuple[float, ...]) -> RasterMesh:
    """Make a box (x, y, z), sphere (radius), or a cylinder or capsule along z (radius, length)."""
    mesh: RasterMesh = getattr(primitives, kind)(*size)
    return mesh


@functools.lru_cache(maxsize=64)
def mesh_file(path: Path) -> RasterMesh:
    """Load a mesh file as the renderer does, with about `MAX_FACES` triangles and a texture's mean colour.

    Raises:
        RenderError: It cannot be read.
    """
    store = ModelStore()
    model = store.file(path)
    mesh = decimated(model.read, model.num_faces, MAX_FACES, key=model.key)
    if mesh.texture is None or mesh.uv is None:
        return mesh
    texels = face_texels(mesh.uv, store.image(mesh.texture))[:, 3]
    double_areas = np.sqrt((face_normals(mesh.points, mesh.faces) ** 2).sum(axis=1))
    color = np.average(texels, axis=0, weights=double_areas) / 255
    return replace(mesh, colors=np.tile(color, (mesh.num_faces, 1)), texture=None)
