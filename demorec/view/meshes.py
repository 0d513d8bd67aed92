"""Appearance of the robot and the objects: triangles with normals and colours, from URDF and mesh files.

Mesh files are simplified once and kept in the user's cache folder: the original robot has 100,000 triangles, ten
times as many as make a visible difference.
"""

from __future__ import annotations

import functools
import hashlib
import xml.etree.ElementTree as ElementTree
import zipfile
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import fast_simplification
import numpy as np
import trimesh
from numpy.typing import NDArray

from demorec.core.errors import DemorecError, RecordingError, describe_error
from demorec.core.files import cache_folder, write_whole
from demorec.core.geometry import Pose
from demorec.episode.scene import Rgba
from demorec.robots.assets import mesh_path
from demorec.robots.shape_files import read_collada
from demorec.robots.urdf import Urdf, UrdfShape, read_links

MAX_TRIANGLES = 2500
"""Maximum number of triangles of one mesh file."""
_CREASE = np.radians(35.0)
"""Angle, rad, above which edges stay sharp in shading."""
_ROD_RADIUS = 0.015
"""Radius of rods, metres."""
_SHORTEST_ROD = 1e-3
"""Minimum length of rods, metres."""
_CACHE_VERSION = b"3"
_ARRAYS = ("vertices", "normals", "triangles", "colors")


@dataclass(frozen=True, kw_only=True, eq=False)
class SurfaceMesh:
    """Triangles in a link's or body's frame, metres.

    Attributes:
        vertices, normals: (N, 3) float32.
        triangles: (M, 3) uint32.
        colors: (N, 4) uint8 RGBA.
    """

    vertices: NDArray[np.float32]
    normals: NDArray[np.float32]
    triangles: NDArray[np.uint32]
    colors: NDArray[np.uint8]

    def placed(
        self, pose: Pose | None = None, scale: Sequence[float] | float = 1.0, rgba: Rgba = (1.0, 1.0, 1.0, 1.0)
    ) -> SurfaceMesh:
        """Scale, then move by `pose`, and multiply the colours by `rgba`."""
        pose, factors = pose or Pose(), np.broadcast_to(np.asarray(scale, dtype=np.float64), 3)
        normals = (self.normals / factors) @ pose.rotation.T  # display only: rounding may differ between CPUs
        lengths = np.linalg.norm(normals, axis=1, keepdims=True)
        return SurfaceMesh(
            vertices=pose.apply(self.vertices * factors).astype(np.float32),
            normals=(normals / np.maximum(lengths, 1e-12)).astype(np.float32),
            triangles=self.triangles,
            colors=np.rint(self.colors * np.array(rgba)).astype(np.uint8),
        )


def joined(meshes: list[SurfaceMesh]) -> SurfaceMesh:
    """Merge several meshes into one."""
    offsets = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    return SurfaceMesh(
        vertices=np.concatenate([mesh.vertices for mesh in meshes]),
        normals=np.concatenate([mesh.normals for mesh in meshes]),
        triangles=np.concatenate(
            [mesh.triangles + np.uint32(offset) for mesh, offset in zip(meshes, offsets, strict=True)]
        ),
        colors=np.concatenate([mesh.colors for mesh in meshes]),
    )


def urdf_meshes(
    text: str, folder: Path | None, scale: float = 1.0, *, failures: list[DemorecError] | None = None
) -> dict[str, SurfaceMesh]:
    """Load link -> mesh of all visible links.

    Args:
        text: The URDF.
        folder: Its folder, to find its mesh files; None if unknown, in which case only files in ROS packages or below
            the current folder are found.
        scale: Uniform scale.
        failures: Receives the errors of links, which are left out; None: they are raised.

    Raises:
        RecordingError: A mesh file cannot be read.
        ValueError: The text is not a URDF.
    """
    links = {}
    for link in read_links(text, scale=scale):
        try:
            shapes = [_shape_mesh(shape, folder) for shape in link.visuals if shape.kind != "plane"]
        except DemorecError as error:
            if failures is None:
                raise
            failures.append(error)
            continue
        if shapes:
            links[link.name] = joined(shapes)
    return links


def skeleton_meshes(urdf: Urdf) -> dict[str, SurfaceMesh]:
    """Make link -> rods from its origin to its child joints, for an arm without meshes."""
    links: dict[str, list[SurfaceMesh]] = {}
    for joint in urdf.joints:
        end = joint.parent_from_joint.position
        if np.abs(end).max() > _SHORTEST_ROD:
            rod = trimesh.creation.cylinder(radius=_ROD_RADIUS, segment=[np.zeros(3), end], sections=16)
            links.setdefault(joint.parent, []).append(of_trimesh(rod))
    return {link: joined(rods) for link, rods in links.items()}


