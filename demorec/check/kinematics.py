"""The recorded EE pose against forward kinematics of the joints."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from demorec.check.base import ANY_EPISODE, Found, Measurement, NotMeasured, check
from demorec.check.dataset import Episodes
from demorec.check.evidence import MIN_FRAMES, Motion
from demorec.check.rows import LinkMatrices, displacement, matrices
from demorec.core.geometry import Array

EE_POSES = "EE poses, and a robot whose URDF is known (--urdf FILE)"
KNOWN_LINK_TOLERANCE_M = 1e-3
"""Error allowed where the URDF has the link whose pose is recorded, in float32 at least."""
FITTED_TOLERANCE_M = 0.05
"""Error allowed where base and tool are fitted: hands sag, and drivers read joints and pose at different times."""
MAX_SIZE_RATIO = 2.0
"""How many times as large as its model a robot may be built, or as small."""
MAX_FITTED_EPISODES = 20
MAX_FITTED_FRAMES = 60
LEVER_M = 0.1
"""Lever at which a rotation counts beside a distance."""


@check(
    group="physics",
    on=ANY_EPISODE,
    measures="error of the EE pose against forward kinematics, times what is allowed "
    f"({1e3 * KNOWN_LINK_TOLERANCE_M:g} mm at a link of the URDF, {1e3 * FITTED_TOLERANCE_M:g} mm at a fitted one)",
    warn=0.4,
    fail=1.0,
    needs=EE_POSES,
)
def forward_kinematics(subject: Episodes) -> Iterator[Found]:
    """Compare the EE pose with the joints', 0.1 m added for each rad of rotation.

    Catches exchanged joints, other units and orders of a quaternion, and joint offsets. Where it is not known which
    link the pose is of, a fixed base, a fixed tool and the robot's size are fitted to each episode.
    """
    motions = subject.motions
    every = max(1, len(motions) // MAX_FITTED_EPISODES)
    for number, motion in enumerate(motions):
        if motion.ee_pose is None or motion.urdf is None:
            yield NotMeasured(why=f"it needs {EE_POSES}")
            return
        known = np.isfinite(motion.ee_pose).all(axis=1) & np.isfinite(motion.state).all(axis=1)
        frames = np.flatnonzero(known)
        if motion.tcp_link:
            yield _judged(motion, frames, _known_link_error(motion, frames), KNOWN_LINK_TOLERANCE_M, quantile=1.0)
        elif len(frames) < MIN_FRAMES:
            yield NotMeasured(why=f"an episode has fewer than {MIN_FRAMES} frames")
        elif number % every == 0:
            yield _judged(motion, frames, _fitted_error(motion, frames), FITTED_TOLERANCE_M, quantile=0.9)


def _judged(motion: Motion, frames: NDArray[np.intp], error_m: Array, allowed_m: float, *, quantile: float) -> Found:
    if not len(frames):
        return None
    error = float(np.quantile(error_m, quantile))
    detail = ", ".join(filter(None, (f"{1e3 * error:.3g} mm", motion.where)))
    return Measurement(value=error / allowed_m, frame=int(frames[error_m.argmax()]), detail=detail)


def _known_link_error(motion: Motion, frames: NDArray[np.intp]) -> Array:
    assert motion.urdf is not None
    assert motion.ee_pose is not None
    joints = {name: column[frames] for name, column in motion.joint_position.items()}
    hand = LinkMatrices(motion.urdf, joints, len(frames))[motion.tcp_link]
    return displacement(matrices(motion.ee_pose[frames]), hand, lever_m=LEVER_M)


def _fitted_error(motion: Motion, frames: NDArray[np.intp]) -> Array:
    """(T,) metres that are left after the best fit of a base, a tool and a size to some frames."""
    assert motion.urdf is not None
    assert motion.ee_pose is not None
    joints = {name: column[frames] for name, column in motion.joint_position.items()}
    last = [joint.child for joint in motion.urdf.depth_first() if joint.name in joints][-1]
    links = LinkMatrices(motion.urdf, joints, len(frames))[last]
    poses = matrices(motion.ee_pose[frames])
    rows = np.unique(np.linspace(0, len(frames) - 1, min(MAX_FITTED_FRAMES, len(frames))).astype(int))
    return displacement(_placed(_fit(links[rows], poses[rows]), links), poses, lever_m=LEVER_M)


def _transform(numbers: Array) -> Array:
    """(4, 4) of a rotation vector and a position."""
    from scipy.spatial.transform import Rotation

    out = np.eye(4)
    out[:3, :3] = Rotation.from_rotvec(numbers[:3]).as_matrix()
    out[:3, 3] = numbers[3:]
    return out


def _placed(fit: Array, links: Array) -> Array:
    """(N, 4, 4) poses of the hand by the links' (N, 4, 4): base, size, tool."""
    sized = links.copy()
    sized[:, :3, 3] *= MAX_SIZE_RATIO ** math.tanh(fit[12])
    return np.asarray(_transform(fit[:6]) @ sized @ _transform(fit[6:12]))


def _fit(links: Array, poses: Array) -> Array:
    """(13,) the base X, the tool Y and the size that bring X @ links @ Y nearest to the poses, all (N, 4, 4)."""
    from scipy.optimize import least_squares
    from scipy.spatial.transform import Rotation

    def residual(fit: Array) -> Array:
        error = _placed(fit, links) - poses
        return np.asarray((error[:, :3] * [LEVER_M, LEVER_M, LEVER_M, 1.0]).reshape(-1))

    best = None
    for yaw in np.arange(4) * (math.pi / 2):  # from a base that is turned far away the fit may end elsewhere
        base = np.array([0.0, 0.0, yaw, 0.0, 0.0, 0.0])
        tool = np.linalg.inv(_transform(base) @ links[0]) @ poses[0]
        start = np.concatenate([base, Rotation.from_matrix(tool[:3, :3]).as_rotvec(), tool[:3, 3], [0.0]])
        found = least_squares(residual, start)
        best = found if best is None or found.cost < best.cost else best
        if best.cost < 1e-3 * LEVER_M * len(links):
            break
    assert best is not None
    return np.asarray(best.x)
