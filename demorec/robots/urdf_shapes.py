"""What the links of a URDF look like, and where their masses are: the one reader of its shapes.

Playback, the recorded description and the pictures that are drawn without a simulator read URDFs through this module;
what they make of the shapes is their own.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import dataclass
from typing import Literal, cast, get_args

import numpy as np

from demorec.core.geometry import Pose
from demorec.episode.scene import Rgba
from demorec.robots.urdf import parse_xml, quat_from_rpy

UrdfShapeKind = Literal["box", "sphere", "cylinder", "capsule", "mesh", "plane"]


@dataclass(frozen=True, kw_only=True)
class UrdfShape:
    """One <visual> or <collision>, lengths multiplied by the scale.

    Attributes:
        kind: Which geometry; decides what `size` means.
        size: box: (x, y, z) full extents, metres; sphere: (radius,); cylinder and capsule: (radius, length) along z;
            mesh: (x, y, z) factors by which the file is scaled; plane: ().
        file: mesh: as the URDF names it (`demorec.robots.assets.mesh_path` finds it); otherwise "".
        link_from_shape: Pose in the link's frame.
        rgba: Colour of its material, 0..1; None without a material that has one.
    """

    kind: UrdfShapeKind
    size: tuple[float, ...]
    file: str
    link_from_shape: Pose
    rgba: Rgba | None


@dataclass(frozen=True, kw_only=True)
class UrdfLink:
    """One link.

    Attributes:
        name: Unique in the URDF.
        link_from_inertial: Pose of the centre of mass in the link's frame.
        visuals, collisions: Its shapes, in the order of the file; those of an unknown geometry are left out.
    """

    name: str
    link_from_inertial: Pose
    visuals: tuple[UrdfShape, ...]
    collisions: tuple[UrdfShape, ...]

    @property
    def seen(self) -> tuple[UrdfShape, ...]:
        """The shapes that PyBullet draws: the visual ones, of a link without any the collision shapes."""
        return self.visuals or self.collisions


def read_links(text: str, *, scale: float = 1.0) -> tuple[UrdfLink, ...]:
    """The links of a URDF, in the order of the file.

    Args:
        text: The URDF.
        scale: Uniform scale.

    Raises:
        ValueError: The text is no XML that may be read (`parse_xml`), or a shape lacks a size or has one that is no
            number.
    """
    robot = parse_xml(text)
    colors = {
        name: rgba for element in robot.iter("material") if (name := element.get("name")) and (rgba := _rgba(element))
    }
    try:
        return tuple(
            UrdfLink(
                name=link.attrib["name"],
                link_from_inertial=_origin(link.find("inertial"), scale),
                visuals=_shapes(link, "visual", scale, colors),
                collisions=_shapes(link, "collision", scale, colors),
            )
            for link in robot.findall("link")
        )
    except KeyError as error:
        raise ValueError(f"a link or shape of the URDF lacks its {error}") from error


def _shapes(link: ET.Element, tag: str, scale: float, colors: dict[str, Rgba]) -> tuple[UrdfShape, ...]:
    return tuple(
        _shape(element, geometry, scale, colors)
        for element in link.findall(tag)
        if (geometry := element.find("geometry/*")) is not None and geometry.tag in get_args(UrdfShapeKind)
    )


def _shape(element: ET.Element, geometry: ET.Element, scale: float, colors: dict[str, Rgba]) -> UrdfShape:
    match geometry.tag:
        case "box":
            size = _numbers(geometry.attrib["size"])
        case "mesh":
            size = _numbers(geometry.get("scale", "1 1 1"))
        case "sphere":
            size = _numbers(geometry.attrib["radius"])
        case "plane":
            size = ()
        case _:
            size = _numbers(f"{geometry.attrib['radius']} {geometry.attrib['length']}")
    material = element.find("material")
    return UrdfShape(
        kind=cast(UrdfShapeKind, geometry.tag),
        size=tuple(value * scale for value in size),
        file=geometry.attrib["filename"] if geometry.tag == "mesh" else "",
        link_from_shape=_origin(element, scale),
        rgba=None if material is None else _rgba(material) or colors.get(material.get("name", "")),
    )


def _origin(element: ET.Element | None, scale: float) -> Pose:
    """The <origin> of an element; where there is none, no displacement."""
    origin = None if element is None else element.find("origin")
    if origin is None:
        return Pose()
    return Pose(
        position=np.array(_numbers(origin.get("xyz", "0 0 0"))) * scale,
        quat_xyzw=quat_from_rpy(_numbers(origin.get("rpy", "0 0 0"))),
    )


def _rgba(material: ET.Element) -> Rgba | None:
    color = material.find("color")
    if color is None:
        return None
    r, g, b, a = _numbers(color.attrib["rgba"])
    return (r, g, b, a)


def _numbers(text: str) -> tuple[float, ...]:
    return tuple(float(word) for word in text.split())
