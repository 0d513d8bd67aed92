"""What the robot and the objects look like: triangles with normals and colours, from URDF and mesh files.

Mesh files are simplified once and kept in the user's cache folder: the original robot has 100,000 triangles, of which
a viewer on a laptop, or in a browser, shows no more than a tenth as something different.
"""

from __future__ import annotations

import functools
import hashlib
import tempfile
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import fast_simplification
import numpy as np
import platformdirs
import trimesh
from numpy.typing import NDArray

from demorec.assets import mesh_path
from demorec.errors import DemorecError, RecordingError
from demorec.geometry import Pose
from demorec.scene import Rgba
from demorec.urdf import parse_xml, quat_from_rpy

MAX_TRIANGLES = 2500
"""Of one mesh file."""
_CREASE = np.radians(35.0)
"""Edges sharper than this stay sharp when a surface is shaded."""
_CACHE_VERSION = b"2"


@dataclass(frozen=True, kw_only=True, eq=False)
class Mesh:
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

    def placed(self, pose: Pose, scale: NDArray[np.float64], rgba: Rgba) -> Mesh:
        """Scaled, then moved by `pose`, its colours multiplied by `rgba`."""
        rotation = pose.rotation
        normals = (self.normals / scale) @ rotation.T  # only drawn: rounding may differ between CPUs
        lengths = np.linalg.norm(normals, axis=1, keepdims=True)
        return Mesh(
            vertices=pose.apply(self.vertices * scale).astype(np.float32),
            normals=(normals / np.maximum(lengths, 1e-12)).astype(np.float32),
            triangles=self.triangles,
            colors=np.rint(self.colors * np.array(rgba)).astype(np.uint8),
        )


def joined(meshes: list[Mesh]) -> Mesh:
    """Several meshes as one."""
    offsets = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    return Mesh(
        vertices=np.concatenate([mesh.vertices for mesh in meshes]),
        normals=np.concatenate([mesh.normals for mesh in meshes]),
        triangles=np.concatenate(
            [mesh.triangles + np.uint32(offset) for mesh, offset in zip(meshes, offsets, strict=True)]
        ),
        colors=np.concatenate([mesh.colors for mesh in meshes]),
    )


def urdf_meshes(text: str, folder: Path | None, scale: float = 1.0) -> dict[str, Mesh]:
    """Link -> what it looks like, of all links that can be seen.

    Args:
        text: The URDF.
        folder: Where it lay, to find its mesh files; None for one without mesh files.
        scale: Uniform scale.

    Raises:
        RecordingError: A mesh file cannot be read.
    """
    robot = parse_xml(text)
    materials = {
        name: rgba for element in robot.iter("material") if (name := element.get("name")) and (rgba := _rgba(element))
    }
    links = {}
    for link in robot.findall("link"):
        meshes = [
            mesh
            for visual in link.findall("visual")
            if (mesh := _visual_mesh(visual, folder, scale, materials)) is not None
        ]
        if meshes:
            links[link.attrib["name"]] = joined(meshes)
    return links


def _visual_mesh(visual: ET.Element, folder: Path | None, scale: float, materials: dict[str, Rgba]) -> Mesh | None:
    rgba: Rgba = (1.0, 1.0, 1.0, 1.0)
    material = visual.find("material")
    if material is not None:
        rgba = _rgba(material) or materials.get(material.get("name", ""), rgba)
    pose = Pose()
    origin = visual.find("origin")
    if origin is not None:
        pose = Pose(
            position=np.array(_numbers(origin.get("xyz", "0 0 0"))) * scale,
            quat_xyzw=quat_from_rpy(_numbers(origin.get("rpy", "0 0 0"))),
        )
    shape = visual.find("geometry/*")
    if shape is None:
        return None
    size = np.full(3, scale)
    if shape.tag == "mesh":
        size = size * np.array(_numbers(shape.get("scale", "1 1 1")))
        mesh = mesh_file(_mesh_path(folder, shape.attrib["filename"]))
    elif shape.tag == "box":
        mesh = of_trimesh(trimesh.creation.box(extents=_numbers(shape.attrib["size"])))
    elif shape.tag == "sphere":
        mesh = sphere_mesh(float(shape.attrib["radius"]))
    elif shape.tag in ("cylinder", "capsule"):
        mesh = of_trimesh(
            trimesh.creation.cylinder(
                radius=float(shape.attrib["radius"]), height=float(shape.attrib["length"]), sections=32
            )
        )
    else:
        return None
    return mesh.placed(pose, size, rgba)


