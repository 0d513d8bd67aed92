"""Forward and inverse kinematics of any serial arm, from its URDF.

One generic code (`demorec.robots.kinematics_kernels`) instead of a hand-written table per robot.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np

from demorec.core.geometry import Array, Pose, quat_from_rotation
from demorec.robots.kinematics_kernels import forward, inverse, straight_path
from demorec.robots.urdf import Urdf

POSITION_TOLERANCE = 1e-5
ROTATION_TOLERANCE = 1e-4
MAX_ITERATIONS = 60


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
        urdf: Urdf,
        *,
        arm_joints: Sequence[str],
        tcp_link: str,
        lower: Sequence[float],
        upper: Sequence[float],
    ) -> ArmKinematics:
        """From a URDF: fixed joints are merged, every other joint on the way must be one of `arm_joints`.

        Raises:
            ValueError: The joints on the way to `tcp_link` are not `arm_joints`, or one does not turn.
        """
        joints = urdf.path_to(tcp_link)
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
        q = np.ascontiguousarray(joint_position, dtype=np.float64)
        position, rotation, _ = forward(q, self.origins, self.rotations, self.axes, self.tool, self.tool_rotation)
        return Pose(position=position, quat_xyzw=quat_from_rotation(rotation))

    def inverse(
        self,
        base_from_tcp: Pose,
        *,
        start: Array,
        rest: Array | None = None,
        null_gain: float = 0.1,
    ) -> Array | None:
        """Joint positions (n,) that reach a pose to 0.01 mm and 0.1 mrad, or None.

        Args:
            base_from_tcp: Wanted pose.
            start: (n,) where the iteration starts, rad.
            rest: (n,) configuration towards which the null space is pulled; None for no pull.
            null_gain: Strength of the pull, 1 per iteration.
        """
        q, reached = inverse(
            np.array(base_from_tcp.position),
            base_from_tcp.rotation,
            np.array(start, dtype=np.float64),
            np.array(start if rest is None else rest, dtype=np.float64),
            0.0 if rest is None else null_gain,
            MAX_ITERATIONS,
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
        path, reached = straight_path(
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
