"""What a person may name as the robot: a name, a URDF as a file or as text, an arm of demorec's, or joint names."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from demorec.core.errors import ConfigError, SceneError, in_words
from demorec.core.files import read_text_limited
from demorec.mcap.description import robot_description, self_contained
from demorec.robots.robot import RobotSpec
from demorec.robots.urdf import MAX_BYTES, Urdf, parse_xml

RobotLike = str | Path | RobotSpec | Sequence[str]


@dataclass(frozen=True, kw_only=True)
class RobotFacts:
    """What is known of the robot.

    Attributes:
        name: Of it.
        urdf: Its description as text, "" when unknown; that of a file with every mesh replaced by boxes and cylinders,
            so that it can be drawn without any other file.
        joints: Names of all that move, in the order in which vectors have them, where that is known.
    """

    name: str
    urdf: str = ""
    joints: tuple[str, ...] = ()


def robot_facts(robot: RobotLike) -> RobotFacts:
    """What can be known of a robot that is named so.

    Raises:
        ConfigError: The URDF cannot be read, or is none; or the joint names are no names.
    """
    if isinstance(robot, RobotSpec):
        joints = robot.joint_names
        urdf = robot_description(robot.urdf, 1.0)
        return RobotFacts(name=robot.name, urdf=urdf, joints=joints)
    if isinstance(robot, Path) or (isinstance(robot, str) and robot.endswith(".urdf")):
        path = Path(robot)
        try:
            return _described(read_text_limited(path, MAX_BYTES), path)
        except (OSError, UnicodeDecodeError) as error:
            raise ConfigError(f"The robot's URDF cannot be read ({in_words(error)}): {path}") from error
    if isinstance(robot, str):
        if robot.lstrip().startswith("<"):
            return _described(robot, None)
        if not robot.strip():
            raise ConfigError("The robot's name is empty: give a name, a URDF, or the names of its joints.")
        return RobotFacts(name=robot)
    joints = tuple(robot)
    if not joints or not all(isinstance(joint, str) and joint for joint in joints):
        raise ConfigError(f"The robot is {joints!r}: give a name, a URDF, or the names of its joints.")
    return RobotFacts(name="robot", joints=joints)


def _described(text: str, path: Path | None) -> RobotFacts:
    where = "" if path is None else f": {path}"
    try:
        urdf = Urdf.parse(text)
        name = parse_xml(text).get("name") or "robot"
        if path is not None:
            text = self_contained(text, path.parent)
    except (ValueError, SceneError) as error:
        raise ConfigError(f"The robot's URDF cannot be used ({in_words(error)}){where}") from error
    moving = tuple(joint.name for joint in urdf.joints if joint.kind != "fixed")
    return RobotFacts(name=name, urdf=text, joints=moving)
