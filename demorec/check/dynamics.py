"""Are forces those that the motion needs: efforts and wrench against inverse dynamics.

The model's masses, each at its link's centre of mass, accelerated as the recorded joints say, give the torque of every
arm joint and the force on the hand (Newton and d'Alembert, without the links' own rotational inertia). What is carried
adds its weight.

From the frames around a frame its acceleration is known where nothing is hit and the motion is smooth. Where the servo
is known, it tells the joints in the two physics steps before each frame, and by these the acceleration in that frame,
however noise on the commands shakes the arm.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import lru_cache, partial

import numpy as np
from numpy.typing import NDArray

from demorec.check.base import Found, Measurement, NotMeasured, worst
from demorec.check.episode import CheckedEpisode
from demorec.check.evidence import Motion
from demorec.check.rows import LinkMatrices, finest_lag
from demorec.core.errors import SceneError, as_reason
from demorec.core.geometry import Array
from demorec.episode.scene import POSITION_GAIN
from demorec.robots.assets import asset_path
from demorec.robots.inertials import link_masses
from demorec.robots.robot import RobotSpec
from demorec.robots.urdf import Urdf

MIN_LOAD, LEAST_LOAD = 3.0, 1.0
"""N m, root mean square: joints that bear less say nothing of a gain; of an offset they do, as if they bore so much."""
MIN_FRAMES = 20
_TOLD = 0.3
"""Share of the torques' variance that the best lag leaves open at most."""
LIFTED_HEIGHT = 0.01
"""Metres above its start from which on the arm bears an object in the hand."""
MAX_CHANGE = 2.0
"""m/s^2: where the TCP's acceleration changes by more from one frame to the next, the frames do not tell what it is at
one of them (noise on the commands shakes the arm within a frame). This leaves a fifth of gravity unknown at most."""


_FREE, _SERVED = 0.65, 0.005
"""Share of a motor's torque from which on it may not have done in the step before what the servo asked for; rad/s by
which it did not in the frame itself."""
_MOST_ACCELERATION = 50.0
"""m/s^2 of the TCP: what is faster hits something, or a motor is at its limit, and no servo moved it."""
_AFTER_A_HIT = 3
"""Frames before and after that say nothing either."""

Links = Callable[[str], Array]
"""Poses (T, 4, 4) of a link, in a frame that does not accelerate."""


def servo_steps(
    position: Array, velocity: Array, command: Array, *, start: Array, substeps: int, step_s: float
) -> tuple[Array, Array, Array]:
    """What a servo makes of its targets: these go linearly from one command to the next, and each step takes a joint by
    a share of what is left to its.

    Args:
        position, velocity: (T, n) in each frame: rad, rad/s.
        command: (T, n) sent after it.
        start: (n,) the target before the first.
        substeps: Physics steps from frame to frame.
        step_s: Seconds of a step.

    Returns:
        The joints (T, n) in the physics step before each frame, and in the first of two before it, and (T,) by how
        much, rad/s, the velocity in the frame is another one than the servo asked for.
    """
    sent = np.vstack([start, start, command[:-1]])
    target = sent[1:] - np.diff(sent, axis=0) / substeps
    before = position - step_s * velocity
    first = (before - POSITION_GAIN * target) / (1 - POSITION_GAIN)
    asked = POSITION_GAIN / step_s * (sent[1:] - before)
    return before, first, np.abs(velocity - asked).max(axis=1)


