"""URDF text of the robot and of each body that needs no other file to be drawn: meshes as a handful of primitives.

Rerun draws the robot of a bare recording from its URDF, but gives up on the whole robot when one mesh file is not
where the URDF says. So the recorded description has no meshes, but boxes, cylinders and spheres. They stand along the
axes of the link, and a part is cut in two as long as that saves enough volume; only comparisons and sums are used, so
that the same mesh gives the same text on every CPU.
"""

from __future__ import annotations

import functools
import math
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from demorec.core.errors import SceneError, describe_error
from demorec.core.geometry import Array, Pose
from demorec.episode.scene import Body, Rgba
from demorec.robots.assets import asset_path, mesh_path, surface_file
from demorec.robots.obj import read_obj
from demorec.robots.urdf import UrdfShape, parse_xml, quat_from_rpy, read_links

_WHITE: Rgba = (1.0, 1.0, 1.0, 1.0)
_KINDS: dict[str, Literal["box", "sphere", "cylinder"]] = {
    "box": "box",
    "sphere": "sphere",
    "cylinder": "cylinder",
    "capsule": "cylinder",
}
"""Shape -> the primitive that it is, but for a capsule's ends."""


@functools.lru_cache(maxsize=8)
def robot_description(urdf: str, scale: float) -> str:
    """The robot with every mesh replaced by primitives, without masses and collision shapes.

    Raises:
        SceneError: The URDF or one of its meshes cannot be read.
    """
    path = asset_path(urdf)
    return self_contained(path.read_text(), path.parent, scale=scale)


def self_contained(text: str, folder: Path, *, scale: float = 1.0) -> str:
    """A URDF that needs no other file, as `robot_description`, of the text of one whose meshes lie below `folder`.

    Raises:
        SceneError: One of its meshes cannot be read.
        ValueError: The text is no URDF.
    """
    source = parse_xml(text)
    robot = ET.Element("robot", name=source.get("name", "robot"))
    for link in read_links(text, scale=scale):
        target = ET.SubElement(robot, "link", name=link.name)
        # Collision shapes are simpler to begin with; their pose may differ from the image's.
        is_fitted = bool(link.visuals and link.collisions) and all(shape.kind in _KINDS for shape in link.collisions)
        shapes = link.collisions if is_fitted or len(link.collisions) == len(link.visuals) else link.visuals
        for index, shape in enumerate(shapes):
            visual = link.visuals[min(index, len(link.visuals) - 1)]
            for primitive in _primitives(shape, folder):
                _add_visual(target, primitive, shape.link_from_shape, visual.rgba or _WHITE)
    for joint in source.findall("joint"):
        robot.append(_joint(joint, scale))
    return _text(robot)


def body_description(body: Body) -> str:
    """A URDF of one link, named like the body."""
    robot = ET.Element("robot", name=body.name)
    link = ET.SubElement(robot, "link", name=body.name)
    for primitive, pose in _body_primitives(body):
        _add_visual(link, primitive, pose, body.mean_color)
    return _text(robot)


def _body_primitives(body: Body) -> Iterator[tuple[Primitive, Pose]]:
    shape = body.shape
    if shape.kind == "mesh":
        for primitive in _mesh_primitives(surface_file(shape), (shape.scale,) * 3):
            yield primitive, shape.body_from_mesh
    elif shape.kind == "urdf":
        path = asset_path(shape.file)
        for link in read_links(path.read_text(), scale=shape.scale):
            for visual in link.visuals:
                for primitive in _primitives(visual, path.parent):
                    yield primitive, visual.link_from_shape
    else:
        yield Primitive(kind=_KINDS[shape.kind], size=shape.size), Pose()
        if shape.kind == "capsule":
            radius, length = shape.size
            for end in (-length / 2, length / 2):
                yield Primitive(kind="sphere", center=(0.0, 0.0, end), size=(radius,)), Pose()


def _primitives(shape: UrdfShape, folder: Path) -> Iterator[Primitive]:
    """A shape of a URDF as primitives in its own frame."""
    if shape.kind == "mesh":
        yield from _mesh_primitives(mesh_path(folder, shape.file), shape.size)
    elif shape.kind in _KINDS:
        yield Primitive(kind=_KINDS[shape.kind], size=shape.size)


