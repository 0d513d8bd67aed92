"""Reader of Wavefront OBJ files, shared by drawing and description."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

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
    """The triangles of a file, polygons cut into fans.

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
    """Read a file.

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
    """Yield the words of each non-empty line."""
    return filter(None, map(str.split, path.read_text(errors="replace").splitlines()))


def _materials(path: Path) -> dict[str, ObjMaterial]:
    """Read name -> material of an MTL file; a missing file means no materials."""
    found: dict[str, ObjMaterial] = {}
    name = None
    if not path.is_file():
        return found
    for key, *words in _lines(path):
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