def sphere_mesh(radius: float) -> Mesh:
    """A ball."""
    return of_trimesh(trimesh.creation.icosphere(subdivisions=3, radius=radius))


def _mesh_path(folder: Path | None, name: str) -> Path:
    if folder is not None:
        try:
            return mesh_path(folder, name)
        except DemorecError as error:
            raise RecordingError(str(error)) from error
    raise RecordingError(f"The robot's mesh {name!r} is not beside its URDF: {folder}")


@functools.lru_cache(maxsize=64)
def mesh_file(path: Path) -> Mesh:
    """A mesh file with the colours of its materials, simplified; from the cache when it was read before.

    Raises:
        RecordingError: It cannot be read.
    """
    try:
        digest = hashlib.sha256(_CACHE_VERSION + path.read_bytes())
        materials = path.with_suffix(".mtl")
        digest.update(materials.read_bytes() if materials.is_file() else b"")
        cached = platformdirs.user_cache_path("demorec") / "playback" / f"{digest.hexdigest()[:32]}.npz"
        if cached.is_file():
            with np.load(cached) as arrays:
                return Mesh(**{name: arrays[name] for name in ("vertices", "normals", "triangles", "colors")})
        mesh = _read_mesh_file(path)
    except (OSError, ValueError, KeyError) as error:
        raise RecordingError(f"The mesh cannot be read ({error}): {path}") from error
    _keep(cached, mesh)
    return mesh


def _keep(cached: Path, mesh: Mesh) -> None:
    """Write the cache file as a whole or not at all; a folder that cannot be written only costs time."""
    try:
        cached.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=cached.parent, suffix=".npz", delete=False) as file:
            np.savez(file, vertices=mesh.vertices, normals=mesh.normals, triangles=mesh.triangles, colors=mesh.colors)
        Path(file.name).replace(cached)
    except OSError:
        return


def _read_mesh_file(path: Path) -> Mesh:
    loaded = trimesh.load(path, process=False)
    parts: list[Any] = list(loaded.geometry.values()) if isinstance(loaded, trimesh.Scene) else [loaded]
    total = sum(len(part.faces) for part in parts)
    is_obj = path.suffix.lower() == ".obj"
    # As in PyBullet: a texture, or several materials, colour an OBJ file; a single material does not.
    colored = not is_obj or len(parts) > 1 or _texture(parts[0]) is not None
    keep = min(1.0, MAX_TRIANGLES / total)
    return joined([_simplified(part, keep, _color(part) if colored else None) for part in parts if len(part.faces)])


def _simplified(part: Any, keep: float, rgba: NDArray[np.uint8] | None) -> Mesh:
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
    """The part's colour, RGBA; of a texture its mean over the middles of the part's triangles."""
    if _texture(part) is not None:
        middles = part.visual.uv[part.faces].mean(axis=1)
        colors = trimesh.visual.uv_to_color(middles, _texture(part)).astype(np.float64)
        mean: NDArray[np.float64] = np.average(colors, axis=0, weights=part.area_faces)
        return np.rint(mean).astype(np.uint8)
    color = getattr(getattr(part.visual, "material", None), "diffuse", None)
    if color is None:
        color = getattr(part.visual, "main_color", None)
    return None if color is None else np.array(color, dtype=np.uint8)


def of_trimesh(mesh: Any, rgba: NDArray[np.uint8] | None = None) -> Mesh:
    """A trimesh mesh, smooth but for its creases, in one colour (white when None)."""
    shaded = trimesh.graph.smooth_shade(mesh, angle=_CREASE)
    color = np.full(4, 255, dtype=np.uint8) if rgba is None else rgba
    return Mesh(
        vertices=np.asarray(shaded.vertices, dtype=np.float32),
        normals=np.asarray(shaded.vertex_normals, dtype=np.float32),
        triangles=np.asarray(shaded.faces, dtype=np.uint32),
        colors=np.tile(color, (len(shaded.vertices), 1)),
    )


def _rgba(material: ET.Element) -> Rgba | None:
    color = material.find("color")
    if color is None:
        return None
    r, g, b, a = _numbers(color.attrib["rgba"])
    return (r, g, b, a)


def _numbers(text: str) -> list[float]:
    return [float(word) for word in text.split()]
