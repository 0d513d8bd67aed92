"""Are forces those that the motion needs: efforts and wrench against inverse dynamics.

The model's masses, each at its link's centre of mass, accelerated as the recorded joints say, give the torque of every
arm joint and the force on the hand (Newton and d'Alembert, without the links' own rotational inertia). What is carried
adds its weight. That is exact enough where nothing is hit and the motion is smooth: medians and the gain are reported.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from demorec.check.base import Found, Measurement, NotMeasured, worst
from demorec.core.errors import SceneError, as_reason
from demorec.core.geometry import Array
from demorec.robots.assets import asset_path
from demorec.robots.inertials import link_masses
from demorec.robots.urdf import Urdf, UrdfJoint

MIN_LOAD, LEAST_LOAD = 3.0, 1.0
"""N m, root mean square: joints that bear less say nothing of a gain; of an offset they do, as if they bore so much."""
MIN_FRAMES = 20
LIFTED_HEIGHT = 0.01
"""Metres above its start from which on the arm bears an object in the hand."""
MAX_CHANGE = 2.0
"""m/s^2: where the TCP's acceleration changes by more from one frame to the next, the frames do not tell what it is at
one of them (noise on the commands shakes the arm within a frame). This leaves a fifth of gravity unknown at most."""


class Load(NamedTuple):
    """A mass with its way: `point` (T, 3) metres, `force` (T, 3) N that it needs, and the joints that bear it."""

    point: Array
    force: Array
    joints: frozenset[str]


class Dynamics:
    """Inverse dynamics of an episode with point masses.

    Args:
        links: Poses of the links, (T, 4, 4) each, in a frame that does not accelerate.
        urdf: The joint tree.
        masses: Link -> mass, kg, and centre of mass in the link's frame, metres.
        gravity: (3,) m/s^2 in the same frame.
        fps: Frames per second.
        tip: The link whose motion has to be smooth.
        carried: What else the arm bears.
        free: (T,) frames in which the hand touches nothing but what it carries.
    """

    def __init__(
        self,
        links: Callable[[str], Array],
        urdf: Urdf,
        masses: Mapping[str, tuple[float, Array]],
        *,
        gravity: Array,
        fps: float,
        tip: str,
        carried: Sequence[Load] = (),
        free: NDArray[np.bool_] | None = None,
    ) -> None:
        self._links, self._urdf = links, urdf
        self.loads = [*carried]
        for name, (mass, centre) in masses.items():
            pose = links(name)
            point = pose[:, :3, :3] @ centre + pose[:, :3, 3]
            acceleration = np.zeros_like(point)
            acceleration[1:-1] = (point[2:] - 2 * point[1:-1] + point[:-2]) * fps**2
            joints = frozenset(joint.name for joint in urdf.path_to(name))
            self.loads.append(Load(point, mass * (acceleration - gravity), joints))
        self._forces = np.stack([load.force for load in self.loads])  # (loads, T, 3)
        self._moments = np.cross(np.stack([load.point for load in self.loads]), self._forces)
        self._torques: dict[str, Array] = {}
        # Its acceleration comes from the frames around; the two frames at either end have too few.
        acceleration = np.diff(links(tip)[:, :3, 3], 2, axis=0) * fps**2
        change = np.linalg.norm(np.diff(acceleration, axis=0), axis=1)
        smooth = np.zeros(len(links(tip)), dtype=np.bool_)
        smooth[2:-2] = np.maximum(change[:-1], change[1:]) < MAX_CHANGE
        self.is_judged = smooth if free is None else smooth & free

    def borne(self, joint: str) -> tuple[Array, Array]:
        """What a joint bears: (T, 3) N, and its (T, 3) N m about the origin."""
        below = [joint in load.joints for load in self.loads]
        return self._forces[below].sum(axis=0), self._moments[below].sum(axis=0)

    def torque(self, joint: UrdfJoint) -> Array:
        """(T,) N m of a joint's motor."""
        if joint.name not in self._torques:
            pose, (force, moment) = self._links(joint.child), self.borne(joint.name)
            axis = pose[:, :3, :3] @ np.array(joint.axis)
            self._torques[joint.name] = (axis * (moment - np.cross(pose[:, :3, 3], force))).sum(axis=1)
        return self._torques[joint.name]

    def compare(self, joints: Sequence[str], effort: Array) -> Found:
        """Efforts (T, n) of some joints ("" for what is none) against the torques that the motion needs."""
        number = int(self.is_judged.sum())
        if number < MIN_FRAMES:
            return NotMeasured(why=f"the hand is free and moves smoothly in {number} frames, fewer than {MIN_FRAMES}")
        found, known = [], {joint.name: joint for joint in self._urdf.joints if joint.kind != "prismatic"}
        for name, values in zip(joints, effort.T, strict=True):
            if name not in known or not np.isfinite(values).all():
                continue
            torque, values = self.torque(known[name])[self.is_judged], values[self.is_judged]
            size = float(np.sqrt(np.median(torque**2)))
            off = float(np.median(values - torque))
            found.append(Measurement(value=abs(off) / max(size, LEAST_LOAD), detail=f"{name} is {off:+.2g} N m off"))
            if size >= MIN_LOAD:
                gain = float((values * torque).sum() / (torque**2).sum())
                found.append(Measurement(value=abs(gain - 1), detail=f"{name} gives {gain:.3g} of {size:.0f} N m"))
        return worst(*found) or NotMeasured(why="no joint of the arm is known")


def masses_of(model: str) -> dict[str, tuple[float, Array]]:
    """Link -> mass, kg, and centre of mass in the link's frame, metres.

    Args:
        model: Text of a URDF, or its name as by `asset_path`.

    Raises:
        SceneError: The model is not to be had, or says no masses.
    """
    try:
        return _masses(model if "<" in model else asset_path(model).read_text())
    except (OSError, ValueError) as error:
        raise SceneError(as_reason(error)) from error


_masses = lru_cache(maxsize=8)(link_masses)  # all recordings of a robot have the same
