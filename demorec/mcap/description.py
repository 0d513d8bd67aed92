"""Self-contained URDF text of the robot and of each body, with a bounding box for each mesh.

Rerun draws the robot of a bare recording from its URDF, but draws nothing if one mesh file is missing. So the recorded
description has only boxes, cylinders and spheres.
"""

from __future__ import annotations

import functools
import math
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from demorec.core.errors import SceneError, describe_error
from demorec.core.geometry import Array, Pose
from demorec.episode.scene import Body, Rgba
from demorec.robots.assets import asset_path, mesh_path, surface_file
from demorec.robots.shape_files import read_collada, read_obj
from demorec.robots.urdf import UrdfShape, parse_xml, read_links

_MIN_SIDE_M = 1e-4
"""Minimum side of the box around a flat mesh, metres."""
_WHITE: Rgba = (1.0, 1.0, 1.0, 1.0)
_KINDS: dict[str, Literal["box", "sphere", "cylinder"]] = {
    "box": "box",
    "sphere": "sphere",
    "cylinder": "cylinder",
    "capsule": "cylinder",
}
"""Shape -> primitive; the ends of a capsule are added as spheres."""


_Primitive = tuple[Literal["box", "sphere", "cylinder"], tuple[float, ...], Pose]
"""Kind, size and pose. A box has full extents, a cylinder along z radius and length, a sphere its radius."""


@functools.lru_cache(maxsize=8)
def robot_description(urdf: str, scale: float) -> str:
    """Replace every mesh of a robot by its bounding box, and remove masses and collision shapes.

    SceneError if the URDF or one of its meshes cannot be read.
    """
    path = asset_path(urdf)
    return self_contained(path.read_text(), path.parent, scale=scale)


def self_contained(text: str, folder: Path, *, scale: float = 1.0) -> str:
    """As `robot_description`, from the text of a URDF with meshes below `folder`; ValueError if it is not a URDF."""
    source = parse_xml(text)
    robot = ET.Element("robot", name=source.get("name", "robot"))
    for link in read_links(text, scale=scale):
        target = ET.SubElement(robot, "link", name=link.name)
        # Collision shapes are simpler from the start; their pose may differ from the visual's.
        is_fitted = bool(link.visuals and link.collisions) and all(shape.kind in _KINDS for shape in link.collisions)
        shapes = link.collisions if is_fitted or len(link.collisions) == len(link.visuals) else link.visuals
        for index, shape in enumerate(shapes):
            visual = link.visuals[min(index, len(link.visuals) - 1)]
            for primitive in _primitives(shape, folder):
                _add_visual(target, primitive, visual.rgba or _WHITE)
    for joint in source.findall("joint"):
        robot.append(_joint(joint, scale))
    return _text(robot)


def body_description(body: Body) -> str:
    """Make a URDF of one link, named like the body."""
    robot = ET.Element("robot", name=body.name)
    link = ET.SubElement(robot, "link", name=body.name)
    for primitive in _body_primitives(body):
        _add_visual(link, primitive, body.mean_color)
    return _text(robot)


def _body_primitives(body: Body) -> Iterator[_Primitive]:
    shape = body.shape
    if shape.kind == "mesh":
        yield _bounding_box(surface_file(shape), (shape.scale,) * 3, shape.body_from_mesh)
    elif shape.kind == "urdf":
        path = asset_path(shape.file)
        for link in read_links(path.read_text(), scale=shape.scale):
            for visual in link.visuals:
                yield from _primitives(visual, path.parent)
    else:
        yield _KINDS[shape.kind], shape.size, Pose()
        if shape.kind == "capsule":
            radius, length = shape.size
            for end in (-length / 2, length / 2):
                yield "sphere", (radius,), Pose(position=np.array((0.0, 0.0, end)))


def _primitives(shape: UrdfShape, folder: Path) -> Iterator[_Primitive]:
    """Convert a shape of a URDF to primitives in the link's frame."""
    if shape.kind == "mesh":
        yield _bounding_box(mesh_path(folder, shape.file), shape.size, shape.link_from_shape)
    elif shape.kind in _KINDS:
        yield _KINDS[shape.kind], shape.size, shape.link_from_shape


def _bounding_box(path: Path, scale: tuple[float, ...], frame: Pose) -> _Primitive:
    """Compute the box around a mesh, along the axes of its file."""
    try:
        low, high = _mesh_bounds(path)
    except (OSError, ValueError, LookupError, ET.ParseError) as error:
        raise SceneError(f"A mesh of the scene cannot be read ({describe_error(error)}): {path}") from error
    sides = np.maximum((high - low) * np.abs(scale), _MIN_SIDE_M)
    return "box", tuple(sides.tolist()), frame @ Pose(position=(low + high) / 2 * scale)


@functools.lru_cache(maxsize=256)
def _mesh_bounds(path: Path) -> tuple[Array, Array]:
    if path.suffix.lower() == ".obj":
        found = read_obj(path)
        if not len(found.faces):
            raise ValueError("no triangles")
        vertices = found.points
    elif path.suffix.lower() == ".dae":  # trimesh needs another package for it
        vertices = read_collada(path).points
    else:
        import trimesh  # slow import (1 s), not needed for the usual robot

        vertices = np.asarray(trimesh.load(path, force="mesh", process=False).vertices, dtype=np.float64)
    return vertices.min(axis=0), vertices.max(axis=0)


def _add_visual(link: ET.Element, primitive: _Primitive, rgba: Sequence[float]) -> None:
    kind, size, pose = primitive
    visual = ET.SubElement(link, "visual")
    ET.SubElement(visual, "origin", xyz=_numbers(pose.position.tolist()), rpy=_numbers(_rpy(pose)))
    geometry = ET.SubElement(visual, "geometry")
    if kind == "box":
        ET.SubElement(geometry, "box", size=_numbers(size))
    else:
        names = ("radius", "length")[: len(size)]
        ET.SubElement(geometry, kind, {name: _numbers((value,)) for name, value in zip(names, size, strict=True)})
    material = ET.SubElement(visual, "material", name="color_" + "_".join(f"{round(v * 255):02x}" for v in rgba))
    ET.SubElement(material, "color", rgba=_numbers(rgba))


def _rpy(pose: Pose) -> tuple[float, float, float]:
    """Compute roll, pitch, yaw about fixed axes (rad), as in URDF."""
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
            # All digits, since kinematics is computed from this; a single product is the same on every CPU.
            copy.set("xyz", " ".join(repr(float(v) * scale) for v in child.get("xyz", "0 0 0").split()))
        if child.tag == "limit" and scale != 1.0 and joint.get("type") == "prismatic":
            for bound in ("lower", "upper"):
                copy.set(bound, _numbers([float(child.get(bound, "0")) * scale]))
    return joint


def _numbers(values: Sequence[float]) -> str:
    # Tenths of a millimetre and of a milliradian: more digits would only differ between CPUs.
    return " ".join(f"{round(value, 4) + 0.0:g}" for value in values)


def _text(robot: ET.Element) -> str:
    ET.indent(robot, " ")
    return ET.tostring(robot, encoding="unicode") + "\n"
