"""Meshes from OBJ, STL and COLLADA files, read as PyBullet reads them."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np

from demorec.core.errors import RenderError, describe_error
from demorec.render.raster.mesh import Floats, RasterMesh, make_mesh
from demorec.robots.shape_files import ObjMaterial, read_collada, read_obj

FORMATS = (".obj", ".stl", ".dae")


def load_mesh(path: Path) -> RasterMesh:
    """Read a mesh file.

    Raises:
        RenderError: The file is missing, of another format, broken or without faces; the message names it.
    """
    suffix = path.suffix.lower()
    if suffix not in FORMATS:
        raise RenderError(
            f"The mesh file {path.name!r} has an unsupported format: convert it to one of {', '.join(FORMATS)}: {path}"
        )
    try:
        mesh = {".obj": load_obj, ".stl": load_stl, ".dae": load_collada}[suffix](path)
    except OSError as error:
        raise RenderError(f"The mesh file cannot be read ({error.strerror}): {path}") from error
    except (ValueError, IndexError, KeyError, ElementTree.ParseError, UnicodeDecodeError) as error:
        raise RenderError(f"The mesh file is broken ({describe_error(error)}): {path}") from error
    if mesh.num_faces == 0:
        raise RenderError(f"The mesh file contains no triangles: {path}")
    if not np.isfinite(mesh.points).all():
        raise RenderError(f"The mesh file contains points that are not finite: {path}")
    return mesh


def load_obj(path: Path) -> RasterMesh:
    """Read an OBJ file with its materials.

    The first texture of the file covers all of it, as in PyBullet. The materials' colours apply if there are several
    and no texture; PyBullet ignores them by default.
    """
    found = read_obj(path)
    index, faces, materials = found.corners, found.faces, found.materials
    texture = next((material.texture for material in materials.values() if material.texture is not None), None)
    uv = None
    if len(found.uvs) and len(faces):
        if index[:, :, 1].max() > len(found.uvs):
            raise ValueError(f"a face names texture coordinate {int(index[:, :, 1].max())} of {len(found.uvs)}")
        # Corners without a coordinate get the middle of the texture, as in Bullet's loader.
        uv = np.concatenate([[[0.5, 0.5]], found.uvs])[index[:, :, 1]]
    colors = None
    if texture is None and len({tuple(material.color) for material in materials.values()}) > 1:
        white = ObjMaterial(color=np.ones(3), texture=None)
        colors = np.array([materials.get(name, white).color for name in found.face_materials])
    corner_normals = None
    if len(found.normals) and len(faces) and index[:, :, 2].min() > 0:
        if index[:, :, 2].max() > len(found.normals):
            raise ValueError(f"a face names normal {int(index[:, :, 2].max())} of {len(found.normals)}")
        corner_normals = found.normals[index[:, :, 2] - 1]
    return make_mesh(found.points, faces, normals=corner_normals, uv=uv, colors=colors, texture=texture)


def load_stl(path: Path) -> RasterMesh:
    """Read a binary or text STL file; normals are recomputed, since the file has only flat ones."""
    data = path.read_bytes()
    count = int.from_bytes(data[80:84], "little") if len(data) >= 84 else -1
    if len(data) == 84 + 50 * count:
        rows = np.frombuffer(data, dtype=np.dtype([("f", "<f4", (4, 3)), ("flags", "<u2")]), offset=84)
        corners: Floats = rows["f"][:, 1:].astype(np.float64).reshape(-1, 3)
    elif data.lstrip().startswith(b"solid"):
        words = [line.split() for line in data.decode().splitlines()]
        corners = np.array([[float(v) for v in w[1:4]] for w in words if w and w[0] == "vertex"])
    else:
        raise ValueError(f"{len(data)} bytes cannot contain the {count} triangles stated in its header")
    return make_mesh(corners.reshape(-1, 3), np.arange(len(corners)).reshape(-1, 3))


def load_collada(path: Path) -> RasterMesh:
    """Read the triangles and polygons of a COLLADA file, placed by the nodes of its scene, in metres."""
    points, normals = read_collada(path)
    corner_normals = None if normals is None else normals.reshape(-1, 3, 3)
    return make_mesh(points, np.arange(len(points)).reshape(-1, 3), normals=corner_normals)
