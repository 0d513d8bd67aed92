"""Poses, camera intrinsics and axis conventions, in NumPy alone.

Frame names cancel: `world_from_tcp = world_from_base @ base_from_tcp`. Quaternions are unit (x, y, z, w). Camera axes
are OpenCV's (x right, y down, z forward) everywhere; OpenGL's (y up, z backward) exist only inside the renderers. Sums
are written out because BLAS may round differently on another CPU.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def _vector(value: ArrayLike, length: int, name: str) -> Array:
    array = np.array(value, dtype=np.float64)
    if array.shape != (length,):
        raise ValueError(f"{name} has shape {array.shape}, expected ({length},)")
    array.setflags(write=False)
    return array


@dataclass(frozen=True, kw_only=True, eq=False)
class Pose:
    """A rigid transform `a_from_b`: maps points from frame b to frame a.

    Attributes:
        position: (3,) origin of b in a, metres.
        quat_xyzw: (4,) rotation, unit quaternion with the scalar last. Kept exactly as given, because recordings are
        compared bit by bit.
    """

    position: Array = field(default_factory=lambda: np.zeros(3))
    quat_xyzw: Array = field(default_factory=lambda: np.array([0.0, 0.0, 0.0, 1.0]))

    def __post_init__(self) -> None:
        object.__setattr__(self, "position", _vector(self.position, 3, "position"))
        object.__setattr__(self, "quat_xyzw", _vector(self.quat_xyzw, 4, "quat_xyzw"))

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Pose):
            return NotImplemented
        return bool(np.array_equal(self.position, other.position) and np.array_equal(self.quat_xyzw, other.quat_xyzw))

    def __hash__(self) -> int:
        return hash((self.position.tobytes(), self.quat_xyzw.tobytes()))

    def __reduce__(self) -> tuple[Any, ...]:
        return _unpickle_pose, (self.position.tolist(), self.quat_xyzw.tolist())

    @classmethod
    def from_yaw(cls, position: ArrayLike, yaw: float = 0.0) -> Pose:
        """Pose at `position`, rotated by `yaw` (rad) about z."""
        return cls(
            position=np.asarray(position, dtype=np.float64),
            quat_xyzw=np.array([0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)]),
        )

    @property
    def rotation(self) -> Array:
        """(3, 3) rotation matrix."""
        return rotation_from_quat(self.quat_xyzw)

    def matrix(self) -> Array:
        """(4, 4) homogeneous matrix."""
        m = np.eye(4)
        m[:3, :3] = self.rotation
        m[:3, 3] = self.position
        return m

    def vector(self) -> Array:
        """(7,) position, then quaternion xyzw."""
        return np.concatenate([self.position, self.quat_xyzw])

    def __matmul__(self, other: Pose) -> Pose:
        return Pose(
            position=self.position + rotate(self.quat_xyzw, other.position),
            quat_xyzw=quat_multiply(self.quat_xyzw, other.quat_xyzw),
        )

    def inverse(self) -> Pose:
        """The transform b_from_a."""
        x, y, z, w = self.quat_xyzw
        conjugate = np.array([-x, -y, -z, w])
        return Pose(position=-rotate(conjugate, self.position), quat_xyzw=conjugate)

    def apply(self, points: ArrayLike) -> Array:
        """Map points (..., 3) from b to a."""
        p = np.asarray(points, dtype=np.float64)
        r = self.rotation
        return np.asarray(
            p[..., 0:1] * r[:, 0] + p[..., 1:2] * r[:, 1] + p[..., 2:3] * r[:, 2] + self.position, dtype=np.float64
        )


def _unpickle_pose(position: list[float], quat_xyzw: list[float]) -> Pose:
    return Pose(position=np.array(position), quat_xyzw=np.array(quat_xyzw))


def rotation_from_quat(quat_xyzw: ArrayLike) -> Array:
    """(3, 3) rotation matrix of a unit quaternion (x, y, z, w)."""
    return np.array(rotation_rows(*(float(v) for v in np.asarray(quat_xyzw))))


def rotation_rows(x: Any, y: Any, z: Any, w: Any) -> list[list[Any]]:
    """Rows of the rotation matrix of a unit quaternion; components may be arrays."""
    return [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]


def quat_from_rotation(rotation: ArrayLike) -> Array:
    """Unit quaternion (x, y, z, w) of a (3, 3) rotation matrix, w >= 0 (Shepperd's method)."""
    m = np.asarray(rotation, dtype=np.float64)
    trace = m[0, 0] + m[1, 1] + m[2, 2]
    candidates = [m[0, 0], m[1, 1], m[2, 2], trace]
    largest = int(np.argmax(candidates))
    if largest == 3:
        quat = np.array([m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1], 1.0 + trace])
    else:
        i, j, k = largest, (largest + 1) % 3, (largest + 2) % 3
        quat = np.empty(4)
        quat[i] = 1.0 + m[i, i] - m[j, j] - m[k, k]
        quat[j] = m[j, i] + m[i, j]
        quat[k] = m[k, i] + m[i, k]
        quat[3] = m[k, j] - m[j, k]
    length = math.sqrt(sum(float(v) * float(v) for v in quat))
    quat = quat / length
    return np.asarray(-quat if quat[3] < 0 else quat, dtype=np.float64)


