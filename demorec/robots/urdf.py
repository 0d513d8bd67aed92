"""The only reader of URDFs, without the simulator: the joint tree, and the shapes and masses of the links.

Kinematics, playback, the recorded description and images drawn without a simulator all read URDFs through this module.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Literal, NamedTuple, cast, get_args

import numpy as np

from demorec.core.geometry import Array, Pose
from demorec.episode.scene import Rgba

MAX_BYTES = 4 << 20
"""Maximum size of a URDF: the largest in pybullet_data has 32 kB."""
_MAX_JOINTS = 500
_MAX_SHAPES = 5000
_PRIMITIVES = ("box", "sphere", "cylinder")


def parse_xml(text: str) -> ET.Element:
    """Parse XML of unknown origin; ValueError if it is invalid, very large or defines entities.

    Entities can expand a small file without limit; no URDF needs a document type.
    """
    if len(text) > MAX_BYTES:
        raise ValueError(f"the URDF has {len(text):,} characters, allowed are {MAX_BYTES:,}")
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise ValueError("the URDF has a document type, which is not allowed")
    try:
        return ET.fromstring(text)
    except ET.ParseError as error:
        raise ValueError(f"the URDF is not valid XML ({error})") from error


def read_numbers(text: str, count: int) -> list[float]:
    """Read the first `count` finite numbers of a text, as PyBullet does; ValueError if there are fewer."""
    try:
        values = [float(word) for word in text.split()]
    except ValueError:
        values = []
    if len(values) < count or not all(map(math.isfinite, values)):
        wanted = "a finite number" if count == 1 else f"{count} finite numbers"
        raise ValueError(f"{text[:40]!r} of the URDF should be {wanted}")
    return values[:count]


@dataclass(frozen=True, kw_only=True)
class UrdfJoint:
    """One joint of a URDF.

    Attributes:
        name, parent, child: Joint, parent link, child link.
        kind: "revolute", "continuous", "prismatic" or "fixed".
        parent_from_joint: Pose of the joint frame (= child link frame at position 0).
        axis: Unit vector in the joint frame.
        lower, upper: Position limits, rad or m; infinite if the URDF has none.
    """

    name: str
    parent: str
    child: str
    kind: str
    parent_from_joint: Pose
    axis: tuple[float, float, float]
    lower: float
    upper: float


@dataclass(frozen=True, kw_only=True)
class Urdf:
    """The joint tree of a URDF, lengths multiplied by `scale`; ValueError if the joints are not a tree."""

    joints: tuple[UrdfJoint, ...]
    root: str

    def __post_init__(self) -> None:
        below: dict[str, list[UrdfJoint]] = {}
        for joint in self.joints:
            below.setdefault(joint.parent, []).append(joint)
        reached, waiting, strays = {self.root}, [self.root], []
        while waiting:
            for joint in below.pop(waiting.pop(), ()):
                if joint.child in reached:
                    strays.append(joint)
                reached.add(joint.child)
                waiting.append(joint.child)
        strays += [joint for joints in below.values() for joint in joints]
        if strays:
            names = ", ".join(joint.name for joint in strays)
            raise ValueError(f"the joints of a URDF must be one tree, but these do not belong to it: {names}")

    @classmethod
    def load(cls, path: Path, *, scale: float = 1.0) -> Urdf:
        """Parse a file, as `parse`."""
        return cls.parse(path.read_text(), scale=scale)

    @classmethod
    @lru_cache(maxsize=8)
    def parse(cls, text: str, *, scale: float = 1.0) -> Urdf:
        """Read the joints from a URDF's text; ValueError if it is not XML, or the joints are not a tree."""
        robot = parse_xml(text)
        elements = robot.findall("joint")
        if len(elements) > _MAX_JOINTS:
            raise ValueError(f"a URDF of {len(elements)} joints")
        try:
            joints = tuple(_joint(element, scale) for element in elements)
            links = [link.attrib["name"] for link in robot.findall("link")]
        except KeyError as error:
            raise ValueError(f"a joint or link of the URDF lacks its {error}") from error
        except AttributeError as error:
            raise ValueError("a joint of the URDF lacks its parent or its child") from error
        children = {joint.child for joint in joints}
        roots = [link for link in links if link not in children]
        if not links and "xacro" in text:
            raise ValueError("the file is a xacro file or an empty one; make a URDF by xacro FILE.xacro > FILE.urdf")
        if len(roots) != 1:
            raise ValueError(f"a URDF needs one root link, found {len(roots)}: {', '.join(roots[:5])}")
        return cls(joints=joints, root=roots[0])

    def link_poses(self, joint_position: Mapping[str, float]) -> dict[str, Pose]:
        """Compute link name -> base_from_link for the given joint positions (rad, m); missing joints are at 0."""
        poses = {self.root: Pose()}
        for joint in self.depth_first():
            moved = joint_motion(joint, joint_position.get(joint.name, 0.0))
            poses[joint.child] = poses[joint.parent] @ joint.parent_from_joint @ moved
        return poses

    def depth_first(self) -> tuple[UrdfJoint, ...]:
        """List every joint below the root, in the order in which PyBullet numbers their child links."""

        def below(link: str) -> Iterator[UrdfJoint]:
            for joint in self.joints:
                if joint.parent == link:
                    yield joint
                    yield from below(joint.child)

        return tuple(below(self.root))

    def path_to(self, link: str) -> tuple[UrdfJoint, ...]:
        """List the joints from the root to `link`; KeyError if the link does not exist."""
        by_child = {joint.child: joint for joint in self.joints}
        path: list[UrdfJoint] = []
        while link != self.root:
            path.append(by_child[link])
            link = by_child[link].parent
        return tuple(reversed(path))