def _shape_mesh(shape: UrdfShape, folder: Path | None) -> SurfaceMesh:
    scale: Sequence[float] = (1.0, 1.0, 1.0)
    if shape.kind == "mesh":
        try:
            path = mesh_path(folder, shape.file)
        except DemorecError as error:
            raise RecordingError(str(error)) from error
        mesh, scale = mesh_file(path), shape.size
    elif shape.kind == "box":
        mesh = of_trimesh(trimesh.creation.box(extents=shape.size))
    elif shape.kind == "sphere":
        mesh = sphere_mesh(shape.size[0])
    else:
        mesh = of_trimesh(trimesh.creation.cylinder(radius=shape.size[0], height=shape.size[1], sections=32))
    return mesh.placed(shape.link_from_shape, scale, shape.rgba or (1.0, 1.0, 1.0, 1.0))


def sphere_mesh(radius: float) -> SurfaceMesh:
    """Make a sphere."""
    return of_trimesh(trimesh.creation.icosphere(subdivisions=3, radius=radius))


@functools.lru_cache(maxsize=64)
def mesh_file(path: Path) -> SurfaceMesh:
    """Load a mesh file with the colours of its materials, simplified; from the cache if it was read before.

    Raises:
        RecordingError: It cannot be read.
    """
    try:
        digest = hashlib.sha256(_CACHE_VERSION + path.read_bytes())
        materials = path.with_suffix(".mtl")
        digest.update(materials.read_bytes() if materials.is_file() else b"")
        cached = cache_folder("playback") / f"{digest.hexdigest()[:32]}.npz"
        with suppress(OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile), np.load(cached) as arrays:
            return SurfaceMesh(**{name: arrays[name] for name in _ARRAYS})
        mesh = _read_mesh_file(path)
    except (OSError, ValueError, LookupError, ElementTree.ParseError) as error:
        raise RecordingError(f"The mesh cannot be read ({describe_error(error)}): {path}") from error
    with suppress(OSError):  # an unwritable folder only costs time
        write_whole(cached, lambda file: np.savez(file, **{name: getattr(mesh, name) for name in _ARRAYS}))
    return mesh


def _read_mesh_file(path: Path) -> SurfaceMesh:
    if path.suffix.lower() == ".dae":  # trimesh needs another package for it
        points = read_collada(path).points
        loaded = trimesh.Trimesh(vertices=points, faces=np.arange(len(points)).reshape(-1, 3), process=False)
    else:
        loaded = trimesh.load(path, process=False)
    parts: list[Any] = list(loaded.geometry.values()) if isinstance(loaded, trimesh.Scene) else [loaded]
    total = sum(len(part.faces) for part in parts)
    is_obj = path.suffix.lower() == ".obj"
    # A texture or several materials colour an OBJ file, a single material does not, as in PyBullet.
    colored = not is_obj or len(parts) > 1 or _texture(parts[0]) is not None
    keep = min(1.0, MAX_TRIANGLES / total)
    return joined([_simplified(part, keep, _color(part) if colored else None) for part in parts if len(part.faces)])


def _simplified(part: Any, keep: float, rgba: NDArray[np.uint8] | None) -> SurfaceMesh:
    bare = trimesh.Trimesh(vertices=part.vertices, faces=part.faces, process=False)
    bare.merge_vertices()
    if keep < 1.0 and len(bare.faces) > 100:
        vertices, faces = fast_simplification.simplify(
            bare.vertices.astype(np.float32), bare.faces.astype(np.int32), target_reduction=1.0 - keep
        )
        bare = trimesh.Trimesh(vertices=vertices, faces=faces, process=False)
    return of_trimesh(bare, rgba)


def _texture(part: Any) -> Any:
    return getattr(getattr(part.visual, "material", None), "image", None)


def _color(part: Any) -> NDArray[np.uint8] | None:
    """Compute the part's colour, RGBA; for a texture its mean over the centres of the part's triangles."""
    if _texture(part) is not None:
        middles = part.visual.uv[part.faces].mean(axis=1)
        colors = trimesh.visual.uv_to_color(middles, _texture(part)).astype(np.float64)
        mean: NDArray[np.float64] = np.average(colors, axis=0, weights=part.area_faces)
        return np.rint(mean).astype(np.uint8)
    color = getattr(getattr(part.visual, "material", None), "diffuse", None)
    if color is None and part.visual.defined:  # otherwise trimesh would return grey
        color = getattr(part.visual, "main_color", None)
    return None if color is None else np.array(color, dtype=np.uint8)


def of_trimesh(mesh: Any, rgba: NDArray[np.uint8] | None = None) -> SurfaceMesh:
    """Convert a trimesh mesh, smooth except at creases, in one colour (white if None)."""
    shaded = trimesh.graph.smooth_shade(mesh, angle=_CREASE)
    color = np.full(4, 255, dtype=np.uint8) if rgba is None else rgba
    return SurfaceMesh(
        vertices=np.asarray(shaded.vertices, dtype=np.float32),
        normals=np.asarray(shaded.vertex_normals, dtype=np.float32),
        triangles=np.asarray(shaded.faces, dtype=np.uint32),
        colors=np.tile(color, (len(shaded.vertices), 1)),
    )
