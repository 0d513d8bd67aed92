"""Where PyBullet says that a body's links are, to the bit and without PyBullet.

Recorded images and camera poses were made from what PyBullet tells. To draw them again from the recording alone, its
steps are followed in their order: forward kinematics from one centre of mass to the next with quaternions in float64
(Featherstone's articulated bodies), then the frames of the links through matrices in float32, which is the precision
of PyBullet's interface. `tests/contract/test_recorded_world.py` compares every bit with PyBullet's.

All arrays may have leading axes, such as the frames of an episode. Sums are written out and sines are those of the C
library, as PyBullet's are: NumPy's may differ in the last bit.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from demorec.core.geometry import Array, Pose
from demorec.robots.urdf import Urdf, UrdfJoint, read_links

Floats = NDArray[np.floating[Any]]
"""float64 or float32: every function below keeps the precision that it is given."""
Transform = tuple[Floats, Floats]
"""Rotation (..., 3, 3) and origin (..., 3)."""

MAX_NORMALIZATIONS = 10
"""Two are usual; a world settles for more steps than this before its first frame."""


class _Link:
    """A link below the base, and how it hangs on its parent.

    Attributes:
        joint: Above it.
        parent: Number of the link that carries it; 0 is the base.
        parent_from_pivot: (3,) from the parent's centre of mass to the joint, in the parent's inertial frame.
        pivot_from_centre: (3,) from the joint to this link's centre of mass, in this link's inertial frame.
        rest: (4,) rotation from the parent's to this link's inertial frame at joint position 0.
        axis: (3,) of the joint, in this link's inertial frame.
        link_from_inertial: Its centre of mass.
    """

    def __init__(self, joint: UrdfJoint, parent: int, parent_inertial: Transform, inertial: Transform) -> None:
        parent_from_joint = _compose(_invert(parent_inertial), _of_origin(joint.parent_from_joint))
        inertial_from_link = _invert(inertial)
        turn = _quaternion(inertial_from_link[0])
        self.joint, self.parent, self.link_from_inertial = joint, parent, inertial
        self.parent_from_pivot = parent_from_joint[1]
        self.pivot_from_centre = -inertial_from_link[1]
        self.rest = _multiply(turn, _quaternion(_invert(parent_from_joint)[0]))
        self.axis = _rotate(turn, np.array(joint.axis))


class BulletBody:
    """A URDF as PyBullet loads it.

    Args:
        text: The URDF.
        scale: Uniform scale.

    Attributes:
        link_names: The base, then the links in PyBullet's order: link number n is `link_names[n + 1]`.
        base_from_inertial: Pose of the base's centre of mass, whose pose PyBullet tells as that of the body.

    Raises:
        ValueError: The text is no URDF.
    """

    def __init__(self, text: str, *, scale: float = 1.0) -> None:
        urdf = Urdf.parse(text, scale=scale)
        inertial = {link.name: _of_origin(link.link_from_inertial) for link in read_links(text, scale=scale)}
        joints = urdf.depth_first()
        self.link_names = (urdf.root, *(joint.child for joint in joints))
        self._base_from_inertial = inertial[urdf.root]
        self.base_from_inertial = _pose(self._base_from_inertial)
        self._links = tuple(
            _Link(joint, self.link_names.index(joint.parent), inertial[joint.parent], inertial[joint.child])
            for joint in joints
        )

    def poses(self, world_from_base: Array, joint_position: Mapping[str, Array]) -> Array:
        """Poses of the base's centre of mass and of the links' frames in the world.

        Args:
            world_from_base: (T, 7) or (1, 7) where the body is: position (metres), quaternion xyzw.
            joint_position: Joint -> (T,) positions, rad or m; joints left out are at 0.

        Returns:
            (T, n, 7), one row for each of `link_names`: position, quaternion xyzw.
        """
        count = max(len(world_from_base), *(len(positions) for positions in joint_position.values()), 1)
        start = (_matrix(world_from_base[:, 3:]), world_from_base[:, :3])
        rotation, position = _compose(start, self._base_from_inertial)
        standing = _settled(_quaternion(rotation))
        rotations = [_conjugate(standing)]  # from the world to each inertial frame
        positions = [position]
        rows = [_vector(_matrix(standing), position)]
        for link in self._links:
            turned, offset = _move(link, joint_position.get(link.joint.name, np.zeros(1)))
            rotations.append(_multiply(turned, rotations[link.parent]))
            positions.append(positions[link.parent] + _rotate(_conjugate(rotations[-1]), offset))
            rows.append(_link_frame(_conjugate(rotations[-1]), positions[-1], link.link_from_inertial))
        return np.stack([np.broadcast_to(row, (count, 7)) for row in rows], axis=1)


def as_told(pose: Pose) -> Pose:
    """A pose that PyBullet was given, as it tells it: its quaternion has been a matrix in between."""
    return _pose((_matrix(pose.quat_xyzw), pose.position))


def standing_as_told(pose: Pose) -> Pose:
    """The same for the pose of a body that physics leaves where it was put."""
    return _pose((_matrix(_settled(as_told(pose).quat_xyzw)), pose.position))


def origin_as_told(pose: Pose) -> Pose:
    """The same for the <origin> of a URDF."""
    return _pose(_of_origin(pose))


def _of_origin(pose: Pose) -> Transform:
    return _matrix(_normalized(pose.quat_xyzw)), pose.position


def _move(link: _Link, position: Array) -> tuple[Floats, Floats]:
    """Rotation (T, 4) from the parent's inertial frame to the link's, and (T, 3) offset between them in the latter."""
    if link.joint.kind in ("revolute", "continuous"):
        x, y, z = link.axis
        half = [-value * 0.5 for value in position.tolist()]
        sine = np.array([math.sin(value) for value in half]) / math.sqrt(x * x + y * y + z * z)
        cosine = np.array([math.cos(value) for value in half])
        turned = _multiply(np.stack([x * sine, y * sine, z * sine, cosine], axis=-1), link.rest)
        return turned, link.pivot_from_centre + _rotate(turned, link.parent_from_pivot)
    offset = link.pivot_from_centre + _rotate(link.rest, link.parent_from_pivot)
    if link.joint.kind == "prismatic":
        offset = offset + position[:, None] * link.axis
    return link.rest, offset


def _link_frame(rotation: Floats, position: Floats, link_from_inertial: Transform) -> Array:
    """(..., 7) pose of a link's frame, from that of its centre of mass, as PyBullet's interface works it out."""
    quat = _quaternion(_matrix(rotation)).astype(np.float32)
    inertial = _quaternion(link_from_inertial[0]).astype(np.float32)
    world_from_inertial = (_matrix(quat), position.astype(np.float32))
    inertial_from_link = _invert((_matrix(inertial), link_from_inertial[1].astype(np.float32)))
    return _vector(*_compose(world_from_inertial, inertial_from_link))


def _vector(rotation: Floats, position: Floats) -> Array:
    quat = _quaternion(rotation)
    position = np.broadcast_to(position, (*quat.shape[:-1], 3))
    return np.asarray(np.concatenate([position, quat], axis=-1), dtype=np.float64)


def _pose(value: Transform) -> Pose:
    rotation, position = value
    return Pose(position=position.astype(np.float64), quat_xyzw=_quaternion(rotation).astype(np.float64))


def _settled(quat: Floats) -> Floats:
    """Quaternions (..., 4) of bases after some steps of physics: each normalises them, whether they move or not."""
    for _ in range(MAX_NORMALIZATIONS):
        before, quat = quat, _normalized(quat)
        if np.array_equal(before, quat):
            break
    return quat


def _normalized(quat: Floats) -> Floats:
    x, y, z, w = np.moveaxis(quat, -1, 0)
    return np.asarray(quat * (1.0 / np.sqrt(x * x + y * y + z * z + w * w))[..., None])


def _conjugate(quat: Floats) -> Floats:
    return quat * np.array([-1, -1, -1, 1], dtype=quat.dtype)


def _multiply(a: Floats, b: Floats) -> Floats:
    """Hamilton product of quaternions (..., 4)."""
    ax, ay, az, aw = np.moveaxis(a, -1, 0)
    bx, by, bz, bw = np.moveaxis(b, -1, 0)
    return np.stack(
        [
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by + ay * bw + az * bx - ax * bz,
            aw * bz + az * bw + ax * by - ay * bx,
            aw * bw - ax * bx - ay * by - az * bz,
        ],
        axis=-1,
    )


def _rotate(quat: Floats, vector: Floats) -> Floats:
    """Vectors (..., 3) turned by quaternions (..., 4)."""
    x, y, z, w = np.moveaxis(quat, -1, 0)
    a, b, c = np.moveaxis(vector, -1, 0)
    turned = np.stack(
        [w * a + y * c - z * b, w * b + z * a - x * c, w * c + x * b - y * a, -x * a - y * b - z * c], axis=-1
    )
    return _multiply(turned, _conjugate(quat))[..., :3]


def _matrix(quat: Floats) -> Floats:
    """Rotations (..., 3, 3) of quaternions (..., 4), whatever their length."""
    x, y, z, w = np.moveaxis(quat, -1, 0)
    scale = 2.0 / (x * x + y * y + z * z + w * w)
    xs, ys, zs = x * scale, y * scale, z * scale
    wx, wy, wz, xx, xy, xz = w * xs, w * ys, w * zs, x * xs, x * ys, x * zs
    yy, yz, zz = y * ys, y * zs, z * zs
    rows = [
        [1.0 - (yy + zz), xy - wz, xz + wy],
        [xy + wz, 1.0 - (xx + zz), yz - wx],
        [xz - wy, yz + wx, 1.0 - (xx + yy)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _quaternion(rotation: Floats) -> Floats:
    """Quaternions (..., 4) of rotations (..., 3, 3), from the largest of the four components."""
    flat = rotation.reshape(-1, 3, 3)
    xx, yy, zz = flat[:, 0, 0], flat[:, 1, 1], flat[:, 2, 2]
    largest = np.where(xx < yy, np.where(yy < zz, 2, 1), np.where(xx < zz, 2, 0))
    largest = np.where(xx + yy + zz > 0.0, 3, largest)
    result = np.empty((len(flat), 4), dtype=flat.dtype)
    for i in range(4):
        m = flat[largest == i]
        found = np.zeros((len(m), 4), dtype=flat.dtype)
        if i == 3:
            root = np.sqrt(m[:, 0, 0] + m[:, 1, 1] + m[:, 2, 2] + 1.0)
            found[:, :3] = np.stack([m[:, 2, 1] - m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] - m[:, 0, 1]], -1)
        else:
            j, k = (i + 1) % 3, (i + 2) % 3
            root = np.sqrt(m[:, i, i] - m[:, j, j] - m[:, k, k] + 1.0)
            found[:, 3] = m[:, k, j] - m[:, j, k]
            found[:, j] = m[:, j, i] + m[:, i, j]
            found[:, k] = m[:, k, i] + m[:, i, k]
        found *= (0.5 / root)[:, None]
        found[:, i] = root * 0.5
        result[largest == i] = found
    return result.reshape(*rotation.shape[:-2], 4)


def _apply(rotation: Floats, vector: Floats) -> Floats:
    m, v = rotation, vector[..., None, :]
    return np.asarray(m[..., 0] * v[..., 0] + m[..., 1] * v[..., 1] + m[..., 2] * v[..., 2])


def _compose(a: Transform, b: Transform) -> Transform:
    left, right = a[0], b[0]
    rotation = (
        left[..., :, 0:1] * right[..., 0:1, :]
        + left[..., :, 1:2] * right[..., 1:2, :]
        + left[..., :, 2:3] * right[..., 2:3, :]
    )
    return rotation, _apply(left, b[1]) + a[1]


def _invert(value: Transform) -> Transform:
    rotation = np.swapaxes(value[0], -1, -2)
    return rotation, _apply(rotation, -value[1])
