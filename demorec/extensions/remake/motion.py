"""The motion of a robot in an episode that demorec did not simulate: joints, state and action, for replaying it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from demorec.core.geometry import Array
from demorec.datasets.lerobot.robots import DatasetRobot, recognised_robot, robot_of_motors
from demorec.episode.element_names import joint_of
from demorec.episode.features import STATE
from demorec.episode.info import Feature
from demorec.episode.roles import NamedRoles, Roles, roles_of_features
from demorec.robots.urdf import Urdf

if TYPE_CHECKING:
    from demorec.check.dataset import CheckedDataset

GRIPPER = "gripper.width"
"""Element with the opening of a simulated gripper, metres."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RobotMotion:
    """Motion of a robot in one episode; elements are those of the state.

    Attributes:
        fps: Frames per second.
        names: Names of the D elements.
        state: (T, D) rad or m if the joint is known, otherwise as recorded.
        action: (T, D) in the same elements and units, NaN for elements without an action; None if no element has one.
        joints: (D,) joint names of the URDF, "" if unknown; empty if all are unknown.
    """

    fps: float
    names: tuple[str, ...]
    state: Array
    action: Array | None
    joints: tuple[str, ...]


def motion_of_features(
    features: Mapping[str, NDArray[Any]], described: Iterable[Feature], fps: float, urdf: str, *, named: NamedRoles
) -> RobotMotion | None:
    """Build the motion from named arrays (T, D); None without a state.

    Args:
        features: Name -> recorded values, (T, D).
        described: Names, units and joints of each feature.
        fps: Frames per second.
        urdf: Text of the robot's URDF; "" to take joints from the state's names.
        named: Features whose role the user names.
    """
    known = {feature.name: feature for feature in described}
    roles = roles_of_features(known.values(), named)
    if not roles.state or not len(features[roles.state[0]]):
        return None
    joints = _joints([known[part] for part in roles.state]) or _named_joints(roles.elements(roles.state), urdf)
    return _motion(fps, features, known, roles, joints)


def motions_of_dataset(dataset: CheckedDataset) -> Iterator[RobotMotion]:
    """The motion of every readable episode, by its own robot, the servos that the user names, or the state's names."""
    roles, info = dataset.roles, dataset.info
    if not roles.state:
        return
    described = {name: Feature(name=name, names=item.elements) for name, item in roles.columns.items() if item.elements}
    arms = _arms(dataset)
    unnamed = _named_joints(roles.elements(roles.state), "")
    for number, rows in dataset.numbers.items():
        if (robot := arms.get(number)) is None:
            yield _motion(info.fps, rows, described, roles, unnamed)
            continue
        known = {name: robot.record.described(feature, roles.usual_name(name)) for name, feature in described.items()}
        yield _motion(info.fps, rows, known, roles, _joints([known[part] for part in roles.state]))


def _arms(dataset: CheckedDataset) -> dict[int, DatasetRobot]:
    """Episode -> its arm, if the sidecar has it or the user has named its servos."""
    if dataset.motors is not None:
        return dict.fromkeys(range(len(dataset.listed)), robot_of_motors(dataset.motors))
    named = {row["episode_index"]: row["robot_digest"] for row in dataset.records if row["robot_digest"]}
    return {number: dataset.robot(digest) for number, digest in named.items()}


def _joints(parts: Sequence[Feature]) -> tuple[str, ...]:
    """The joints of joined features' elements, empty if none is known."""
    joints = tuple(joint for part in parts for joint in part.joints or ("",) * len(part.names))
    return joints if any(joints) else ()


def _named_joints(names: Sequence[str], urdf: str) -> tuple[str, ...]:
    """Joints named like the elements, or in the URDF's order (its text, "" for none)."""
    if not urdf:
        robot = recognised_robot(tuple(names))
        return () if robot is None else tuple(robot.record.joints[STATE])
    movable = [joint.name for joint in Urdf.parse(urdf).depth_first() if joint.kind != "fixed"]
    joints = tuple(stem if (stem := joint_of(name)) in movable else "" for name in names)
    if any(joints) or len(movable) - len(names) not in (-1, 0):
        return joints
    return (*movable, "")[: len(names)]  # the last one is a gripper


def _motion(
    fps: float,
    features: Mapping[str, NDArray[Any]],
    described: Mapping[str, Feature],
    roles: Roles,
    joints: tuple[str, ...],
) -> RobotMotion:
    return RobotMotion(
        fps=fps,
        names=roles.elements(roles.state),
        state=_joined(roles.state, features, described),
        action=_same_elements(roles.action, features, described, roles),
        joints=joints,
    )


def _joined(parts: Sequence[str], features: Mapping[str, NDArray[Any]], described: Mapping[str, Feature]) -> Array:
    """(T, D) of concatenated features, each in SI by its own units: a leader may record degrees."""
    return np.concatenate([described[part].in_si(features[part]) for part in parts], axis=1)


def _same_elements(
    parts: Sequence[str], features: Mapping[str, NDArray[Any]], described: Mapping[str, Feature], roles: Roles
) -> Array | None:
    """(T, D) of the features' elements that are also in the state, NaN for others; None if all are NaN."""
    columns = roles.in_state(parts) if parts else []
    if all(column is None for column in columns):
        return None
    values = _joined(parts, features, described)
    missing = np.full(len(values), np.nan)
    return np.stack([missing if column is None else values[:, column] for column in columns], axis=1)
