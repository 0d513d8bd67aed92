"""Does a recorded EE pose follow the joints, through mounts that nobody stated."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Literal

import numpy as np

from demorec.check.base import EE_POSES, Found, Lacking, Measurement, NotMeasured, check
from demorec.check.dataset import Recorded
from demorec.check.evidence import FEWEST, Motion
from demorec.check.rows import LinkMatrices, displacement, matrices
from demorec.core.geometry import Array

_LARGEST = 2.0
"""How many times as large as its model a robot may be built, or as small."""
_FAR_BETTER = 2.0
"""Times what an episode is off by its own mounts, which says how good any can be."""
_FITTED_FRAMES, _FITTED_EPISODES, _LEVER = 60, 20, 0.1
"""By which fixed mounts are found, and metres at which a turn counts beside a distance."""
_FEWEST_EPISODES, _OFF = 3, 0.01
"""Of which it is told whether their mounts are one, and metres from which on a frame counts less for the common one."""


@check(
    group="physics",
    on=("external", "dataset"),  # of simulated recordings the mounts are known: `forward_kinematics` judges these
    measures="how far the EE pose strays from the joints' forward kinematics, between fixed mounts, nine tenths of it",
    unit="m",
    warn=0.02,
    fail=0.05,
    needs=EE_POSES,
)
def pose_follows_joints(subject: Recorded) -> Iterator[Found]:
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
        off = _off(_fitted(*_links_and_poses(motion, _FITTED_FRAMES)), motion)
        yield Measurement(value=float(np.quantile(off, 0.9)), frame=int(np.argmax(off)), detail=motion.where)


@check(
    group="physics",
    on=("external", "dataset"),
    measures="how much farther than usual an episode's EE poses are from the joints', by the mounts of all episodes",
    unit="m",
    warn=0.01,
    fail=math.inf,
    needs=EE_POSES,
)
def mounts_alike(subject: Recorded) -> Found:
    """The arm stands where it stood and has the tool that it had, and its joints have their zeros, in all episodes:
    catches an arm that was homed anew, another tool, a base that was moved. What is usual does not count, unless the
    mounts of an episode alone fit it far better: half of them may be off."""
    motions = [m for m in subject.motions.all if m.ee_pose is not None and m.urdf is not None]
    if not motions:
        return Lacking(need=EE_POSES)
    motions = [motion for motion in motions if not motion.tcp_link and len(motion.state) >= FEWEST]
    if len(motions) < _FEWEST_EPISODES:
        return NotMeasured(why=f"of fewer than {_FEWEST_EPISODES} episodes the mounts are unknown")
    chosen = motions[:: max(1, len(motions) // _FITTED_EPISODES)]
    few = max(_FITTED_FRAMES // len(chosen), 5)
    links, poses = zip(*(_links_and_poses(motion, few) for motion in chosen), strict=True)
    fit = _fitted(np.concatenate(links), np.concatenate(poses), loss="soft_l1")
    off = [float(np.quantile(_off(fit, motion), 0.9)) for motion in motions]
    odd = motions[int(np.argmax(off))]
    alone = float(np.quantile(_off(_fitted(*_links_and_poses(odd, _FITTED_FRAMES)), odd), 0.9))
    return Measurement(value=max(off) - min(float(np.median(off)), _FAR_BETTER * alone), detail=odd.where)


def _off(fit: Array, motion: Motion) -> Array:
    """(T,) metres that the poses are off."""
    links, poses = _links_and_poses(motion, len(motion.state))
    return displacement(_placed(fit, links), poses)


def _links_and_poses(motion: Motion, count: int) -> tuple[Array, Array]:
    """(N, 4, 4) of the last link that moves, and of the hand, in N frames of an episode: so many at most, evenly."""
    assert motion.urdf is not None
    assert motion.ee_pose is not None
    rows = np.unique(np.linspace(0, len(motion.state) - 1, min(count, len(motion.state))).astype(int))
    joints = {name: column[rows] for name, column in motion.joint_position.items()}
    last = [joint.child for joint in motion.urdf.depth_first() if joint.name in joints][-1]
    return LinkMatrices(motion.urdf, joints, len(rows))[last], matrices(motion.ee_pose[rows])


def _fixed(numbers: Array) -> Array:
    from scipy.spatial.transform import Rotation

    out = np.eye(4)
    out[:3, :3], out[:3, 3] = Rotation.from_rotvec(numbers[:3]).as_matrix(), numbers[3:]
    return out


def _placed(numbers: Array, links: Array) -> Array:
    """(N, 4, 4) hands at links (N, 4, 4), by a fit."""
    sized = links.copy()
    sized[:, :3, 3] *= _LARGEST ** math.tanh(numbers[12])
    return np.asarray(_fixed(numbers[:6]) @ sized @ _fixed(numbers[6:12]))


def _fitted(links: Array, poses: Array, loss: Literal["linear", "soft_l1"] = "linear") -> Array:
    """(13,) the fixed X and Y and the size by which X @ links @ Y are nearest to poses, all (N, 4, 4)."""
    from scipy.optimize import least_squares
    from scipy.spatial.transform import Rotation

    def residual(numbers: Array) -> Array:
        off = _placed(numbers, links) - poses
        return np.asarray((off[:, :3] * [_LEVER, _LEVER, _LEVER, 1.0]).reshape(-1))

    best = None
    for yaw in np.arange(4) * (math.pi / 2):  # bases that are turned may be far from each other's fit
        start = np.array([0.0, 0.0, yaw, 0.0, 0.0, 0.0])
        mount = np.linalg.inv(_fixed(start) @ links[0]) @ poses[0]
        guess = np.concatenate([start, Rotation.from_matrix(mount[:3, :3]).as_rotvec(), mount[:3, 3], [0.0]])
        found = least_squares(residual, guess, loss=loss, f_scale=_OFF)
        best = found if best is None or found.cost < best.cost else best
        if best.cost < 1e-3 * _LEVER * len(links):
            break
    assert best is not None
    return np.asarray(best.x)
