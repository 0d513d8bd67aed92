"""COLLADA files: the triangles of their scenes, read as PyBullet reads them."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


class ColladaTriangles(NamedTuple):
    """Corners of the triangles of a file, three per triangle.

    Attributes:
        points: (3 n, 3) metres.
        normals: (3 n, 3), or None if a part of the file has none.
    """

    points: Floats
    normals: Floats | None


def read_collada(path: Path) -> ColladaTriangles:
    """Read the triangles and polygons of a file, placed by the nodes of its scene, in metres.

    Raises:
        OSError: The file cannot be read.
        ValueError, LookupError, ElementTree.ParseError: It is not COLLADA, or contains no triangles.
    """
    scene = _ColladaScene(ElementTree.parse(path).getroot())
    if not scene.points:
        raise ValueError("no visual scene with triangles")
    points = np.concatenate(scene.points)
    normals = np.concatenate(scene.normals)
    return ColladaTriangles(points, normals if len(normals) == len(points) else None)


class _ColladaScene:
    """The triangles of the visual scenes of a COLLADA document.

    Attributes:
        points, normals: (3 n, 3) at the corners of each part's triangles; no normals if the part has none.
    """

    def __init__(self, root: ElementTree.Element) -> None:
        self.points: list[Floats] = []
        self.normals: list[Floats] = []
        self._tag = root.tag.removesuffix("COLLADA")
        self._by_id = {"#" + node.attrib["id"]: node for node in root.iter() if "id" in node.attrib}
        asset = root.find(f"{self._tag}asset")
        unit = None if asset is None else asset.find(f"{self._tag}unit")
        scale = 1.0 if unit is None else float(unit.attrib.get("meter", 1.0))
        # PyBullet applies the unit but not up_axis; shapes must match its physics.
        axes = np.diag([scale, scale, scale, 1.0])
        for scene in self._all_of(root, "visual_scene"):
            for node in scene.findall(f"{self._tag}node"):
                self._visit(node, axes)

    def _all_of(self, node: ElementTree.Element, name: str) -> list[ElementTree.Element]:
        return node.findall(f".//{self._tag}{name}")

    def _visit(self, node: ElementTree.Element, matrix: Floats) -> None:
        """Collect a node and its descendants; (4, 4) is the transform of its parent."""
        for child in node:
            name = child.tag.removeprefix(self._tag)
            if name in _TRANSFORMS:
                matrix = matrix @ _transform(name, np.array((child.text or "").split(), dtype=np.float64))
        for instance in node.findall(f"{self._tag}instance_geometry"):
            for kind in ("triangles", "polylist", "polygons"):
                for part in self._all_of(self._by_id[instance.attrib["url"]], kind):
                    self._add(part, kind, matrix)
        for child in node.findall(f"{self._tag}node"):
            self._visit(child, matrix)

    def _add(self, part: ElementTree.Element, kind: str, matrix: Floats) -> None:
        inputs = {i.attrib["semantic"]: i for i in part.findall(f"{self._tag}input")}
        stride = 1 + max(int(i.attrib.get("offset", 0)) for i in part.findall(f"{self._tag}input"))
        index = self._fans(part, kind, stride)
        if not len(index):
            return
        linear = matrix[:3, :3]
        self.points.append(self._values(inputs["VERTEX"], index) @ linear.T + matrix[:3, 3])
        if "NORMAL" in inputs:
            self.normals.append(self._values(inputs["NORMAL"], index) @ np.linalg.inv(linear))
        else:
            self.normals.append(np.zeros((0, 3)))

    def _fans(self, part: ElementTree.Element, kind: str, stride: int) -> NDArray[np.int64]:
        """Compute (3 n, stride) input indices at the corners of a part's triangles; polygons are split into fans."""
        rows: list[NDArray[np.int64]] = [
            np.array((p.text or "").split(), dtype=np.int64).reshape(-1, stride) for p in part.findall(f"{self._tag}p")
        ]
        if kind == "polylist":
            counts = [int(v) for v in (part.findtext(f"{self._tag}vcount") or "").split()]
            rows = np.split(rows[0], np.cumsum(counts)[:-1]) if rows and counts else []
        elif kind == "triangles":
            rows = list(rows[0].reshape(-1, 3, stride)) if rows else []
        fans = [row[[0, i, i + 1]] for row in rows for i in range(1, len(row) - 1)]
        return np.concatenate(fans) if fans else np.zeros((0, stride), dtype=np.int64)

    def _values(self, source: ElementTree.Element, index: NDArray[np.int64]) -> Floats:
        """Look up an input's (3 n, 3) values at the corners."""
        return self._resolve(source.attrib["source"])[index[:, int(source.attrib.get("offset", 0))]]

    def _resolve(self, reference: str) -> Floats:
        node = self._by_id[reference]
        if node.tag == f"{self._tag}vertices":
            position = next(i for i in node.findall(f"{self._tag}input") if i.attrib["semantic"] == "POSITION")
            return self._resolve(position.attrib["source"])
        array = node.find(f"{self._tag}float_array")
        accessor = node.find(f".//{self._tag}accessor")
        width = 3 if accessor is None else int(accessor.attrib.get("stride", 3))
        values = [] if array is None or array.text is None else array.text.split()
        return np.array(values, dtype=np.float64).reshape(-1, width)[:, :3]


_TRANSFORMS = ("matrix", "translate", "scale", "rotate")


def _transform(name: str, value: Floats) -> Floats:
    """Build the (4, 4) matrix of one COLLADA transform element."""
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
