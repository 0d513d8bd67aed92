"""Forward and inverse kinematics of any serial arm, from its URDF, for fully or partly specified poses.

One generic implementation (`demorec.robots.kinematics_kernels`) instead of a hand-written table per robot.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import cast

import numpy as np

from demorec.core.geometry import Array, Pose, quat_from_rotation, wrap_angle
from demorec.robots.kinematics_kernels import forward, inverse, straight_path, tilt_and_roll
from demorec.robots.robot import RobotSpec
from demorec.robots.urdf import Urdf

POSITION_TOLERANCE = 1e-5
ROTATION_TOLERANCE = 1e-4
MAX_ITERATIONS = 60


@dataclass(frozen=True, kw_only=True)
class Freedom:
    """Allowed deviation from a target pose in orientation; the position is always exact.

    Attributes:
        cone: Maximum angle between its approach (z of the TCP) and the target's, rad; pi: any approach.
        roll: Maximum angle about the approach, rad; pi: any roll.
    """

    cone: float = 0.0
    roll: float = 0.0


WHOLE_POSE = Freedom()
FIVE_JOINTS = Freedom(cone=math.radians(15.0), roll=math.radians(2.0))
"""Default of an arm with fewer than six joints, which cannot tilt its hand in every direction."""


class ArmKinematics:
    """A serial chain of n revolute joints from the base of a URDF to the tool centre point.

    Fixed joints are merged; every other joint in the chain must be one of the spec.

    Args:
        urdf: URDF of the arm, at any scale.
        spec: Its joints, base to flange, their limits, and the link with its frame at the tool centre point.

    Attributes:
        num_joints: n.
        origins: (n, 3) position of each joint in the frame of its predecessor, metres.
        lower, upper: (n,) position limits of the inverse kinematics, rad.
        freedom: Default freedom of poses.
        tables: Arm data for the compiled loops: `origins`, (n, 3, 3) the joints' rotations there, (n, 3) their unit
            axes, (3,) the TCP in the last joint's frame, metres, (3, 3) its rotation there, and the limits.
    Raises:
        ValueError: The joints between base and TCP are not the spec's, or one is not revolute.
    """

    def __init__(self, urdf: Urdf, spec: RobotSpec) -> None:
        joints = urdf.path_to(spec.tcp_link)
        moving = [joint for joint in joints if joint.kind != "fixed"]
        names = [joint.name for joint in moving]
        if not names or names != list(spec.arm_joints) or any(j.kind == "prismatic" for j in moving):
            found = [f"{joint.name} ({joint.kind})" for joint in moving]
            raise ValueError(f"the joints to {spec.tcp_link} are {found}, expected the revolute {spec.arm_joints}")
        origins, tool = [], Pose()
        for joint in joints:
            tool = tool @ joint.parent_from_joint
            if joint.kind != "fixed":
                origins.append(tool)
                tool = Pose()
        self.num_joints = len(origins)
        self.lower = np.array(spec.position_lower, dtype=np.float64)
        self.upper = np.array(spec.position_upper, dtype=np.float64)
        self.freedom = WHOLE_POSE if len(origins) >= 6 else FIVE_JOINTS
        self.origins = np.array([pose.position for pose in origins])
        rotations = np.array([pose.rotation for pose in origins])
        axes = np.array([joint.axis for joint in moving])
        self._upwards = float(rotations[0][2] @ axes[0])
        self.tables = (self.origins, rotations, axes, np.array(tool.position), tool.rotation, self.lower, self.upper)

    def turned_towards(self, joint_position: Array, point: Array) -> Array:
        """Turn the first joint of an upright arm's configuration (n,) to bring the hand to the azimuth of a point.

        The point (3,) is in the base frame, metres; azimuths are measured about that joint's axis.
        """
        x, y = self.origins[0][:2]
        hand = self.forward(joint_position).position
        turn = wrap_angle(math.atan2(point[1] - y, point[0] - x) - math.atan2(hand[1] - y, hand[0] - x))
        turned = np.array(joint_position)
        turned[0] += math.copysign(turn, self._upwards * turn)
        return turned

    def forward(self, joint_position: Array) -> Pose:
        """Compute `base_from_tcp` at (n,) joint positions, rad."""
        q = np.ascontiguousarray(joint_position, dtype=np.float64)
        position, rotation, _ = forward(q, self.tables)
        return Pose(position=position, quat_xyzw=quat_from_rotation(rotation))

    def inverse(
        self,
        base_from_tcp: Pose,
        *,
        start: Array,
        rest: Array | None = None,
        null_gain: float = 0.1,
        freedom: Freedom | None = None,
    ) -> Array | None:
        """Find joint positions (n,) that reach a pose to 0.01 mm and 0.1 mrad, or within its freedom; None if not
        found.

        Args:
            base_from_tcp: Target pose.
            start: (n,) initial configuration, rad.
            rest: (n,) configuration towards which the null space is pulled; None for no pull.
            null_gain: Strength of the pull, 1 per iteration.
            freedom: Freedom of the pose; None: the arm's own.
        """
        q, reached = self._seek(base_from_tcp, start, rest, null_gain, freedom or self.freedom)
        return q if reached else None

    def find(self, base_from_tcp: Pose, *, start: Array, rest: Array) -> Array | None:
        """Search as `inverse`; if it ends at a joint limit though the pose is within reach, also from other starts.

        These are the rest configuration, with and without the pull to it, and with its last joint, about which a hand
        that points down turns, turned by 90 degrees in both directions.

        Args:
            base_from_tcp: Target pose.
            start: (n,) first initial configuration, rad.
            rest: (n,) configuration towards which the null space is pulled.
        """
        q = self.inverse(base_from_tcp, start=start, rest=rest)
        if q is None:
            q = self.inverse(base_from_tcp, start=rest, rest=rest)
        for turn in (0.0, math.pi / 2, -math.pi / 2):
            if q is None:
                turned = np.array([*rest[:-1], rest[-1] + turn])
                q = self.inverse(base_from_tcp, start=np.clip(turned, self.lower, self.upper))
        return q

    def why_unreachable(
        self, base_from_tcp: Pose, *, start: Array, rest: Array | None = None, freedom: Freedom | None = None
    ) -> str:
        """Explain in words why a pose is unreachable; "" if `inverse` with the same arguments finds it."""
        freedom = freedom or self.freedom
        if self.inverse(base_from_tcp, start=start, rest=rest, freedom=freedom) is not None:
            return ""
        q, is_near = self._seek(base_from_tcp, start, rest, 0.1, Freedom(cone=math.pi, roll=math.pi))
        if is_near:
            q, _ = self._seek(base_from_tcp, start, rest, 0.1, freedom)
        found = self.forward(q)
        tilt_x, tilt_y, roll = tilt_and_roll(base_from_tcp.rotation, found.rotation)
        short, tilt = math.dist(base_from_tcp.position, found.position), math.hypot(tilt_x, tilt_y)
        at_limit = [
            k + 1 for k in range(self.num_joints) if min(q[k] - self.lower[k], self.upper[k] - q[k]) < 0.01 + 1e-9
        ]
        held = f" (at its limit: joint {', '.join(map(str, at_limit))})" if at_limit else ""
        if not is_near:
            return f"the TCP stays {short:.3f} m short of the position{held}"
        leans = tilt > freedom.cone
        missed = f"{tilt:.3f} rad off the approach" if leans else f"{abs(roll):.3f} rad off the roll"
        allowed = freedom.cone if leans else freedom.roll
        return f"at the position the hand stays {missed}, allowed are {allowed:.3f} rad{held}"

    def _seek(
        self, base_from_tcp: Pose, start: Array, rest: Array | None, null_gain: float, freedom: Freedom
    ) -> tuple[Array, bool]:
        """Return the joint positions (n,) at which the iteration ends, and whether they reach the pose."""
        q, reached = inverse(
            np.array(base_from_tcp.position),
            base_from_tcp.rotation,
            np.array(start, dtype=np.float64),
            np.array(start if rest is None else rest, dtype=np.float64),
            0.0 if rest is None else null_gain,
            MAX_ITERATIONS,
            POSITION_TOLERANCE,
            ROTATION_TOLERANCE,
            freedom.cone,
            freedom.roll,
            self.tables,
        )
        return cast(Array, q), bool(reached)

    def straight_path(
        self, *, start: Array, goal: Array, base_from_start: Pose, base_from_goal: Pose, fractions: Array
    ) -> Array | None:
        """Compute (T, n) joint positions along a straight line with slerp; None if the arm cannot follow it.

        Each point starts from the joint-space blend of `start` and `goal`, so that the null space cannot jump.

        Args:
            start, goal: (n,) configurations at both ends.
            base_from_start, base_from_goal: Their TCP poses.
            fractions: (T,) fractions of the path, 0..1.
        """
        path, reached = straight_path(
            np.array(start, dtype=np.float64),
            np.array(goal, dtype=np.float64),
            np.array(base_from_start.position),
            base_from_start.rotation,
            np.array(base_from_goal.position),
            base_from_goal.rotation,
            np.array(fractions, dtype=np.float64),
            # Along the path, an arm with few joints may tilt farther than at the target.
            min(math.pi, 2 * self.freedom.cone),
            min(math.pi, 5 * self.freedom.roll),
            self.tables,
        )
        return cast(Array, path) if reached else None
