"""The recorded EE pose against forward kinematics of the joints, of all frames at once.

Deliberately independent of `demorec.robots.kinematics`, which made the recorded poses.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from demorec.check.base import Fault, NotMeasuredError, check
from demorec.core.geometry import Array, rotation_rows
from demorec.episode.element_names import joint_of
from demorec.episode.features import EE_POSE
from demorec.extensions.doctor.evidence import DROP, LOOK_OR_DROP, Evidence
from demorec.robots.urdf import Urdf, UrdfJoint

KNOWN_ERROR_M = 0.05
"""Usual error of hands and drivers, metres: they sag, and joints and pose are read at different times."""
MIN_ORDER_ERROR_M = 0.002
MAX_ORDER_RATIO = 0.2
"""Maximum error with the scalar first, relative to that with the scalar last, at which it is first."""
MAX_SIZE_RATIO = 2.0
"""Maximum factor between a robot's size and its model's, in both directions."""
MIN_FRAMES = 30
MAX_FITTED_EPISODES = 20
MAX_FITTED_FRAMES = 60
MAX_FIT_STEPS = 100
"""Maximum number of evaluations of one fit: joints in another unit fit nowhere, and would take thousands."""
LEVER_M = 0.1
"""Lever, metres, that converts a rotation to a distance."""
_POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")


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
        raise NotMeasuredError("the robot's URDF is not known (name it: --urdf FILE)")
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


@check(
    family="numbers",
    needs="state, the robot's URDF",
    measures="positions beyond the joints' limits",
    unit="rad, m",
    why="The numbers are not those of this robot: another unit, order of joints, or zero.",
    do="compare units and zero positions with the URDF; name servos by --motor-units",
)
def joint_limits(evidence: Evidence) -> Iterator[Fault]:
    """Compare the state with the limits of the robot's URDF.

    The robot is that of the recording or the sidecar, the one named by --urdf or --motor-units, or a known one with
    joints named like the state's elements. Up to 0.1 rad or m beyond a limit is attributed to calibration.
    """
    arm = evidence.once(arm_of)
    known = np.flatnonzero(np.isfinite(arm.lower) | np.isfinite(arm.upper))
    if not len(known):
        raise NotMeasuredError("the URDF has no limits of the state's joints")
    found: list[Fault] = []
    for episode, state in evidence.need_state():
        beyond = np.maximum(np.maximum(arm.lower - state, state - arm.upper), 0.0)[:, known]
        frame, place = np.unravel_index(int(beyond.argmax()), beyond.shape)
        worst = float(beyond[frame, place])
        if worst > 0.1:
            frames = np.flatnonzero((beyond > 0.1).any(axis=1))
            unit = "m" if arm.is_sliding[known[place]] else "rad"
            fault = Fault(
                severity="broken" if worst > 0.5 else "look",
                episode=episode.number,
                frames=(int(frames[0]), int(frames[-1])),
                value=f"{worst:.2f} {unit}",
                message=f"{evidence.elements[known[place]]} is {worst:.2f} {unit} beyond its limit",
            )
            found.append(fault)
    is_exception = len(found) <= len(evidence.episodes) / 2
    yield from (replace(fault, do=LOOK_OR_DROP if is_exception else "") for fault in found)


@check(
    family="numbers",
    needs="state, EE pose, the robot's URDF",
    measures="poses that do not match the joints",
    unit="mm",
    why="Joints or pose are wrong: exchanged, in another unit, with another zero or order of the quaternion.",
    do="compare names, units and zero positions with the URDF",
)
def pose_mismatch(evidence: Evidence) -> Iterator[Fault]:
    """Compare the EE pose with forward kinematics of the joints, 0.1 m added for each rad of rotation.

    A fixed base, a fixed tool and the robot's size are fitted to each episode, since the pose's link is unknown; up to
    20 episodes are judged. A hand may be 5 cm off.
    """
    poses = _pose_columns(evidence)
    arm = evidence.once(arm_of)
    episodes = evidence.need_state(MIN_FRAMES)
    errors: dict[int, float] = {}
    others: list[float] = []
    for episode, state in episodes[:: max(1, len(episodes) // MAX_FITTED_EPISODES)]:
        pose = _pose(episode.columns, poses)
        frames = np.flatnonzero(np.isfinite(pose).all(axis=1))
        if len(frames) >= MIN_FRAMES and np.ptp(pose[frames], axis=0).any():
            joints = {name: column[frames] for name, column in zip(arm.joints, state.T, strict=True) if name}
            links = _link_poses(arm.urdf, joints, len(frames))
            errors[episode.number] = _fitted_error(links, pose[frames])
            if not others and errors[episode.number] > MIN_ORDER_ERROR_M:
                turned = pose[frames][:, [0, 1, 2, 4, 5, 6, 3]]
                others.append(_fitted_error(links, turned) / errors[episode.number])
    if others and others[0] < MAX_ORDER_RATIO:
        yield Fault(
            severity="broken",
            value="w first",
            message="the quaternion of the EE pose has its scalar first, not last as its names imply",
        )
        return
    bad = {number: error for number, error in errors.items() if error > KNOWN_ERROR_M}
    if len(bad) > len(errors) / 2:
        error = float(np.median(list(bad.values())))
        yield Fault(
            severity="broken",
            value=f"{1e3 * error:.0f} mm",
            message=f"the EE pose deviates from the joints by {1e3 * error:.0f} mm",
        )
        return
    for number, error in bad.items():
        yield Fault(
            severity="broken",
            episode=number,
            value=f"{1e3 * error:.0f} mm",
            message=f"its EE pose deviates from the joints by {1e3 * error:.0f} mm",
            do=DROP,
        )


def _pose_columns(evidence: Evidence) -> tuple[str, list[int]]:
    """Find the feature with the EE pose, and the indices of x, y, z, qx, qy, qz, qw in it."""
    for feature in (EE_POSE, *evidence.roles.state):
        names = evidence.roles.columns[feature].elements if feature in evidence.roles.columns else ()
        words = [name.rpartition(".")[2].rpartition("_")[2] for name in names[-7:]]
        if len(words) == 7 and set(words) == set(_POSE):
            return feature, [len(names) - 7 + words.index(word) for word in _POSE]
    raise NotMeasuredError("no column is known to be the pose of the hand")


def _pose(columns: Mapping[str, NDArray[Any]], place: tuple[str, list[int]]) -> Array:
    feature, order = place
    return np.asarray(columns[feature].astype(np.float64)[:, order])


def _fitted_error(links: Array, poses: Array) -> float:
    """Compute the error in metres, in nine of ten frames, after the best fit of a base, a tool and a size."""
    hands = matrices(poses)
    rows = np.unique(np.linspace(0, len(poses) - 1, min(MAX_FITTED_FRAMES, len(poses))).astype(int))
    return float(np.quantile(_displacement(_placed(_fit(links[rows], hands[rows]), links), hands), 0.9))


def _transform(numbers: Array) -> Array:
    """Build the (4, 4) matrix of a rotation vector and a position."""
    from scipy.spatial.transform import Rotation

    out = np.eye(4)
    out[:3, :3] = Rotation.from_rotvec(numbers[:3]).as_matrix()
    out[:3, 3] = numbers[3:]
    return out


def _placed(fit: Array, links: Array) -> Array:
    """Compute (N, 4, 4) poses of the hand from the links' (N, 4, 4): base, size, tool."""
    sized = links.copy()
    sized[:, :3, 3] *= MAX_SIZE_RATIO ** math.tanh(fit[12])
    return np.asarray(_transform(fit[:6]) @ sized @ _transform(fit[6:12]))


