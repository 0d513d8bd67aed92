"""Are forces those that the motion needs: efforts and wrench against inverse dynamics, and streams that stand still.

The model's masses, each at its link's centre of mass, accelerated as the recorded joints say, give the torque of every
arm joint and the force on the hand (Newton and d'Alembert, without the links' own rotational inertia). What is carried
adds its weight. That is exact enough where nothing is hit and the motion is smooth: the medians are told.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from demorec.check.base import Found, Measurement, NotMeasured, physics_check, worst
from demorec.check.episode import CheckedEpisode
from demorec.check.rows import longest_run
from demorec.core.errors import SceneError, as_reason
from demorec.core.geometry import Array
from demorec.robots.assets import asset_path
from demorec.robots.inertials import link_masses

MIN_LOAD = 3.0
"""N m: joints that bear less, root mean square, say nothing about efforts."""
MIN_FRAMES = 20
LIFTED_HEIGHT = 0.01
"""Metres above its start from which on the arm bears an object in the hand."""
MAX_CHANGE = 2.0
"""m/s^2: where the TCP's acceleration changes by more from one frame to the next, the frames do not tell what it is at
one of them (noise on the commands shakes the arm within a frame). This leaves a fifth of gravity unknown at most."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Load:
    """A mass with its way: `point` (T, 3) metres, `force` (T, 3) N that it needs, and the links that carry it."""

    point: Array
    force: Array
    joints: frozenset[str]


class _Dynamics:
    """Inverse dynamics of a recorded episode with point masses.

    Raises:
        SceneError: The robot's model is not to be had.
    """

    def __init__(self, episode: CheckedEpisode) -> None:
        self.episode = episode
        self.loads = [*self._link_loads(), *self._carried_loads()]

    def _link_loads(self) -> list[_Load]:
        episode = self.episode
        scale, found = episode.info.scene.robot.scale, []
        gravity = np.array(episode.info.scene.physics.gravity)
        for name, (mass, centre) in _inertials(episode.info.robot.urdf).items():
            pose = episode.world_from_link(name)
            point = pose[:, :3, :3] @ (scale * centre) + pose[:, :3, 3]
            acceleration = np.zeros_like(point)
            acceleration[1:-1] = (point[2:] - 2 * point[1:-1] + point[:-2]) * episode.info.fps**2
            joints = frozenset(joint.name for joint in episode.urdf.path_to(name))
            found.append(_Load(point=point, force=mass * (acceleration - gravity), joints=joints))
        return found

    def _carried_loads(self) -> list[_Load]:
        episode = self.episode
        gravity = np.array(episode.info.scene.physics.gravity)
        joints = frozenset(joint.name for joint in episode.urdf.path_to(episode.info.robot.tcp_link))
        found = []
        for body in episode.info.scene.movable:
            point = episode.columns.object_poses[body.name][:, :3]
            force: Array = episode.is_carried(body.name, LIFTED_HEIGHT)[:, None] * (-body.mass * gravity)
            found.append(_Load(point=point, force=force, joints=joints))
        return found

    @cached_property
    def is_judged(self) -> NDArray[np.bool_]:
        """(T,) frames whose forces are known: the hand touches nothing but what it carries, and moves smoothly.

        Its acceleration is told by the frames around; the two frames at either end have too few.
        """
        c = self.episode.columns
        free = c.contact_force == 0
        for name in c.object_poses:
            free = free | self.episode.is_carried(name, LIFTED_HEIGHT)
        point = self.episode.world_from_tcp[:, :3, 3]
        acceleration = np.diff(point, 2, axis=0) * self.episode.info.fps**2
        change = np.linalg.norm(np.diff(acceleration, axis=0), axis=1)
        smooth = np.zeros(len(point), dtype=np.bool_)
        smooth[2:-2] = np.maximum(change[:-1], change[1:]) < MAX_CHANGE
        return np.asarray(free & smooth)

    def below(self, joint: str) -> list[_Load]:
        """What a joint bears."""
        return [load for load in self.loads if joint in load.joints]


def _inertials(urdf: str) -> dict[str, tuple[float, Array]]:
    """Link -> mass, kg, and centre of mass in the link's frame, metres."""
    try:
        return link_masses(asset_path(urdf).read_text())
    except (OSError, ValueError) as error:
        raise SceneError(as_reason(error)) from error


