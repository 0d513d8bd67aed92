"""Masses and inertias of a robot's links, read from its URDF and checked before a simulator invents missing ones.

PyBullet gives a link without `<inertial>` 1 kg, even a frame that only marks a point. In a URDF such a link is
massless, which is correct for a frame and for links fixed to the ground, and wrong for a part of the arm.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET

import numpy as np

from demorec.core.errors import ConfigError
from demorec.core.plain import listed
from demorec.robots.assets import asset_path
from demorec.robots.urdf import Urdf, parse_xml, read_numbers

MAX_MASS = 5_000.0
"""Maximum mass of a link, kg: the heaviest commercial arms weigh that in total (detects grams for kilograms)."""
MAX_GYRATION = 10.0
"""Maximum sqrt(inertia / mass), metres: more than an arm's reach (detects inertias in kg mm^2 or g mm^2)."""
_SHOWN = 5
_NOTHING = '<inertial><mass value="0"/><inertia ixx="0" ixy="0" ixz="0" iyy="0" iyz="0" izz="0"/></inertial>'
_AXES = ("ixx", "ixy", "ixz", "ixy", "iyy", "iyz", "ixz", "iyz", "izz")


def check_masses(model: str) -> None:
    """Raise ConfigError unless a robot's URDF, named as in `asset_path`, specifies the masses of its links."""
    try:
        require_masses(asset_path(model).read_text())
    except ValueError as error:
        raise ConfigError(f"The robot cannot be simulated, since {error}: {model}") from error


def require_masses(text: str) -> None:
    """Raise ValueError unless the text is a URDF in which each moving link has plausible mass and inertia."""
    urdf, links = Urdf.parse(text), {link.attrib["name"]: link for link in parse_xml(text).findall("link")}
    carrier = {urdf.root: urdf.root}
    """Link -> the link that it is rigidly attached to, which is the child of a moving joint or the root."""
    for joint in urdf.depth_first():
        carrier[joint.child] = carrier[joint.parent] if joint.kind == "fixed" else joint.child
    moving = {joint.child for joint in urdf.joints if joint.kind != "fixed"}
    masses: dict[str, float] = {}
    wrong: dict[str, str] = {}
    for name, link in sorted(links.items(), key=lambda item: item[0] not in moving):  # moving links carry the others
        is_carried = name not in moving and bool(masses.get(carrier[name]))
        try:
            masses[name] = _mass(link, must_be_whole=carrier[name] != urdf.root, may_be_point=is_carried)
        except ValueError as error:
            wrong[name] = str(error)
    carried = dict.fromkeys(carrier.values(), 0.0)
    for name, mass in masses.items():
        carried[carrier[name]] += mass
    for name, mass in carried.items():
        if not mass and name != urdf.root:
            wrong.setdefault(name, "moves, but has no mass")
    if wrong:
        listing = listed([f"{name!r} ({problem})" for name, problem in wrong.items()], _SHOWN, ", ")
        raise ValueError(
            f"its URDF lacks the masses of these links: {listing}; give each the mass and inertia of a body (only "
            "frames without shapes on fixed joints need none)"
        )


def for_simulator(text: str) -> str:
    """Convert a robot's URDF for PyBullet.

    Every link gets an `<inertial>`, massless if it had none. `<dynamics>` is removed from joints: PyBullet refuses
    some, and applies others wrongly (`demorec.sim.lossy_motors`).
    """
    robot = parse_xml(text)
    frames = [link for link in robot.findall("link") if link.find("inertial") is None]
    for link in frames:
        link.append(ET.fromstring(_NOTHING))
    lossy = [joint for joint in robot.findall("joint") if joint.find("dynamics") is not None]
    for joint in lossy:
        for dynamics in joint.findall("dynamics"):
            joint.remove(dynamics)
    return ET.tostring(robot, encoding="unicode") if frames or lossy else text


def _mass(link: ET.Element, *, must_be_whole: bool, may_be_point: bool) -> float:
    """Return the mass of one link, kg.

    Args:
        link: Link of the URDF.
        must_be_whole: Whether its mass and inertia matter, so that a shape needs them.
        may_be_point: Whether it may have mass without inertia, because it is fixed to a body that has both.

    Raises:
        ValueError: No body can have this mass and inertia.
    """
    inertial = link.find("inertial")
    if inertial is None:
        if must_be_whole and (link.find("visual") is not None or link.find("collision") is not None):
            raise ValueError("moves and has a shape, but no <inertial>")
        return 0.0
    parts = inertial.find("mass"), inertial.find("inertia")
    if parts[0] is None or parts[1] is None:
        raise ValueError("an <inertial> without mass or inertia")
    (mass,) = read_numbers(parts[0].get("value", ""), 1)
    inertia = np.array([read_numbers(parts[1].get(axis, ""), 1) for axis in _AXES]).reshape(3, 3)
    if not 0 <= mass <= MAX_MASS:
        raise ValueError(f"a mass of {mass:g} kg")
    least, *_, most = np.linalg.eigvalsh(inertia)
    if mass and must_be_whole and not (least > 0 or (may_be_point and least == 0)):
        raise ValueError(f"an inertia with a smallest principal value of {least:.3g} kg m^2")
    if most > MAX_GYRATION**2 * max(mass, 1.0) or least < -1e-9:
        raise ValueError(f"principal inertias of {least:.3g} to {most:.3g} kg m^2 for {mass:g} kg")
    return mass