def _fit(links: Array, poses: Array) -> Array:
    """Fit (13,) base X, tool Y and size that bring X @ links @ Y nearest to the poses, all (N, 4, 4)."""
    from scipy.optimize import least_squares
    from scipy.spatial.transform import Rotation

    def residual(fit: Array) -> Array:
        error = _placed(fit, links) - poses
        return np.asarray((error[:, :3] * [LEVER_M, LEVER_M, LEVER_M, 1.0]).reshape(-1))

    best = None
    for yaw in np.arange(4) * (math.pi / 2):  # from a base with a very different yaw the fit may end elsewhere
        base = np.array([0.0, 0.0, yaw, 0.0, 0.0, 0.0])
        tool = np.linalg.inv(_transform(base) @ links[0]) @ poses[0]
        start = np.concatenate([base, Rotation.from_matrix(tool[:3, :3]).as_rotvec(), tool[:3, 3], [0.0]])
        found = least_squares(residual, start, max_nfev=MAX_FIT_STEPS)
        best = found if best is None or found.cost < best.cost else best
        if best.cost < 1e-3 * LEVER_M * len(links):
            break
    assert best is not None
    return np.asarray(best.x)


def matrices(poses: Array) -> Array:
    """Convert poses (T, 7), position and quaternion xyzw of any length, to (T, 4, 4)."""
    quat = poses[:, 3:] / np.maximum(np.linalg.norm(poses[:, 3:], axis=1, keepdims=True), 1e-12)
    out = np.zeros((len(poses), 4, 4))
    out[:, :3, :3] = np.moveaxis(np.array(rotation_rows(*quat.T)), -1, 0)
    out[:, :3, 3] = poses[:, :3]
    out[:, 3, 3] = 1.0
    return out


def _link_poses(urdf: Urdf, joints: Mapping[str, Array], count: int) -> Array:
    """Compute (T, 4, 4) base_from_link of the last moved link, from joint name -> (T,) positions, rad or m."""
    last = [joint.child for joint in urdf.depth_first() if joint.name in joints][-1]
    found = np.broadcast_to(np.eye(4), (count, 4, 4))
    for joint in urdf.path_to(last):
        position = None if joint.kind == "fixed" else joints.get(joint.name)
        found = found @ (joint.parent_from_joint.matrix() if position is None else _joint_matrices(joint, position))
    return found


def _joint_matrices(joint: UrdfJoint, position: Array) -> Array:
    """Compute (T, 4, 4) parent_from_child of a moving joint at (T,) positions (rad, m), by Rodrigues' formula."""
    at_zero, along = joint.parent_from_joint.matrix(), position[:, None, None]
    x, y, z = joint.axis
    if joint.kind == "prismatic":
        way = np.zeros((4, 4))
        way[:3, 3] = joint.axis
        return np.asarray(at_zero + along * (at_zero @ way))
    cross = np.array([[0, -z, y, 0], [z, 0, -x, 0], [-y, x, 0, 0], [0, 0, 0, 0]])
    turned = at_zero @ cross
    return np.asarray(at_zero + np.sin(along) * turned + (1 - np.cos(along)) * (turned @ cross))


def _displacement(a: Array, b: Array) -> Array:
    """Compute (T,) metres between two transforms (T, 4, 4): of the origins, plus the rotation's effect at `LEVER_M`."""
    # |R - S| (Frobenius) = 2 sqrt(2) sin(angle / 2): exact for small angles, unlike the arc cosine of the trace.
    chord = np.sqrt(((a[:, :3, :3] - b[:, :3, :3]) ** 2).sum(axis=(1, 2)))
    angle = 2 * np.arcsin(np.minimum(chord / (2 * np.sqrt(2)), 1.0))
    return np.asarray(np.linalg.norm(a[:, :3, 3] - b[:, :3, 3], axis=1) + LEVER_M * angle)
