"""Does a recorded EE pose follow the joints, through mounts that nobody stated."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from demorec.check.base import EE_POSES, Found, Lacking, Measurement, NotMeasured, check
from demorec.check.motion import FEWEST, Moving
from demorec.check.rows import LinkMatrices, displacement, matrices
from demorec.core.geometry import Array

_LARGEST = 2.0
"""How many times as large as its model a robot may be built, or as small."""
_FITTED_FRAMES, _FITTED_EPISODES, _LEVER = 60, 20, 0.1
"""By which fixed mounts are found, and metres at which a turn counts beside a distance."""


@check(
    group="physics",
    on=("external", "dataset"),  # of simulated recordings the mounts are known: `forward_kinematics` judges these
    measures="how far the EE pose strays from the joints' forward kinematics, between fixed mounts, nine tenths of it",
    unit="m",
    warn=0.02,
    fail=0.05,
    needs=EE_POSES,
)
def pose_follows_joints(subject: Moving) -> Iterator[Found]:
    """The hand goes where the joints take it, whatever its frame and the base's are: catches exchanged joints,
    other units and orders of a quaternion, and some zeros that are off. 0.1 m are added for each rad of rotation.

    A robot that is known by the names of its joints may be built larger or smaller, to half or double.
    """
    motions = subject.motions.all
    for motion in motions[:: max(1, len(motions) // _FITTED_EPISODES)]:
        if motion.ee_pose is None or motion.urdf is None:
            yield Lacking(need=EE_POSES)
            return
        if motion.tcp_link:
            yield NotMeasured(why="the link is known of which these are the poses, and forward_kinematics judges them")
            continue
        if len(motion.state) < FEWEST:
            yield NotMeasured(why=f"an episode has fewer than {FEWEST} frames")
            continue
        links = LinkMatrices(motion.urdf, motion.joint_position, len(motion.state))
        last = [joint.child for joint in motion.urdf.depth_first() if joint.name in motion.joint_position][-1]
        off = _mounted(links[last], matrices(motion.ee_pose))
        frame = int(np.argmax(off))
        yield Measurement(value=float(np.quantile(off, 0.9)), frame=frame, detail=motion.where)


def _mounted(links: Array, poses: Array) -> Array:
    """(T,) metres by which poses (T, 4, 4) are off X @ links @ Y, for the fixed X and Y and the size that fit best."""
    from scipy.optimize import least_squares
    from scipy.spatial.transform import Rotation

    def fixed(numbers: Array) -> Array:
        out = np.eye(4)
        out[:3, :3], out[:3, 3] = Rotation.from_rotvec(numbers[:3]).as_matrix(), numbers[3:]
        return out

    def placed(numbers: Array, links: Array) -> Array:
        sized = links.copy()
        sized[:, :3, 3] *= _LARGEST ** math.tanh(numbers[12])
        return np.asarray(fixed(numbers[:6]) @ sized @ fixed(numbers[6:12]))

    rows = np.unique(np.linspace(0, len(links) - 1, _FITTED_FRAMES).astype(int))

    def residual(numbers: Array) -> Array:
        off = placed(numbers, links[rows]) - poses[rows]
        return np.asarray((off[:, :3] * [_LEVER, _LEVER, _LEVER, 1.0]).reshape(-1))

    best = None
    for yaw in np.arange(4) * (math.pi / 2):  # bases that are turned may be far from each other's fit
        start = np.array([0.0, 0.0, yaw, 0.0, 0.0, 0.0])
        mount = np.linalg.inv(fixed(start) @ links[0]) @ poses[0]
        guess = np.concatenate([start, Rotation.from_matrix(mount[:3, :3]).as_rotvec(), mount[:3, 3], [0.0]])
        found = least_squares(residual, guess)
        best = found if best is None or found.cost < best.cost else best
        if best.cost < 1e-3 * _LEVER * len(rows):
            break
    assert best is not None
    return displacement(placed(best.x, links), poses)
