"""Conversion of a program's observations and actions to the vectors of named features.

An observation is a vector, or a mapping: of numbers by element names (as from LeRobot's robots), which makes one
vector, or of vectors by feature names. An action has the same forms, but is always one vector.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from numbers import Real
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from demorec.core.errors import ConfigError, RecordingError, SceneError, describe_error
from demorec.core.files import read_text_limited
from demorec.core.registry import nearest_match
from demorec.episode.features import ACTION, STATE
from demorec.episode.info import OBSERVATION, Feature
from demorec.mcap.description import robot_description, self_contained
from demorec.robots.assets import remember_model
from demorec.robots.robot import RobotSpec
from demorec.robots.urdf import MAX_BYTES, Urdf, parse_xml

NamedVectors = Mapping[str, tuple[NDArray[Any], tuple[str, ...]]]
"""Feature -> its numbers, and the names of its elements if a mapping provided them."""

Vectors = ArrayLike | Mapping[str, ArrayLike]


def named_vectors(observation: Vectors, action: Vectors | None) -> NamedVectors:
    """Convert and copy the data; RecordingError unless it is vectors of numbers, or one mapping of numbers."""
    found: dict[str, tuple[NDArray[Any], tuple[str, ...]]] = {}
    if isinstance(observation, Mapping) and not _is_of_numbers(observation):
        for key, value in observation.items():
            name = key if str(key).startswith(OBSERVATION) else f"{OBSERVATION}{key}"
            found[name] = _vector(name, value), ()
    else:
        found[STATE] = _one_vector(STATE, observation)
    if action is not None:
        found[ACTION] = _one_vector(ACTION, action)
    return found


def _is_of_numbers(mapping: Mapping[str, Any]) -> bool:
    return bool(mapping) and all(_is_number(value) for value in mapping.values())


def _is_number(value: object) -> bool:
    return isinstance(value, Real | np.number | np.bool_) or (isinstance(value, np.ndarray) and value.ndim == 0)


def _one_vector(name: str, value: Vectors) -> tuple[NDArray[Any], tuple[str, ...]]:
    if isinstance(value, Mapping):
        if not _is_of_numbers(value):
            raise RecordingError(f"The {name} is a mapping without numbers: give a vector, or name -> number.")
        return _vector(name, np.array(list(value.values()), dtype=np.float64)), tuple(map(str, value))
    return _vector(name, value), ()


def _vector(name: str, value: ArrayLike) -> NDArray[Any]:
    try:
        vector = np.array(value)
    except ValueError:
        raise RecordingError(f"The feature {name!r} is not a vector: its parts have different lengths.") from None
    if vector.dtype.kind not in "fiub" or vector.ndim != 1:
        raise RecordingError(
            f"The feature {name!r} is {vector.dtype} of shape {vector.shape}: give a vector of numbers, of shape (D,)."
        )
    return vector if vector.dtype in (np.float32, np.float64) else vector.astype(np.float64)


def as_declared(feature: Feature, vector: NDArray[Any], names: tuple[str, ...]) -> NDArray[Any]:
    """Convert a vector to the feature's type and order of elements; RecordingError if some are missing or unknown."""
    if names and names != feature.names:
        if unknown := [name for name in names if name not in feature.names]:
            raise RecordingError(
                f"The feature {feature.name!r} has no element {unknown[0]!r}."
                f"{nearest_match(unknown[0], feature.names)} Its elements are: {', '.join(feature.names)}."
            )
        if missing := [name for name in feature.names if name not in names]:
            raise RecordingError(f"The feature {feature.name!r} lacks the element {missing[0]!r}.")
        vector = vector[[names.index(name) for name in feature.names]]
    return vector.astype(np.float64) if feature.dtype == "float64" else vector


def features_of(vectors: NamedVectors, robot: RobotFacts) -> tuple[Feature, ...]:
    """Describe undeclared features from the first frame."""
    found = []
    for name, (vector, given) in vectors.items():
        known = robot.joints if name in (STATE, ACTION) else ()
        names = given or _element_names(len(vector), known)
        # LeRobot's robots call the position of a joint "JOINT.pos".
        joints = tuple(joint if (joint := element.removesuffix(".pos")) in known else "" for element in names)
        dtype: Literal["float32", "float64"] = "float32" if vector.dtype == np.float32 else "float64"
        found.append(Feature(name=name, dtype=dtype, names=names, joints=joints if any(joints) else ()))
    return tuple(found)


def _element_names(count: int, joints: tuple[str, ...]) -> tuple[str, ...]:
    """Name elements by the robot's joints if the count matches, or is one more for a gripper; else by numbers."""
    if count == len(joints):
        return joints
    if joints and count == len(joints) + 1 and "gripper" not in joints:
        return (*joints, "gripper")
    return tuple(map(str, range(count)))


RobotLike = str | Path | RobotSpec | Sequence[str]


class RobotFacts(NamedTuple):
    """Known facts about the robot; from a file, the meshes of its URDF are boxes, drawn without other files."""

    name: str
    urdf: str = ""
    joints: tuple[str, ...] = ()  # all moving ones, in the order of the vectors


def robot_facts(robot: RobotLike) -> RobotFacts:
    """Collect the facts about a robot given by name, URDF or joints; ConfigError if these are invalid."""
    if isinstance(robot, RobotSpec):
        return RobotFacts(robot.name, robot_description(robot.urdf, 1.0), robot.joint_names)
    if isinstance(robot, Path) or (isinstance(robot, str) and robot.endswith(".urdf")):
        path = Path(robot)
        try:
            return _described(read_text_limited(path, MAX_BYTES), path)
        except (OSError, UnicodeDecodeError) as error:
            raise ConfigError(f"The robot's URDF cannot be read ({describe_error(error)}): {path}") from error
    if isinstance(robot, str):
        if robot.lstrip().startswith("<"):
            return _described(robot, None)
        if not robot.strip():
            raise ConfigError("The robot's name is empty: give a name, a URDF, or the names of its joints.")
        return RobotFacts(robot)
    joints = tuple(robot)
    if not joints or not all(isinstance(joint, str) and joint for joint in joints):
        raise ConfigError(f"The robot is {joints!r}: give a name, a URDF, or the names of its joints.")
    return RobotFacts("robot", joints=joints)


def _described(text: str, path: Path | None) -> RobotFacts:
    where = "" if path is None else f": {path}"
    try:
        urdf = Urdf.parse(text)
        name = parse_xml(text).get("name") or "robot"
        if path is not None:
            text = self_contained(text, path.parent)
            remember_model(text, path)
    except (ValueError, SceneError) as error:
        raise ConfigError(f"The robot's URDF cannot be used ({describe_error(error)}){where}") from error
    moving = tuple(joint.name for joint in urdf.joints if joint.kind != "fixed")
    return RobotFacts(name, text, moving)