class Dynamics:
    """Inverse dynamics of an episode with point masses.

    Args:
        links: Poses of the links in each frame; where they are known also one and two steps before it.
        urdf: The joint tree.
        masses: Link -> mass, kg, and centre of mass in the link's frame, metres.
        gravity: (3,) m/s^2 in the same frame.
        step_s: Seconds from one step to the next, or from frame to frame.
        tip: The link whose motion has to be smooth where only frames are known.
        carried: What moves with the hand: (T,) kg, 0 where it does not, and (T, 3) metres, where it is.
        free: (T,) frames in which the hand touches nothing but what it carries.
    """

    def __init__(
        self,
        links: Sequence[Links],
        urdf: Urdf,
        masses: Mapping[str, tuple[float, Array]],
        *,
        gravity: Array,
        step_s: float,
        tip: str,
        carried: Sequence[tuple[Array, Array]] = (),
        free: NDArray[np.bool_] | None = None,
    ) -> None:
        self._links, self._step_s = links[0], step_s
        self._joints = {joint.name: joint for joint in urdf.joints}
        loads = []  # where each mass is, the force that it needs, and the link that it moves with
        for name, (mass, centre) in masses.items():
            points = [pose[:, :3, :3] @ centre + pose[:, :3, 3] for pose in (of(name) for of in links)]
            loads.append((points[0], mass * (self._acceleration(points) - gravity), name))
        of_tip = self._acceleration([of(tip)[:, :3, 3] for of in links])
        # From frame to frame hardly anything is left of how a hand that shakes accelerates.
        with_hand = of_tip if len(links) > 1 else np.zeros_like(of_tip)
        loads += [(point, mass[:, None] * (with_hand - gravity), tip) for mass, point in carried]
        places, forces, bearers = zip(*loads, strict=True)
        self._forces = np.stack(forces)  # (loads, T, 3)
        self._moments = np.cross(np.stack(places), self._forces)
        self._joints_below = [{joint.name for joint in urdf.path_to(link)} for link in bearers]
        self._torques: dict[str, Array] = {}
        if len(links) > 1:
            hit = np.linalg.norm(of_tip, axis=1) > _MOST_ACCELERATION
            judged: NDArray[np.bool_] = np.convolve(hit, np.ones(2 * _AFTER_A_HIT + 1), mode="same") == 0
        else:  # the two frames at either end have too few around them
            change = np.linalg.norm(np.diff(of_tip[1:-1], axis=0), axis=1)
            judged = np.zeros(len(of_tip), dtype=np.bool_)
            judged[2:-2] = np.maximum(change[:-1], change[1:]) < MAX_CHANGE
        self.is_judged = judged if free is None else judged & free

    def _acceleration(self, points: Sequence[Array]) -> Array:
        """(T, 3) m/s^2 of a point by its places in a frame and in the steps before, or in the frames around."""
        if len(points) > 1:
            return np.asarray((points[0] - 2 * points[1] + points[2]) / self._step_s**2)
        found = np.zeros_like(points[0])
        found[1:-1] = np.diff(points[0], 2, axis=0) / self._step_s**2
        return found

    def borne(self, joint: str) -> tuple[Array, Array]:
        """What a joint bears: (T, 3) N, and its (T, 3) N m about the origin."""
        below = [joint in joints for joints in self._joints_below]
        return self._forces[below].sum(axis=0), self._moments[below].sum(axis=0)

    def torque(self, name: str) -> Array:
        """(T,) N m of a joint's motor."""
        if name not in self._torques:
            joint, (force, moment) = self._joints[name], self.borne(name)
            pose = self._links(joint.child)
            axis = pose[:, :3, :3] @ np.array(joint.axis)
            self._torques[name] = (axis * (moment - np.cross(pose[:, :3, 3], force))).sum(axis=1)
        return self._torques[name]

    def _turning(self, joints: Sequence[str], effort: Array) -> Iterator[tuple[str, Array, Array]]:
        """(joint, its efforts, the torques that the motion needs) of those that turn, by efforts (T, n); "" is none."""
        for name, values in zip(joints, effort.T, strict=True):
            if name in self._joints and self._joints[name].kind != "prismatic" and np.isfinite(values).all():
                yield name, values, self.torque(name)

    def compare(self, joints: Sequence[str], effort: Array) -> Found:
        """Efforts (T, n) of some joints ("" for what is none) against the torques that the motion needs."""
        number = int(self.is_judged.sum())
        if number < MIN_FRAMES:
            return NotMeasured(why=f"the hand is free and moves smoothly in {number} frames, fewer than {MIN_FRAMES}")
        found = []
        for name, values, torque in self._turning(joints, effort):
            torque, values = torque[self.is_judged], values[self.is_judged]
            size = float(np.sqrt(np.median(torque**2)))
            off = float(np.median(values - torque))
            found.append(Measurement(value=abs(off) / max(size, LEAST_LOAD), detail=f"{name} is {off:+.2g} N m off"))
            if size >= MIN_LOAD:
                gain = float((values * torque).sum() / (torque**2).sum())
                found.append(Measurement(value=abs(gain - 1), detail=f"{name} gives {gain:.3g} of {size:.0f} N m"))
        return worst(*found) or NotMeasured(why="no joint of the arm is known")

    def lag_of(self, joints: Sequence[str], effort: Array, *, reach: int) -> float | None:
        """By how many frames, `reach` at most, efforts (T, n) run behind the torques that the motion needs.

        None where no joint's load changes much; 0 where no lag tells most of it and twice as well as none.
        """
        rows = np.flatnonzero(self.is_judged)
        rows = rows[(rows >= reach) & (rows < len(effort) - reach)]
        if len(rows) < max(MIN_FRAMES, 4 * reach):
            return None
        lags, errors, number = range(-reach, reach + 1), np.zeros(2 * reach + 1), 0
        for _, values, torque in self._turning(joints, effort):
            if (spread := float(torque[rows].std())) >= MIN_LOAD:
                errors += [float(((values[rows + lag] - torque[rows]) / spread).var()) for lag in lags]
                number += 1
        if not number:
            return None
        least = errors[1:-1].min()
        is_told = errors.min() == least <= _TOLD * number and errors[reach] > 2 * least
        return finest_lag(lags, errors.tolist()) if is_told else 0.0


