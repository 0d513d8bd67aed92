"""Forward and inverse kinematics of any serial arm, from its URDF.

One generic code instead of a hand-written table per robot. Compiled by Numba without fast-math and without BLAS,
every sum in a fixed order, so that the same targets come out on every CPU (an OpenBLAS kernel is chosen by CPU
type and changes the last bits). The methods are the textbook ones: product of homogeneous transforms, geometric
Jacobian, damped least squares with a projected null-space pull (Siciliano et al., Robotics, sections 2.8, 3.1, 3.7).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numba
import numpy as np

from demorec.geometry import Array, Pose, quat_from_rotation
from demorec.scene.urdf import Urdf

_njit: Any = numba.njit(cache=True, error_model="numpy")

POSITION_TOLERANCE = 1e-5
ROTATION_TOLERANCE = 1e-4


@dataclass(frozen=True, kw_only=True, eq=False)
class ArmKinematics:
    """A serial chain of n revolute joints from the base to the tool centre point.

    Attributes:
        origins: (n, 3) position of each joint in the frame of the one before, metres.
        rotations: (n, 3, 3) its rotation there.
        axes: (n, 3) unit axes in the joint frames.
        tool: (3,) TCP in the last joint's frame, metres.
        tool_rotation: (3, 3).
        lower, upper: (n,) position limits that the inverse kinematics keeps, rad.
    """

    origins: Array
    rotations: Array
    axes: Array
    tool: Array
    tool_rotation: Array
    lower: Array
    upper: Array

    @classmethod
    def from_urdf(
        cls,
        path: Path,
        *,
        arm_joints: Sequence[str],
        tcp_link: str,
        lower: Sequence[float],
        upper: Sequence[float],
        scale: float = 1.0,
    ) -> ArmKinematics:
        """From a URDF: fixed joints are merged, every other joint on the way must be one of `arm_joints`.

        Raises:
            ValueError: The joints on the way to `tcp_link` are not `arm_joints`, or one does not turn.
        """
        joints = Urdf.load(path, scale=scale).path_to(tcp_link)
        moving = [joint for joint in joints if joint.kind != "fixed"]
        if [joint.name for joint in moving] != list(arm_joints) or any(j.kind == "prismatic" for j in moving):
            found = [f"{joint.name} ({joint.kind})" for joint in moving]
            raise ValueError(f"the way to {tcp_link} has the joints {found}, expected turning {list(arm_joints)}")
        origins, axes = [], []
        pending = Pose()
        for joint in joints:
            pending = pending @ joint.parent_from_joint
            if joint.kind != "fixed":
                origins.append(pending)
                axes.append(joint.axis)
                pending = Pose()
        return cls(
            origins=np.array([pose.position for pose in origins]),
            rotations=np.array([pose.rotation for pose in origins]),
            axes=np.array(axes),
            tool=np.array(pending.position),
            tool_rotation=pending.rotation,
            lower=np.array(lower, dtype=np.float64),
            upper=np.array(upper, dtype=np.float64),
        )

    @property
    def num_joints(self) -> int:
        """n."""
        return len(self.origins)

    def forward(self, joint_position: Array) -> Pose:
        """`base_from_tcp` at (n,) joint positions, rad."""
        position, rotation, _ = self._forward(joint_position)
        return Pose(position=position, quat_xyzw=quat_from_rotation(rotation))

    def jacobian(self, joint_position: Array) -> Array:
        """(6, n) geometric Jacobian of the TCP in the base frame: linear, then angular velocity."""
        return self._forward(joint_position)[2]

    def _forward(self, joint_position: Array) -> tuple[Array, Array, Array]:
        q = np.ascontiguousarray(joint_position, dtype=np.float64)
        return cast(
            tuple[Array, Array, Array],
            _forward(q, self.origins, self.rotations, self.axes, self.tool, self.tool_rotation),
        )

    def inverse(
        self,
        base_from_tcp: Pose,
        *,
        start: Array,
        rest: Array | None = None,
        null_gain: float = 0.1,
        max_iterations: int = 60,
    ) -> Array | None:
        """Joint positions (n,) that reach a pose to 0.01 mm and 0.1 mrad, or None.

        Args:
            base_from_tcp: Wanted pose.
            start: (n,) where the iteration starts, rad.
            rest: (n,) configuration towards which the null space is pulled; None for no pull.
            null_gain: Strength of the pull, 1 per iteration.
            max_iterations: Bound.
        """
        q, reached = _inverse(
            np.array(base_from_tcp.position),
            base_from_tcp.rotation,
            np.array(start, dtype=np.float64),
            np.array(start if rest is None else rest, dtype=np.float64),
            0.0 if rest is None else null_gain,
            max_iterations,
            POSITION_TOLERANCE,
            ROTATION_TOLERANCE,
            *self._tables(),
        )
        return cast(Array, q) if reached else None

    def straight_path(
        self, *, start: Array, goal: Array, base_from_start: Pose, base_from_goal: Pose, fractions: Array
    ) -> Array | None:
        """(T, n) joint positions along a straight line with slerp, or None where the arm cannot follow.

        Each point starts from the joint-space blend between `start` and `goal`, so that the null space cannot jump.

        Args:
            start, goal: (n,) configurations at both ends.
            base_from_start, base_from_goal: Their TCP poses.
            fractions: (T,) of the way, 0..1.
        """
        path, reached = _straight_path(
            np.array(start, dtype=np.float64),
            np.array(goal, dtype=np.float64),
            np.array(base_from_start.position),
            base_from_start.rotation,
            np.array(base_from_goal.position),
            base_from_goal.rotation,
            np.array(fractions, dtype=np.float64),
            *self._tables(),
        )
        return cast(Array, path) if reached else None

    def _tables(self) -> tuple[Array, ...]:
        return (self.origins, self.rotations, self.axes, self.tool, self.tool_rotation, self.lower, self.upper)


@_njit
def _multiply(a, b):  # type: ignore[no-untyped-def]
    """Product of two (3, 3) matrices, each sum in index order."""
    out = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            out[i, j] = a[i, 0] * b[0, j] + a[i, 1] * b[1, j] + a[i, 2] * b[2, j]
    return out


@_njit
def _apply(a, v):  # type: ignore[no-untyped-def]
    """(3, 3) matrix times (3,) vector."""
    out = np.empty(3)
    for i in range(3):
        out[i] = a[i, 0] * v[0] + a[i, 1] * v[1] + a[i, 2] * v[2]
    return out


@_njit
def _axis_rotation(axis, angle):  # type: ignore[no-untyped-def]
    """Rodrigues' formula for a unit axis."""
    c, s = math.cos(angle), math.sin(angle)
    x, y, z = axis[0], axis[1], axis[2]
    t = 1.0 - c
    out = np.empty((3, 3))
    out[0, 0], out[0, 1], out[0, 2] = t * x * x + c, t * x * y - s * z, t * x * z + s * y
    out[1, 0], out[1, 1], out[1, 2] = t * x * y + s * z, t * y * y + c, t * y * z - s * x
    out[2, 0], out[2, 1], out[2, 2] = t * x * z - s * y, t * y * z + s * x, t * z * z + c
    return out


