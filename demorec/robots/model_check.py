"""Check of a robot's spec and URDF, from both texts before a simulator is started or invents missing masses.

PyBullet gives a link without `<inertial>` 1 kg, even a frame that only marks a point. In a URDF such a link is
massless, which is correct for a frame and for links fixed to the ground, and wrong for a part of the arm.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterable, Iterator, Mapping

import numpy as np

from demorec.core.errors import ConfigError, SceneError
from demorec.core.plain import listed
from demorec.core.registry import nearest_match
from demorec.robots.assets import asset_path
from demorec.robots.robot import JawGripper, RobotSpec
from demorec.robots.urdf import JointDynamics, Urdf, UrdfJoint, parse_xml, read_dynamics, read_numbers

LIMIT_TOLERANCE = 1e-4
"""Maximum excess of a spec's position limit over the URDF's, rad or m: both are rounded."""
_MAX_NAMES = 30
_LINKAGES = 'docs/robots.md, "Grippers with linkages", describes the remedy'


def checked_urdf(spec: RobotSpec, *, scale: float = 1.0) -> Urdf:
    """Read a robot's URDF, scaled uniformly, and check that the spec, with lengths scaled already, fits it.

    Raises:
        SceneError: The URDF does not exist, cannot be read, or describes a robot that cannot be simulated; the message
            states the first reason and the fix.
    """
    path = asset_path(spec.urdf)
    try:
        text = path.read_text()
        urdf, dynamics = Urdf.parse(text, scale=scale), read_dynamics(text)
    except (OSError, ValueError) as error:
        raise SceneError(f"The URDF of the robot {spec.name!r} cannot be used, since {error}: {spec.urdf}") from error
    for problem in spec_problems(spec, urdf, dynamics):
        raise SceneError(f"The robot {spec.name!r} does not fit its URDF: {problem}: {spec.urdf}")
    return urdf


def spec_problems(spec: RobotSpec, urdf: Urdf, dynamics: Mapping[str, JointDynamics]) -> Iterator[str]:
    """Yield problems of a spec with their fixes; each assumes that the previous ones are solved."""
    yield from _unknown_names(spec, urdf)
    yield from _wrong_counts(spec)
    by_name = {joint.name: joint for joint in urdf.joints}
    yield from _wrong_chain(spec, urdf)
    yield from _gripper_joints(spec, [by_name[name] for name in spec.gripper.joints])
    yield from _arm_limits(spec, [by_name[name] for name in spec.arm_joints])
    yield from _stuck_joints(spec, dynamics)


def _unknown_names(spec: RobotSpec, urdf: Urdf) -> Iterator[str]:
    links = [urdf.root, *(joint.child for joint in urdf.joints)]
    if spec.base_link != urdf.root:
        yield f"base_link is {spec.base_link!r}, but the URDF's root is {urdf.root!r}; name that one"
    named = [("tcp_link", spec.tcp_link), ("hand_link", spec.hand_link)]
    named += [("finger_links", link) for link in spec.gripper.finger_links]
    for field, name in named:
        if name not in links:
            yield f"{field} names the link {name!r}, which the URDF lacks.{_choices('links', name, links)}"
    joints = [joint.name for joint in urdf.joints if joint.kind != "fixed"]
    named = [("arm_joints", name) for name in spec.arm_joints] + [("joints", name) for name in spec.gripper.joints]
    for field, name in named:
        if name not in joints:
            of = "the gripper's " if field == "joints" else ""
            lacking = f"{of}{field} names {name!r}, which is not a moving joint of the URDF"
            yield f"{lacking}.{_choices('moving joints', name, joints)}"


def _choices(what: str, name: str, names: Iterable[str]) -> str:
    names = sorted(names)
    return f"{nearest_match(name, names)} Its {what} are {listed(names, _MAX_NAMES, ', ')}"


def _wrong_counts(spec: RobotSpec) -> Iterator[str]:
    gripper, wanted = spec.gripper, 1 + len(spec.gripper.gear_ratios)
    if len(gripper.joints) != wanted:
        kind = type(gripper).__name__
        yield f"the gripper has {len(gripper.joints)} joints, a {kind} has {wanted}; {_LINKAGES}"
    if len(gripper.finger_links) != 2:
        yield f"finger_links names {len(gripper.finger_links)} links; name the two that touch an object"


def _wrong_chain(spec: RobotSpec, urdf: Urdf) -> Iterator[str]:
    """Check the joints in the chain to the TCP; then those to the hand and to the fingers."""
    chain = [joint.name for joint in urdf.path_to(spec.tcp_link) if joint.kind != "fixed"]
    if chain != list(spec.arm_joints):
        yield (
            f"the joints that move tcp_link {spec.tcp_link!r} are {', '.join(chain) or 'none'}, but arm_joints is "
            f"{', '.join(spec.arm_joints)}; name just these, in this order, or fix the others in the URDF"
        )
    if not urdf.path_to(spec.hand_link):
        yield f"hand_link {spec.hand_link!r} is the root; name the link that carries the fingers"


def _arm_limits(spec: RobotSpec, joints: list[UrdfJoint]) -> Iterator[str]:
    rows = zip(joints, spec.position_lower, spec.position_upper, spec.home_q, strict=True)
    for joint, low, high, home in rows:
        if joint.kind not in ("revolute", "continuous"):
            yield f"the arm joint {joint.name!r} is {joint.kind}; only revolute joints can be in arm_joints"
        elif not joint.lower - LIMIT_TOLERANCE <= low < high <= joint.upper + LIMIT_TOLERANCE:
            yield (
                f"the limits of {joint.name} are {low:g} to {high:g} rad; give two that rise, within the URDF's "
                f"{joint.lower:g} to {joint.upper:g}"
            )
        elif not low <= home <= high:
            yield f"home_q of {joint.name} is {home:g} rad; choose one within its limits, {low:g} to {high:g}"


def _gripper_joints(spec: RobotSpec, joints: list[UrdfJoint]) -> Iterator[str]:
    gripper = spec.gripper
    is_jaw = isinstance(gripper, JawGripper)
    for joint in joints:
        if (joint.kind == "prismatic") == is_jaw:
            needs = "one joint that turns" if is_jaw else "two prismatic joints"
            found = f"the gripper's joint {joint.name!r} is {joint.kind}"
            yield f"{found}, a {type(gripper).__name__} has {needs}; {_LINKAGES}"
    if isinstance(gripper, JawGripper):
        needed = [position for position, _ in gripper.opening]
    else:
        needed = [0.0, float(gripper.joint_position(gripper.max_width)[0])]
    low, high = min(needed), max(needed)
    for joint in joints:
        if low < joint.lower - LIMIT_TOLERANCE or high > joint.upper + LIMIT_TOLERANCE:
            fix = "shorten the table" if is_jaw else "set max_width to twice its stroke, and turn an axis that closes"
            yield (
                f"the opening of the gripper moves {joint.name} from {low:g} to {high:g}, but the URDF allows "
                f"{joint.lower:g} to {joint.upper:g}; {fix}"
            )


def _stuck_joints(spec: RobotSpec, dynamics: Mapping[str, JointDynamics]) -> Iterator[str]:
    forces = [spec.gripper.force] * len(spec.gripper.joints)
    for name, limit in zip(spec.joint_names, (*spec.torque_limit, *forces), strict=True):
        friction = dynamics.get(name, JointDynamics()).friction
        if friction >= limit:
            field = "torque_limit" if name in spec.arm_joints else "the gripper's force"
            yield f"the friction of {name} is {friction:g}, more than {field}, {limit:g}, leaves; correct one of them"


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
    """Return the mass of one link, kg; ValueError if no body can have its mass and inertia.

    A shape needs both if it `must_be_whole`; a link that `may_be_point` is fixed to a body that has both.
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