@functools.lru_cache(maxsize=256)
def _mesh_primitives(path: Path, scale: tuple[float, ...]) -> list[Primitive]:
    try:
        if path.suffix.lower() == ".obj":
            found = read_obj(path)
            if not len(found.faces):
                raise ValueError("no triangles")
            vertices, faces = found.points, found.faces
        else:
            import trimesh  # takes a second to load, and the usual robot needs it for nothing

            mesh = trimesh.load(path, force="mesh", process=False)
            vertices = np.asarray(mesh.vertices, dtype=np.float64)
            faces = np.asarray(mesh.faces, dtype=np.int64)
    except (OSError, ValueError, IndexError) as error:
        raise SceneError(f"A mesh of the scene cannot be read ({describe_error(error)}): {path}") from error
    return fit_primitives(vertices * np.array(scale), faces)


def _add_visual(link: ET.Element, primitive: Primitive, frame: Pose, rgba: Sequence[float]) -> None:
    half = math.pi / 2
    along = {0: (0.0, half, 0.0), 1: (-half, 0.0, 0.0), 2: (0.0, 0.0, 0.0)}[primitive.axis]
    pose = frame @ Pose(position=np.array(primitive.center), quat_xyzw=quat_from_rpy(along))
    visual = ET.SubElement(link, "visual")
    ET.SubElement(visual, "origin", xyz=_numbers(pose.position.tolist()), rpy=_numbers(_rpy(pose)))
    geometry = ET.SubElement(visual, "geometry")
    if primitive.kind == "box":
        ET.SubElement(geometry, "box", size=_numbers(primitive.size))
    elif primitive.kind == "sphere":
        ET.SubElement(geometry, "sphere", radius=_numbers(primitive.size))
    else:
        radius, length = primitive.size
        ET.SubElement(geometry, "cylinder", radius=_numbers((radius,)), length=_numbers((length,)))
    material = ET.SubElement(visual, "material", name="color_" + "_".join(f"{round(v * 255):02x}" for v in rgba))
    ET.SubElement(material, "color", rgba=_numbers(rgba))


def _rpy(pose: Pose) -> tuple[float, float, float]:
    """Roll, pitch, yaw about fixed axes (rad), as URDF has them."""
    r = pose.rotation
    pitch = math.asin(min(1.0, max(-1.0, -float(r[2, 0]))))
    if abs(r[2, 0]) > 1 - 1e-9:  # roll and yaw turn about the same axis
        return math.atan2(-float(r[1, 2]), float(r[1, 1])), pitch, 0.0
    return math.atan2(float(r[2, 1]), float(r[2, 2])), pitch, math.atan2(float(r[1, 0]), float(r[0, 0]))


def _joint(source: ET.Element, scale: float) -> ET.Element:
    joint = ET.Element("joint", name=source.attrib["name"], type=source.attrib["type"])
    for child in source:
        if child.tag not in ("origin", "parent", "child", "axis", "limit", "mimic"):
            continue
        copy = ET.SubElement(joint, child.tag, dict(child.attrib))
        if child.tag == "origin" and scale != 1.0:
            # Every bit, since kinematics is computed from this; a single product is the same on every CPU.
            copy.set("xyz", " ".join(repr(float(v) * scale) for v in child.get("xyz", "0 0 0").split()))
        if child.tag == "limit" and scale != 1.0 and joint.get("type") == "prismatic":
            for bound in ("lower", "upper"):
                copy.set(bound, _numbers([float(child.get(bound, "0")) * scale]))
    return joint


def _numbers(values: Sequence[float]) -> str:
    # Tenths of a millimetre and of a milliradian: more would only differ between CPUs.
    return " ".join(f"{round(value, 4) + 0.0:g}" for value in values)


def _text(robot: ET.Element) -> str:
    ET.indent(robot, " ")
    return ET.tostring(robot, encoding="unicode") + "\n"


_SPACING = 0.025
"""Of the points on the surface, as a part of the mesh's diagonal."""


@dataclass(frozen=True, kw_only=True)
class Primitive:
    """A box, cylinder or sphere.

    Attributes:
        kind: Which.
        center: (x, y, z) in the mesh's frame.
        axis: 0, 1 or 2: the cylinder's direction; 2 for the others.
        size: box: full extents; cylinder: (radius, length); sphere: (radius,).
        volume: Of one that was fitted to a mesh.
    """

    kind: Literal["box", "cylinder", "sphere"]
    size: tuple[float, ...]
    center: tuple[float, float, float] = (0.0, 0.0, 0.0)
    axis: int = 2
    volume: float = 0.0