@_njit
def _rotation_vector(wanted, found):  # type: ignore[no-untyped-def]
    """Rotation vector (3,) in the base frame that turns `found` into `wanted`."""
    error = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            error[i, j] = wanted[i, 0] * found[j, 0] + wanted[i, 1] * found[j, 1] + wanted[i, 2] * found[j, 2]
    v = np.empty(3)
    v[0], v[1], v[2] = error[2, 1] - error[1, 2], error[0, 2] - error[2, 0], error[1, 0] - error[0, 1]
    sine = 0.5 * math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    cosine = 0.5 * (error[0, 0] + error[1, 1] + error[2, 2] - 1.0)
    if sine > 1e-9:
        scale = math.atan2(sine, cosine) / (2.0 * sine)
        return v * scale
    if cosine > 0.0:
        return v * 0.5
    # Half a turn: the axis is the largest column of (E + I) / 2.
    largest = 0
    for i in range(3):
        if error[i, i] > error[largest, largest]:
            largest = i
    out = np.empty(3)
    for i in range(3):
        out[i] = 0.5 * (error[i, largest] + (1.0 if i == largest else 0.0))
    return out * (math.pi / math.sqrt(out[0] * out[0] + out[1] * out[1] + out[2] * out[2]))


@_njit
def _forward(q, origins, rotations, axes, tool, tool_rotation):  # type: ignore[no-untyped-def]
    """TCP position (3,), rotation (3, 3) and geometric Jacobian (6, n)."""
    n = len(q)
    position = np.zeros(3)
    rotation = np.eye(3)
    joint_position = np.empty((n, 3))
    joint_axis = np.empty((n, 3))
    for i in range(n):
        position = position + _apply(rotation, origins[i])
        rotation = _multiply(_multiply(rotation, rotations[i]), _axis_rotation(axes[i], q[i]))
        joint_position[i] = position
        joint_axis[i] = _apply(rotation, axes[i])
    position = position + _apply(rotation, tool)
    rotation = _multiply(rotation, tool_rotation)
    jacobian = np.empty((6, n))
    for i in range(n):
        x, y, z = joint_axis[i, 0], joint_axis[i, 1], joint_axis[i, 2]
        dx, dy, dz = (
            position[0] - joint_position[i, 0],
            position[1] - joint_position[i, 1],
            position[2] - joint_position[i, 2],
        )
        jacobian[0, i], jacobian[1, i], jacobian[2, i] = y * dz - z * dy, z * dx - x * dz, x * dy - y * dx
        jacobian[3, i], jacobian[4, i], jacobian[5, i] = x, y, z
    return position, rotation, jacobian


