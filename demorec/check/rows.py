"""Rigid transforms over all frames at once: forward kinematics, distances and angles of (T, ...) arrays.

Independent of `demorec.robots.kinematics` on purpose: that code made the recorded poses, this one judges them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from demorec.core.geometry import Array
from demorec.robots.urdf import Urdf, UrdfJoint


def matrices(poses: Array) -> Array:
    """(T, 4, 4) of poses (T, 7): position, quaternion xyzw (need not be of unit length)."""
    quat = poses[:, 3:] / np.maximum(np.linalg.norm(poses[:, 3:], axis=1, keepdims=True), 1e-12)
    x, y, z, w = quat.T
    out = np.zeros((len(poses), 4, 4))
    out[:, 0, 0], out[:, 0, 1], out[:, 0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)
    out[:, 1, 0], out[:, 1, 1], out[:, 1, 2] = 2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)
    out[:, 2, 0], out[:, 2, 1], out[:, 2, 2] = 2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)
    out[:, :3, 3] = poses[:, :3]
    out[:, 3, 3] = 1.0
    return out


class LinkMatrices:
    """Forward kinematics of some joint positions: each link's poses are computed once, when they are asked for.

    Args:
        urdf: The joint tree.
        joint_position: Joint name -> (T,) positions, rad or m; joints left out are at 0.
        count: T.
    """

    def __init__(self, urdf: Urdf, joint_position: Mapping[str, Array], count: int) -> None:
        self._joint_position = joint_position
        self._above = {joint.child: joint for joint in urdf.joints}
        self._known = {urdf.root: np.broadcast_to(np.eye(4), (count, 4, 4))}

    def __getitem__(self, link: str) -> Array:
        """(T, 4, 4) base_from_link; KeyError when there is no such link."""
        if link not in self._known:
            joint = self._above[link]
            self._known[link] = self[joint.parent] @ self._parent_from_child(joint)
        return self._known[link]

    def _parent_from_child(self, joint: UrdfJoint) -> Array:
        """(T, 4, 4), or (4, 4) where a joint does not move."""
        position = self._joint_position.get(joint.name)
        if position is None or joint.kind == "fixed":
            return joint.parent_from_joint.matrix()
        return _joint_matrices(joint, position)


def _joint_matrices(joint: UrdfJoint, position: Array) -> Array:
    """(T, 4, 4) parent_from_child of a moving joint at (T,) positions (rad, m); turns are by Rodrigues' formula."""
    at_zero, along = joint.parent_from_joint.matrix(), position[:, None, None]
    x, y, z = joint.axis
    if joint.kind == "prismatic":
        way = np.zeros((4, 4))
        way[:3, 3] = joint.axis
        return np.asarray(at_zero + along * (at_zero @ way))
    cross = np.array([[0, -z, y, 0], [z, 0, -x, 0], [-y, x, 0, 0], [0, 0, 0, 0]])
    turned = at_zero @ cross
    return np.asarray(at_zero + np.sin(along) * turned + (1 - np.cos(along)) * (turned @ cross))


def displacement(a: Array, b: Array, *, lever_m: float = 0.1) -> Array:
    """(T,) metres between two transforms (T, 4, 4): of the origins, plus what the rotation moves at a lever's end."""
    # |R - S| (Frobenius) = 2 sqrt(2) sin(angle / 2): exact for small angles, unlike the arc cosine of the trace.
    chord = np.sqrt(((a[:, :3, :3] - b[:, :3, :3]) ** 2).sum(axis=(1, 2)))
    angle = 2 * np.arcsin(np.minimum(chord / (2 * np.sqrt(2)), 1.0))
    return np.asarray(np.linalg.norm(a[:, :3, 3] - b[:, :3, 3], axis=1) + lever_m * angle)


def finest_lag(lags: Sequence[int], errors: Sequence[float]) -> float:
    """The lag of the least error: the best of whole lags, and a parabola through it and its neighbours."""
    best = int(np.argmin(errors))
    if best in (0, len(errors) - 1):
        return float(lags[best])
    low, middle, high = errors[best - 1 : best + 2]
    bend = low - 2 * middle + high
    return lags[best] + (0.5 * (low - high) / bend if bend > 0 else 0.0)