def joint_motion(joint: UrdfJoint, position: float) -> Pose:
    """Compute the transform of a joint at `position` (rad or m), about or along its axis."""
    if joint.kind == "prismatic":
        return Pose(position=np.array(joint.axis) * position)
    if joint.kind == "fixed":
        return Pose()
    half = math.sin(position / 2)
    x, y, z = joint.axis
    return Pose(quat_xyzw=np.array([x * half, y * half, z * half, math.cos(position / 2)]))


def _joint(element: ET.Element, scale: float) -> UrdfJoint:
    kind = element.attrib["type"]
    given = element.find("axis")
    axis = np.array(read_numbers("1 0 0" if given is None else given.get("xyz", "1 0 0"), 3))
    length = math.sqrt(float((axis * axis).sum()))
    limit = element.find("limit")
    bounded = limit is not None and kind in ("revolute", "prismatic")
    unit = scale if kind == "prismatic" else 1.0
    return UrdfJoint(
        name=element.attrib["name"],
        parent=cast(ET.Element, element.find("parent")).attrib["link"],
        child=cast(ET.Element, element.find("child")).attrib["link"],
        kind=kind,
        parent_from_joint=_origin(element, scale),
        axis=(1.0, 0.0, 0.0) if length == 0.0 else tuple(float(v) for v in axis / length),  # type: ignore[arg-type]
        lower=unit * float(cast(ET.Element, limit).get("lower", 0)) if bounded else -math.inf,
        upper=unit * float(cast(ET.Element, limit).get("upper", 0)) if bounded else math.inf,
    )


class JointDynamics(NamedTuple):
    """Losses of a joint.

    Attributes:
        damping: Viscous, N m s/rad or N s/m.
        friction: Coulomb friction, N m or N.
    """

    damping: float = 0.0
    friction: float = 0.0


def read_dynamics(text: str) -> dict[str, JointDynamics]:
    """Read joint -> its <dynamics>, for joints that have one; ValueError if a value is below 0."""
    found = {}
    for joint in parse_xml(text).findall("joint"):
        element = joint.find("dynamics")
        if element is None:
            continue
        values = JointDynamics(*(read_numbers(element.get(name, "0"), 1)[0] for name in JointDynamics._fields))
        name = joint.attrib["name"]
        if min(values) < 0:
            raise ValueError(f"the damping or friction of {name!r} is {min(values):g}; set it to 0 or more")
        found[name] = values
    return found


def quat_from_rpy(rpy: Sequence[float]) -> Array:
    """Convert URDF's roll, pitch, yaw about fixed axes (rad) to a unit quaternion (x, y, z, w)."""
    (sr, sp, sy), (cr, cp, cy) = [math.sin(a / 2) for a in rpy], [math.cos(a / 2) for a in rpy]
    return np.array(
        [
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
            cr * cp * cy + sr * sp * sy,
        ]
    )


UrdfShapeKind = Literal["box", "sphere", "cylinder", "capsule", "mesh"]


@dataclass(frozen=True, kw_only=True)
class UrdfShape:
    """One <visual> or <collision>, lengths multiplied by the scale.

    Attributes:
        kind: Geometry; decides the meaning of `size`.
        size: box: (x, y, z) full extents, metres; sphere: (radius,); cylinder and capsule: (radius, length) along z;
            mesh: (x, y, z) scale factors of the file.
            file: mesh: name in the URDF (`demorec.robots.assets.mesh_path` finds it); otherwise "".
            link_from_shape: Pose in the link's frame.
            rgba: Colour of its material, 0..1; None if the material has no colour.
    """

    kind: UrdfShapeKind
    size: tuple[float, ...]
    file: str
    link_from_shape: Pose
    rgba: Rgba | None