@_njit
def _damped_solve(jacobian, damping, rhs):  # type: ignore[no-untyped-def]
    """(J J^T + damping^2 I)^-1 rhs for each column of rhs (6, m), by Cholesky's method."""
    n, m = jacobian.shape[1], rhs.shape[1]
    lower = np.zeros((6, 6))
    for i in range(6):
        for j in range(i + 1):
            total = damping * damping if i == j else 0.0
            for k in range(n):
                total += jacobian[i, k] * jacobian[j, k]
            for k in range(j):
                total -= lower[i, k] * lower[j, k]
            lower[i, j] = math.sqrt(total) if i == j else total / lower[j, j]
    out = rhs.copy()
    for column in range(m):
        for i in range(6):
            for k in range(i):
                out[i, column] -= lower[i, k] * out[k, column]
            out[i, column] /= lower[i, i]
        for i in range(5, -1, -1):
            for k in range(i + 1, 6):
                out[i, column] -= lower[k, i] * out[k, column]
            out[i, column] /= lower[i, i]
    return out


@_njit
def _inverse(  # type: ignore[no-untyped-def]
    wanted_position,
    wanted_rotation,
    start,
    rest,
    null_gain,
    max_iterations,
    position_tolerance,
    rotation_tolerance,
    origins,
    rotations,
    axes,
    tool,
    tool_rotation,
    low,
    high,
):
    """Damped least squares: dq = J# e + (I - J# J) gain (rest - q), clipped to 0.35 rad a step and to the limits."""
    n = len(start)
    q = start.copy()
    error = np.empty((6, 1))
    pull = np.empty((6, 1))
    for iteration in range(max_iterations + 1):
        position, rotation, jacobian = _forward(q, origins, rotations, axes, tool, tool_rotation)
        turn = _rotation_vector(wanted_rotation, rotation)
        worst_position = 0.0
        worst_rotation = 0.0
        for i in range(3):
            error[i, 0] = wanted_position[i] - position[i]
            error[3 + i, 0] = turn[i]
            worst_position = max(worst_position, abs(error[i, 0]))
            worst_rotation = max(worst_rotation, abs(error[3 + i, 0]))
        # A pull needs at least one step, or a start that already reaches the pose would never be improved.
        may_stop = iteration > 0 or null_gain == 0.0
        if may_stop and worst_position < position_tolerance and worst_rotation < rotation_tolerance:
            return q, True
        if iteration == max_iterations:
            break
        for i in range(6):
            pull[i, 0] = 0.0
            for k in range(n):
                pull[i, 0] += jacobian[i, k] * null_gain * (rest[k] - q[k])
        solved = _damped_solve(jacobian, 1e-3, error - pull)
        step = np.empty(n)
        largest = 0.0
        for k in range(n):
            step[k] = null_gain * (rest[k] - q[k])
            for i in range(6):
                step[k] += jacobian[i, k] * solved[i, 0]
            largest = max(largest, abs(step[k]))
        factor = 0.35 / largest if largest > 0.35 else 1.0
        for k in range(n):
            q[k] = min(max(q[k] + factor * step[k], low[k] + 0.01), high[k] - 0.01)
    return q, False


@_njit
def _straight_path(  # type: ignore[no-untyped-def]
    start,
    goal,
    start_position,
    start_rotation,
    goal_position,
    goal_rotation,
    fractions,
    origins,
    rotations,
    axes,
    tool,
    tool_rotation,
    low,
    high,
):
    turn = _rotation_vector(goal_rotation, start_rotation)
    angle = math.sqrt(turn[0] * turn[0] + turn[1] * turn[1] + turn[2] * turn[2])
    axis = turn / angle if angle > 1e-12 else np.array([0.0, 0.0, 1.0])
    out = np.empty((len(fractions), len(start)))
    all_reached = True
    for t in range(len(fractions)):
        u = fractions[t]
        position = start_position + u * (goal_position - start_position)
        rotation = _multiply(_axis_rotation(axis, u * angle), start_rotation)
        seed = start + u * (goal - start)
        q, reached = _inverse(
            position,
            rotation,
            seed,
            seed,
            0.0,
            40,
            1e-4,
            1e-3,
            origins,
            rotations,
            axes,
            tool,
            tool_rotation,
            low,
            high,
        )
        all_reached = all_reached and reached
        out[t] = q
    return out, all_reached
