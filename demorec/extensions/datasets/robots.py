"""The arms of existing datasets: described in the sidecar, recognised by their joints' names, or named by the user."""

from __future__ import annotations

import functools
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from demorec.core.errors import ExportError, describe_error
from demorec.core.files import read_text_limited
from demorec.core.plain import from_json
from demorec.core.tables import ROBOTS
from demorec.datasets.lerobot.files import MAX_JSON_BYTES
from demorec.datasets.lerobot.robots import IN_MOTOR_UNITS, ROBOTS_DIR, DatasetRobot, motor_features
from demorec.episode.element_names import joint_of
from demorec.episode.features import STATE
from demorec.episode.info import Feature
from demorec.robots.motors import Motors
from demorec.robots.urdf import MAX_BYTES

_DIGEST = re.compile(r"[0-9a-f]{16}")
_IN_METRES = "gripper.width"
"""Name of a gripper's element in metres; LeRobot's own name is gripper.pos."""


def described(robot: DatasetRobot, feature: Feature, usual_name: str = "") -> Feature:
    """Return a feature with its joints, units and calibration, if they fit its elements.

    Args:
        robot: The arm.
        feature: Description in the dataset.
        usual_name: Name for the lookup if its own name is unknown; "" for none.
    """

    def fitting[T](found: Mapping[str, tuple[T, ...]]) -> tuple[T, ...]:
        values = found.get(feature.name, found.get(usual_name, ()))
        return values if len(values) == len(feature.names) else ()

    known: Any = {name: fitting(getattr(robot, name)) for name in ("joints", "units", "calibration")}
    return replace(feature, **known)


@functools.cache
def recognised_robot(names: tuple[str, ...]) -> DatasetRobot | None:
    """Return the row of `ROBOTS` with joints named like the elements of observation.state, such as "panda_joint1.pos".
    For datasets without a description of the robot; lengths are those of the model. LeRobot's own arms are left out
    unless the gripper's name implies metres: their joints have the same names in degrees and in percent.
    """
    from demorec.mcap.description import robot_description  # loads all code for reading recordings

    stems = [joint_of(name) for name in names]
    for row in ROBOTS.names():
        robot = ROBOTS.load(row)
        if robot.name in IN_MOTOR_UNITS and _IN_METRES not in names:
            continue
        if set(robot.arm_joints) <= set(stems):
            urdf = robot_description(robot.urdf, 1.0)
            # An opening in metres is not a jaw angle.
            known = zip(names, stems, strict=True)
            joints = tuple(stem if stem in robot.joint_names and name != _IN_METRES else "" for name, stem in known)
            return DatasetRobot.of(robot.name, urdf, [Feature(name=STATE, names=names, joints=joints)])
    return None


@functools.cache
def robot_of_motors(motors: Motors) -> DatasetRobot:
    """Return the arm with these servos."""
    from demorec.mcap.description import robot_description  # loads all code for reading recordings

    (model,) = (ROBOTS.load(name).urdf for name, arm in IN_MOTOR_UNITS.items() if arm.robot_type == motors.robot_type)
    return DatasetRobot.of(motors.robot_type, robot_description(model, 1.0), motor_features(motors))


def read_robot(root: Path, name: str) -> DatasetRobot:
    """Read the arm with this digest from a dataset. Raises ExportError if it is missing, has changed since it was
    written, or cannot be used.
    """
    path = root / ROBOTS_DIR / f"{name}.json"
    try:
        if not _DIGEST.fullmatch(name):
            raise ValueError(f"{name[:20]!r} is not a digest")
        stored = from_json(read_text_limited(path, MAX_JSON_BYTES), DatasetRobot)
        robot = replace(stored, urdf=read_text_limited(path.with_suffix(".urdf"), MAX_BYTES))
        if robot.digest != name:
            raise ValueError("it has changed since it was written")
        joints = {joint.name for joint in robot.model.joints}
        named = {joint for part in robot.joints.values() for joint in part if joint}
        if missing := named - joints:
            raise ValueError(f"its URDF lacks the joints {', '.join(sorted(missing))}")
    except (OSError, ValueError) as error:
        raise ExportError(f"The description of the robot cannot be read ({describe_error(error)}): {path}") from error
    return robot