def fit_primitives(
    vertices: Array, faces: NDArray[np.int64], *, max_parts: int = 6, min_saving: float = 0.03
) -> list[Primitive]:
    """Cover a mesh with primitives.

    Args:
        vertices: (V, 3).
        faces: (F, 3) indices of triangles.
        max_parts: At most so many.
        min_saving: A cut must save this part of the first primitive's volume.
    """
    points = surface_points(vertices, faces)
    parts = [points]
    fits = [_fit(points)]
    cuts = [_best_cut(points, fits[0])]
    threshold = min_saving * fits[0].volume
    while len(parts) < max_parts:
        best = max(range(len(parts)), key=lambda index: cuts[index][0])
        saving, left, right = cuts[best]
        if saving < threshold:
            break
        parts[best : best + 1] = [left, right]
        fits[best : best + 1] = [_fit(left), _fit(right)]
        cuts[best : best + 1] = [_best_cut(left, fits[best]), _best_cut(right, fits[best + 1])]
    return fits


def surface_points(vertices: Array, faces: NDArray[np.int64]) -> Array:
    """(N, 3) points on the triangles, about evenly spaced, the vertices included."""
    extent = vertices.max(axis=0) - vertices.min(axis=0)
    spacing = max(_SPACING * math.sqrt(float((extent * extent).sum())), 1e-6)
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    longest = np.sqrt(np.max([((p - q) ** 2).sum(axis=1) for p, q in ((a, b), (b, c), (c, a))], axis=0))
    steps = np.maximum(1, np.ceil(longest / spacing)).astype(np.int64)
    found = []
    for count in np.unique(steps).tolist():
        i, j = np.mgrid[0 : count + 1, 0 : count + 1]
        inside = i + j <= count
        u, v = (i[inside] / count)[None, :, None], (j[inside] / count)[None, :, None]
        chosen = steps == count
        pa, pb, pc = a[chosen][:, None], b[chosen][:, None], c[chosen][:, None]
        found.append((pa + (pb - pa) * u + (pc - pa) * v).reshape(-1, 3))
    points = np.concatenate(found)
    # One point in each cell is enough.
    _, first = np.unique(np.floor(points / spacing).astype(np.int64), axis=0, return_index=True)
    return np.asarray(points[np.sort(first)], dtype=np.float64)


def _fit(points: Array) -> Primitive:
    """The smallest box, cylinder along an axis or sphere around the points, in their frame."""
    low, high = points.min(axis=0), points.max(axis=0)
    middle = (low + high) / 2
    center = (float(middle[0]), float(middle[1]), float(middle[2]))
    sides = tuple(np.maximum(high - low, 1e-4).tolist())
    best = Primitive(kind="box", center=center, size=sides, volume=math.prod(sides))
    squares = (points - middle) ** 2
    for axis, (first, second) in enumerate(((1, 2), (0, 2), (0, 1))):
        radius = math.sqrt(float((squares[:, first] + squares[:, second]).max()))
        volume = math.pi * radius * radius * sides[axis]
        if volume < best.volume:
            size = (max(radius, 1e-4), sides[axis])
            best = Primitive(kind="cylinder", center=center, axis=axis, size=size, volume=volume)
    radius = math.sqrt(float(squares.sum(axis=1).max()))
    volume = 4 / 3 * math.pi * radius**3
    if volume < best.volume:
        best = Primitive(kind="sphere", center=center, size=(radius,), volume=volume)
    return best


def _best_cut(points: Array, fit: Primitive) -> tuple[float, Array, Array]:
    """The plane across an axis that saves most volume: what it saves, and the points on its two sides."""
    best: tuple[float, Array, Array] = (0.0, points, points)
    for axis in range(3):
        values = points[:, axis]
        low, high = float(values.min()), float(values.max())
        for step in range(1, 10):
            at = low + (high - low) * step / 10
            below = values <= at
            if below.sum() < 8 or (~below).sum() < 8:
                continue
            left, right = points[below], points[~below]
            saving = fit.volume - _fit(left).volume - _fit(right).volume
            if saving > best[0]:
                best = (saving, left, right)
    return best