@dataclass(frozen=True, kw_only=True)
class UrdfLink:
    """One link, and its shapes in the order of the file, without unknown geometries."""

    name: str
    visuals: tuple[UrdfShape, ...]
    collisions: tuple[UrdfShape, ...]


def read_links(text: str, *, scale: float = 1.0) -> tuple[UrdfLink, ...]:
    """Read the links of a URDF, in the order of the file, scaled uniformly.

    Raises:
        ValueError: The text is not acceptable XML (`parse_xml`), or a shape lacks a size or has one that is not finite.
    """
    robot = parse_xml(text)
    colors = {
        name: rgba for element in robot.iter("material") if (name := element.get("name")) and (rgba := _rgba(element))
    }

    def shapes(link: ET.Element, tag: str) -> tuple[UrdfShape, ...]:
        return tuple(
            _shape(element, geometry, scale, colors)
            for element in link.findall(tag)
            if (geometry := element.find("geometry/*")) is not None and geometry.tag in get_args(UrdfShapeKind)
        )

    try:
        return tuple(
            UrdfLink(name=link.attrib["name"], visuals=shapes(link, "visual"), collisions=shapes(link, "collision"))
            for link in robot.findall("link")
        )
    except KeyError as error:
        raise ValueError(f"a link or shape of the URDF lacks its {error}") from error


def mesh_names(text: str) -> tuple[str, ...]:
    """List the mesh files named by a URDF's shapes, sorted; ValueError if it is not XML.

    Other files named in it, such as Gazebo plug-ins, belong to other programs.
    """
    return tuple(sorted({mesh.attrib["filename"] for mesh in mesh_elements(parse_xml(text))}))


def mesh_elements(robot: ET.Element) -> list[ET.Element]:
    """List the <mesh> elements of the shapes of all links."""
    shapes = [*robot.iterfind("link/visual"), *robot.iterfind("link/collision")]
    return [mesh for shape in shapes for mesh in shape.iterfind("geometry/mesh") if mesh.get("filename")]


def _shape(element: ET.Element, geometry: ET.Element, scale: float, colors: dict[str, Rgba]) -> UrdfShape:
    match geometry.tag:
        case "box":
            size = read_numbers(geometry.attrib["size"], 3)
        case "mesh":
            size = read_numbers(geometry.get("scale", "1 1 1"), 3)
        case "sphere":
            size = read_numbers(geometry.attrib["radius"], 1)
        case _:
            size = read_numbers(f"{geometry.attrib['radius']} {geometry.attrib['length']}", 2)
    material = element.find("material")
    return UrdfShape(
        kind=cast(UrdfShapeKind, geometry.tag),
        size=tuple(value * scale for value in size),
        file=geometry.attrib["filename"] if geometry.tag == "mesh" else "",
        link_from_shape=_origin(element, scale),
        rgba=None if material is None else _rgba(material) or colors.get(material.get("name", "")),
    )


def _origin(element: ET.Element, scale: float) -> Pose:
    origin = element.find("origin")
    if origin is None:
        return Pose()
    return Pose(
        position=np.array(read_numbers(origin.get("xyz", "0 0 0"), 3)) * scale,
        quat_xyzw=quat_from_rpy(read_numbers(origin.get("rpy", "0 0 0"), 3)),
    )


def _rgba(material: ET.Element) -> Rgba | None:
    color = material.find("color")
    if color is None:
        return None
    r, g, b, a = read_numbers(color.attrib["rgba"], 4)
    return (r, g, b, a)


@lru_cache(maxsize=8)  # all recordings of a robot have the same text
def check_primitives(text: str) -> None:
    """Raise ValueError unless a URDF is valid and self-contained: only boxes, spheres and cylinders."""
    Urdf.parse(text)
    robot = parse_xml(text)
    shapes = robot.findall("link/visual/geometry/*")
    if len(shapes) > _MAX_SHAPES:
        raise ValueError(f"a URDF of {len(shapes)} shapes")
    for shape in shapes:
        if shape.tag not in _PRIMITIVES:
            raise ValueError(f"a shape of the URDF is a {shape.tag[:20]!r}, allowed are {', '.join(_PRIMITIVES)}")
    if any(value < 0 for link in read_links(text) for shape in link.visuals for value in shape.size):
        raise ValueError("the size of a shape of the URDF is negative")
    for color in robot.iter("color"):
        if not all(0 <= part <= 1 for part in read_numbers(color.get("rgba", ""), 4)):
            raise ValueError("a colour of the URDF is outside 0 to 1")
