"""Readers of Wavefront OBJ and COLLADA files, shared by drawing and description; COLLADA as PyBullet reads it."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from demorec.core.geometry import Array


@dataclass(frozen=True, kw_only=True, eq=False)
class ObjMaterial:
    """Colour of a face.

    Attributes:
        color: (3,) diffuse RGB, 0..1.
        texture: Image, if it exists.
    """

    color: Array
    texture: Path | None


@dataclass(frozen=True, kw_only=True, eq=False)
class ObjFile:
    """The triangles of an OBJ file, polygons cut into fans.

    Attributes:
        points: (V, 3) in the file's unit.
        uvs: (U, 2) texture coordinates.
        normals: (N, 3) unnormalised, as in the file.
        corners: (F, 3, 3) for each corner of each triangle: the numbers of its point, texture coordinate and normal,
            counted from 1; 0 if missing. Point numbers are validated, the others are not.
        face_materials: (F,) name of each triangle's material, "" without one.
        materials: Name -> material, from the existing MTL files that it names.
    """

    points: Array
    uvs: Array
    normals: Array
    corners: NDArray[np.int64]
    face_materials: tuple[str, ...]
    materials: Mapping[str, ObjMaterial]

    @property
    def faces(self) -> NDArray[np.int64]:
        """(F, 3) rows of `points`."""
        return self.corners[:, :, 0] - 1


def read_obj(path: Path) -> ObjFile:
    """Read an OBJ file.

    Raises:
        OSError: It cannot be read.
        ValueError, IndexError: It is not an OBJ file, or a face refers to a missing point.
    """
    points: list[list[float]] = []
    uvs: list[list[float]] = []
    normals: list[list[float]] = []
    corners: list[tuple[int, int, int]] = []
    face_materials: list[str] = []
    materials: dict[str, ObjMaterial] = {}
    material = ""

    def parse(corner: str) -> tuple[int, int, int]:
        parts = corner.split("/")
        if "-" not in corner and len(parts) == 3 and "" not in parts:
            return int(parts[0]), int(parts[1]), int(parts[2])
        parts = [*parts, "", ""][:3]
        # Negative numbers count back from the latest; 0 means "none".
        counts = (len(points), len(uvs), len(normals))
        a, b, c = (
            0 if not part else int(part) + (count + 1 if part[0] == "-" else 0)
            for part, count in zip(parts, counts, strict=True)
        )
        return a, b, c

    for key, *words in _lines(path):
        if key == "v":
            points.append([float(words[0]), float(words[1]), float(words[2])])
        elif key == "vt":
            uvs.append([float(words[0]), float(words[1]) if len(words) > 1 else 0.0])
        elif key == "vn":
            normals.append([float(words[0]), float(words[1]), float(words[2])])
        elif key == "f":
            polygon = [parse(word) for word in words]
            for i in range(1, len(polygon) - 1):
                corners += [polygon[0], polygon[i], polygon[i + 1]]
                face_materials.append(material)
        elif key == "mtllib":
            materials |= _materials(path.parent / " ".join(words))
        elif key == "usemtl":
            material = " ".join(words)
    found = ObjFile(
        points=np.array(points, dtype=np.float64).reshape(-1, 3),
        uvs=np.array(uvs, dtype=np.float64).reshape(-1, 2),
        normals=np.array(normals, dtype=np.float64).reshape(-1, 3),
        corners=np.array(corners, dtype=np.int64).reshape(-1, 3, 3),
        face_materials=tuple(face_materials),
        materials=materials,
    )
    faces = found.faces
    if len(faces) and (faces.min() < 0 or faces.max() >= len(points)):
        raise ValueError(f"a face names vertex {int(faces.max()) + 1} of {len(points)}")
    return found


def _lines(path: Path) -> Iterator[list[str]]:
    return filter(None, map(str.split, path.read_text(errors="replace").splitlines()))


def _materials(path: Path) -> dict[str, ObjMaterial]:
    """Read name -> material of an MTL file; a missing file means no materials."""
    found: dict[str, ObjMaterial] = {}
    name = None
    for key, *words in _lines(path) if path.is_file() else ():
        if key == "newmtl":
            name = " ".join(words)
            found[name] = ObjMaterial(color=np.ones(3), texture=None)
        elif name is not None and key == "Kd" and len(words) >= 3:
            color = np.array([float(word) for word in words[:3]])
            found[name] = ObjMaterial(color=color, texture=found[name].texture)
        elif name is not None and key == "map_Kd" and words:
            # Options (-s 1 1 1, ...) precede the name.
            texture = path.parent / words[-1]
            found[name] = ObjMaterial(color=found[name].color, texture=texture if texture.is_file() else None)
    return found


class ColladaTriangles(NamedTuple):
    """Corners of the triangles of a file, three per triangle.

    Attributes:
        points: (3 n, 3) metres.
        normals: (3 n, 3), or None if a part of the file has none.
    """

    points: Array
    normals: Array | None


def read_collada(path: Path) -> ColladaTriangles:
    """Read the triangles and polygons of a file, placed by the nodes of its scene, in metres.

    Raises:
        OSError: The file cannot be read.
        ValueError, LookupError, ElementTree.ParseError: It is not COLLADA, or contains no triangles.
    """
    root = ElementTree.parse(path).getroot()
    for element in root.iter():
        element.tag = element.tag.rpartition("}")[2]  # without the namespace
    by_id = {f"#{element.attrib['id']}": element for element in root.iter() if "id" in element.attrib}
    unit = root.find("asset/unit")
    scale = 1.0 if unit is None else float(unit.attrib.get("meter", 1.0))
    # PyBullet applies the unit but not up_axis; shapes must match its physics.
    axes = np.diag([scale, scale, scale, 1.0])
    points: list[Array] = []
    normals: list[Array] = []
    for name, matrix in [found for scene in root.iter("visual_scene") for found in _geometries(scene, axes)]:
        for part in [part for kind in _PARTS for part in by_id[name].iter(kind)]:
            inputs = {each.attrib["semantic"]: each for each in part.findall("input")}
            index = _fans(part, stride=1 + max(int(each.attrib.get("offset", 0)) for each in part.findall("input")))
            if not len(index):
                continue
            points.append(_values(inputs["VERTEX"], index, by_id) @ matrix[:3, :3].T + matrix[:3, 3])
            if "NORMAL" in inputs:
                normals.append(_values(inputs["NORMAL"], index, by_id) @ np.linalg.inv(matrix[:3, :3]))
    if not points:
        raise ValueError("no visual scene with triangles")
    has_normals = sum(map(len, normals)) == sum(map(len, points))
    return ColladaTriangles(np.concatenate(points), np.concatenate(normals) if has_normals else None)


def _geometries(node: ElementTree.Element, matrix: Array) -> Iterator[tuple[str, Array]]:
    """Yield the reference of each geometry of a node and its descendants, and its (4, 4) place in metres."""
    for child in node:
        if child.tag in _TRANSFORMS:
            matrix = matrix @ _transform(child.tag, np.array((child.text or "").split(), dtype=np.float64))
    for instance in node.findall("instance_geometry"):
        yield instance.attrib["url"], matrix
    for child in node.findall("node"):
        yield from _geometries(child, matrix)


def _fans(part: ElementTree.Element, *, stride: int) -> NDArray[np.int64]:
    """Compute (3 n, stride) input indices at the corners of a part's triangles; polygons are split into fans."""
    rows: list[NDArray[np.int64]] = [
        np.array((p.text or "").split(), dtype=np.int64).reshape(-1, stride) for p in part.findall("p")
    ]
    if part.tag == "polylist":
        counts = [int(v) for v in (part.findtext("vcount") or "").split()]
        rows = np.split(rows[0], np.cumsum(counts)[:-1]) if rows and counts else []
    elif part.tag == "triangles":
        rows = list(rows[0].reshape(-1, 3, stride)) if rows else []
    fans = [row[[0, i, i + 1]] for row in rows for i in range(1, len(row) - 1)]
    return np.concatenate(fans) if fans else np.zeros((0, stride), dtype=np.int64)