def quat_multiply(a_xyzw: ArrayLike, b_xyzw: ArrayLike) -> Array:
    """Hamilton product of two quaternions (x, y, z, w): rotation b, then rotation a."""
    a, b = ([float(v) for v in np.asarray(quat)] for quat in (a_xyzw, b_xyzw))
    return np.array(quat_product(a, b))


def quat_product(a: Iterable[Any], b: Iterable[Any]) -> list[Any]:
    """(x, y, z, w) of the Hamilton product of two quaternions; components may be arrays."""
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return [
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    ]


def signs_of_course(quaternions: Array) -> Array:
    """(T,) signs that bring each of (T, 4) closest to its predecessor; q and -q are the same rotation."""
    flips = np.where((quaternions[1:] * quaternions[:-1]).sum(axis=1) < 0, -1.0, 1.0)
    return np.concatenate(([1.0], np.cumprod(flips)))


def rotate(quat_xyzw: ArrayLike, vector: ArrayLike) -> Array:
    """Rotate one vector (3,) by a unit quaternion (x, y, z, w)."""
    r = rotation_from_quat(quat_xyzw)
    x, y, z = (float(v) for v in np.asarray(vector))
    return np.asarray(r[:, 0] * x + r[:, 1] * y + r[:, 2] * z, dtype=np.float64)


def angle_between(a: Pose, b: Pose) -> float:
    """Angle of the rotation from a to b, rad, 0..pi."""
    dot = abs(sum(float(x) * float(y) for x, y in zip(a.quat_xyzw, b.quat_xyzw, strict=True)))
    return 2.0 * math.acos(min(1.0, dot))


def wrap_angle(angle: float) -> float:
    """The same angle in [-pi, pi)."""
    return (angle + math.pi) % (2 * math.pi) - math.pi


def intrinsic_matrix(*, width: int, height: int, fov_y: float) -> Array:
    """(3, 3) matrix K of a pinhole camera with square pixels; `fov_y` in radians.

    Pixel (u, v) has its centre at u + 0.5, v + 0.5, so the principal point of a symmetric camera is (W/2, H/2).
    """
    focal = height / 2 / math.tan(fov_y / 2)
    return np.array([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])


def look_at(eye: ArrayLike, target: ArrayLike, up: ArrayLike = (0.0, 0.0, 1.0)) -> Pose:
    """Return `world_from_camera` for a camera at `eye` looking at `target`, in OpenCV axes (x right, y down, z
    forward).
    """
    eye_, target_, up_ = (np.asarray(v, dtype=np.float64) for v in (eye, target, up))
    forward = target_ - eye_
    forward = forward / math.sqrt(float((forward * forward).sum()))
    right = np.cross(forward, up_)
    norm = math.sqrt(float((right * right).sum()))
    if norm < 1e-9:
        raise ValueError(f"the viewing direction {forward.tolist()} is parallel to up {up_.tolist()}")
    right = right / norm
    down = np.cross(forward, right)
    return Pose(position=eye_, quat_xyzw=quat_from_rotation(np.stack([right, down, forward], axis=1)))