@physics_check(
    measures="arm torques against inverse dynamics, median difference of the load",
    reads=("/joint_states", "info.scene.physics.gravity", "info.scene.bodies.mass", "/robot_description"),
)
def effort_bears_the_arm(episode: CheckedEpisode) -> Found:
    """The motors of the joints that bear the arm give the torques that its weight and motion need.

    Catches torques of other joints, of another sign or unit, halved or frozen.
    """
    dynamics = episode.shared(_dynamics)
    if isinstance(dynamics, NotMeasured):
        return dynamics
    judged, found = dynamics.is_judged, []
    for number, name in enumerate(episode.info.robot.arm_joints):
        joint = next(joint for joint in episode.urdf.joints if joint.name == name)
        pose = episode.world_from_link(joint.child)
        axis = pose[:, :3, :3] @ np.array(joint.axis)
        arms = [np.cross(load.point - pose[:, :3, 3], load.force) for load in dynamics.below(name)]
        torque = (axis * np.sum(arms, axis=0)).sum(axis=1)[judged]
        size = float(np.sqrt(np.median(torque**2)))
        if size >= MIN_LOAD:
            off = float(np.median(np.abs(episode.columns.joint_effort[judged, number] - torque))) / size
            found.append(Measurement(value=off, detail=f"{name}, which bears {size:.0f} N m"))
    return worst(*found) or NotMeasured(why="no joint of the arm bears a load")


@physics_check(
    measures="force on the hand against the weight and motion of what it bears, median difference of it",
    reads=("/wrench", "info.scene.physics.gravity", "info.scene.bodies.mass", "/robot_description"),
)
def wrench_bears_the_hand(episode: CheckedEpisode) -> Found:
    """The arm holds the hand, and what it carries, with the force that their masses need: catches other units."""
    wrench = episode.columns.wrench
    if wrench is None:
        return None
    dynamics = episode.shared(_dynamics)
    if isinstance(dynamics, NotMeasured):
        return dynamics
    link = episode.info.robot.hand_link
    mount = episode.urdf.path_to(link)[-1].name
    force = np.sum([load.force for load in dynamics.below(mount)], axis=0)
    turned = np.einsum("tji,tj->ti", episode.world_from_link(link)[:, :3, :3], force)
    off = np.linalg.norm(wrench[:, :3] - turned, axis=1) / np.maximum(np.linalg.norm(turned, axis=1), 1e-6)
    judged = off[dynamics.is_judged]
    return Measurement(value=float(np.median(judged)), detail=f"{len(judged)} frames")


def _dynamics(episode: CheckedEpisode) -> _Dynamics | NotMeasured:
    if not any(episode.info.scene.physics.gravity):
        return NotMeasured(why="there is no gravity")
    try:
        dynamics = _Dynamics(episode)
    except (SceneError, KeyError) as error:
        return NotMeasured(why=f"the robot's masses are not to be had here: {error}")
    number = int(dynamics.is_judged.sum())
    if number < MIN_FRAMES:
        return NotMeasured(why=f"the hand is free and moves smoothly in {number} frames, fewer than {MIN_FRAMES}")
    return dynamics


@physics_check(
    measures="longest run of frames in which a sensor stands still to the last bit while the arm moves",
    warn=2,
    fail=4,
    reads=("/joint_states", "/ee_pose", "/wrench"),
)
def stuck_sensors(episode: CheckedEpisode) -> Iterator[Found]:
    """What is measured changes, if ever so little, while the arm moves."""
    c, n = episode.columns, episode.num_arm
    moves = np.abs(np.diff(c.joint_position[:, :n], axis=0)).max(axis=1, initial=0.0) > 1e-5
    tables = {"joint velocities": c.joint_velocity, "efforts": c.joint_effort[:, :n], "EE pose": c.base_from_tcp}
    if c.wrench is not None:
        tables["wrench"] = c.wrench
    for name, table in tables.items():
        length, start = longest_run((table[1:] == table[:-1]).all(axis=1) & moves)
        yield Measurement(value=length, frame=start + 1 if length else None, detail=name)
