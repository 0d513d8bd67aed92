"""The joint tree of the robot, for the checks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from demorec.check.base import NotMeasuredError
from demorec.core.geometry import Array
from demorec.episode.element_names import joint_of
from demorec.extensions.doctor.evidence import Evidence
from demorec.robots.urdf import Urdf

UNKNOWN_ROBOT = "the robot's URDF is not known (name it: --urdf FILE)"


@dataclass(frozen=True, kw_only=True, eq=False)
class StateJoints:
    """Joints of the state's D elements.

    Attributes:
        urdf: The joint tree.
        joints: (D,) names in it, "" for an element that is not the position of a joint.
        lower, upper: (D,) limits, rad or m; infinite if unknown.
        is_sliding: (D,) whether the joint slides.
    """

    urdf: Urdf
    joints: tuple[str, ...]
    lower: Array
    upper: Array
    is_sliding: tuple[bool, ...]


def arm_of(evidence: Evidence) -> StateJoints:
    """Match the state's elements to the joints of the URDF: as recorded, by their names, else by their order."""
    if not evidence.urdf or not evidence.elements:
        raise NotMeasuredError(UNKNOWN_ROBOT)
    urdf = Urdf.parse(evidence.urdf)
    joints = evidence.arm_joints if any(evidence.arm_joints) else _named_joints(urdf, evidence)
    tree = {joint.name: joint for joint in urdf.joints}
    found = [tree.get(joint) for joint in joints]
    if not any(found):
        raise NotMeasuredError("no element of the state has the name of a joint of the URDF")
    return StateJoints(
        urdf=urdf,
        joints=joints,
        lower=np.array([-np.inf if joint is None else joint.lower for joint in found]),
        upper=np.array([np.inf if joint is None else joint.upper for joint in found]),
        is_sliding=tuple(joint is not None and joint.kind == "prismatic" for joint in found),
    )


def _named_joints(urdf: Urdf, evidence: Evidence) -> tuple[str, ...]:
    moving = [joint.name for joint in urdf.depth_first() if joint.kind != "fixed"]
    stems = [joint_of(name) for name in evidence.elements]
    if any(stem in moving for stem in stems):
        return tuple(stem if stem in moving else "" for stem in stems)
    is_ordered = len(moving) - len(stems) in (-1, 0)  # the last element is a gripper
    return (*moving, "")[: len(stems)] if is_ordered else ()