def _values(source: ElementTree.Element, index: NDArray[np.int64], by_id: Mapping[str, ElementTree.Element]) -> Array:
    """Read the (3 n, 3) vectors of an input at the corners of triangles."""
    node = by_id[source.attrib["source"]]
    if node.tag == "vertices":
        node = by_id[next(i for i in node.findall("input") if i.attrib["semantic"] == "POSITION").attrib["source"]]
    accessor = node.find(".//accessor")
    width = 3 if accessor is None else int(accessor.attrib.get("stride", 3))
    values = np.array((node.findtext("float_array") or "").split(), dtype=np.float64)
    return values.reshape(-1, width)[:, :3][index[:, int(source.attrib.get("offset", 0))]]


_PARTS = ("triangles", "polylist", "polygons")
_TRANSFORMS = ("matrix", "translate", "scale", "rotate")


def _transform(name: str, value: Array) -> Array:
    if name == "matrix":
        return value.reshape(4, 4)
    m = np.eye(4)
    if name == "translate":
        m[:3, 3] = value
    elif name == "scale":
        m[:3, :3] = np.diag(value)
    else:
        axis = value[:3] / np.sqrt((value[:3] ** 2).sum())
        angle = np.radians(value[3])
        cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
        m[:3, :3] = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * (cross @ cross)
    return m