def dynamics_by_frames(episode: CheckedEpisode) -> Dynamics | NotMeasured:
    """Of a robot with what its hand carries, accelerated as the frames tell."""
    is_free = np.ones(episode.columns.num_frames, dtype=np.bool_)
    return _dynamics(episode, [episode.world_from_link], is_free, 1 / episode.info.fps)


def dynamics_by_servo(episode: CheckedEpisode) -> Dynamics | NotMeasured:
    """The same by what the servo did in the physics steps before each frame, where it alone moved the arm."""
    c, info, n = episode.columns, episode.info, len(episode.info.robot.arm_joints)
    recorded = c.joint_position[:, :n], c.joint_velocity[:, :n], c.command_joint_target
    start, step_s = np.array(info.scene.robot.joint_position), 1 / info.physics_hz
    substeps = max(info.physics_hz // info.fps, 1)
    before, first, off = servo_steps(*recorded, start=start, substeps=substeps, step_s=step_s)
    hot = near_limit(c.joint_effort[:, :n], info.robot)
    is_free = ~hot
    is_free[1:-1] |= ~(hot[:-2] | hot[2:])  # a single frame may be a fault
    joints = [np.hstack([positions, c.joint_position[:, n:]]) for positions in (before, first)]
    links = [partial(episode.world_from_link, kinematics=episode.kinematics(positions)) for positions in joints]
    return _dynamics(episode, [episode.world_from_link, *links], is_free & (off < _SERVED), step_s)


def near_limit(effort: Array, robot: RobotSpec) -> NDArray[np.bool_]:
    """(T,) whether a motor of the arm gives so much, N m (T, n), that it may not have done what the servo asked for."""
    return np.asarray((np.abs(effort) >= _FREE * np.array(robot.torque_limit)).any(axis=1))


def _dynamics(
    episode: CheckedEpisode, links: Sequence[Links], is_free: NDArray[np.bool_], step_s: float
) -> Dynamics | NotMeasured:
    info, c = episode.info, episode.columns
    gravity, robot = np.array(info.scene.physics.gravity), info.robot
    if not gravity.any():
        return NotMeasured(why="there is no gravity")
    carried, free = [], c.contact_force == 0
    for body in info.scene.movable:
        is_carried = episode.is_carried(body.name, LIFTED_HEIGHT)
        carried.append((body.mass * is_carried.astype(np.float64), c.object_poses[body.name][:, :3]))
        free = free | is_carried
    scale = info.scene.robot.scale
    try:
        return Dynamics(
            links,
            episode.urdf,
            {name: (mass, scale * centre) for name, (mass, centre) in masses_of(robot.urdf).items()},
            gravity=gravity,
            step_s=step_s,
            tip=robot.tcp_link,
            carried=carried,
            free=free & is_free,
        )
    except (SceneError, KeyError) as error:
        return NotMeasured(why=f"the robot's masses are not to be had here: {error}")


def point_masses(motion: Motion) -> Dynamics | NotMeasured | None:
    """Inverse dynamics of an arm that stands upright and carries nothing; None where its model is not known."""
    if motion.urdf is None or not motion.model:
        return None
    try:
        masses = masses_of(motion.model)
    except SceneError as error:
        return NotMeasured(why=f"the robot's masses are not to be had here: {error}")
    links = LinkMatrices(motion.urdf, motion.joint_position, len(motion.state))
    there = {motion.urdf.root, *(joint.child for joint in motion.urdf.joints)}
    masses = {link: mass for link, mass in masses.items() if link in there}
    tip = [joint.child for joint in motion.urdf.depth_first() if joint.name in motion.joint_position][-1]
    down = np.array([0.0, 0.0, -9.81])
    return Dynamics([links.__getitem__], motion.urdf, masses, gravity=down, step_s=1 / motion.fps, tip=tip)


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
