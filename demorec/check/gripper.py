"""Does the gripper follow its command, and does the command agree with the label."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from demorec.check.base import Found, Measurement, NotMeasured, alignment_check, physics_check, worst_entry, worst_frame
from demorec.check.episode import CheckedEpisode
from demorec.check.objects import top_of
from demorec.check.rows import held_for

CARRIED_HEIGHT = 0.03
"""Metres above its start from which on an object counts as carried."""
_FIRST = 9
"""Frames after the first of a way."""
_OPENS = 0.6
"""Of its opening, a second: fingers that open faster are on their way."""
_BESIDE_MOTORS = 1.1
"""Times the force of their motors with which fingers press that open onto something: their motion ends there, too."""
_MOST_LAG = 4
"""Frames up to which contact force and fingers are shifted against each other."""
_PRESSES, _APART, _STANDS = 0.25, 0.02, 0.15
"""Share of the usual force from which on fingers press, of the opening that keeps them from where they were sent, and
of it a second below which they stand."""


@alignment_check(
    measures="gripper opening of the label against that of the executed command",
    unit="m",
    warn=1e-6,
    fail=2e-3,
)
def gripper_label(episode: CheckedEpisode) -> Measurement | None:
    """Exploration noise is on the arm alone: the label asks for the opening that was sent."""
    c = episode.columns
    return worst_frame(np.abs(c.action_gripper - c.command_gripper))


@physics_check(
    measures="contact force on a carried object against that of the gripper's motors, off 1",
)
def grip_force(episode: CheckedEpisode) -> Found:
    """Two fingers that hold something press on it with the force of their motors, each of them.

    The median over the first frames in which an object is carried: catches another unit, half the sum, a frozen value.
    When the hand turns, what PyBullet reports of the fingers' force goes down by up to a third.
    """
    scene, robot = episode.info.scene, episode.info.robot
    if not scene.movable:
        return None
    if scene.hold != "friction":
        return NotMeasured(why="what is carried is held by a constraint")
    carried = np.any([episode.is_carried(body.name, CARRIED_HEIGHT) for body in scene.movable], axis=0)
    if carried.sum() < 10:
        return NotMeasured(why="nothing is carried for ten frames")
    carried &= held_for(carried & ~np.insert(carried[:-1], 0, False), _FIRST)
    expected = float(np.median(robot.gripper.contact_force(episode.columns.gripper_width[carried])))
    force = float(np.median(episode.columns.contact_force[carried]))
    frame = int(np.argmax(carried))
    return Measurement(
        value=abs(force / expected - 1), frame=frame, detail=f"{force:.1f} N, the motors give {expected:.3g} N"
    )


@alignment_check(
    measures="frames by which the contact force is off the fingers' stop at what is between them",
    warn=1.0,
    fail=1.5,
)
def contact_lag(episode: CheckedEpisode) -> Found:
    """Fingers press from where something stops them to where they open again: catches forces that are late or early.

    Of all shifts of the force those count at which it is there in the frames in which the fingers stand apart from
    where they were sent; of several the middle one. In which of two frames they stop, frames do not tell.
    """
    c, fps = episode.columns, episode.info.fps
    span = episode.info.robot.gripper.open_width
    if c.num_frames < 4 * _MOST_LAG or not (c.contact_force > 0).any():
        return NotMeasured(why="nothing is taken or let go of")
    presses = c.contact_force > _PRESSES * np.median(c.contact_force[c.contact_force > 0])
    sent = np.concatenate([c.command_gripper[:1], c.command_gripper[:-1]])
    stands = np.abs(np.gradient(c.gripper_width)) * fps < _STANDS * span
    stopped = stands & (c.gripper_width - sent > _APART * span)
    core = slice(_MOST_LAG, -_MOST_LAG)
    edges = int((presses[core][1:] != presses[core][:-1]).sum())
    if edges < 2:  # a single one may be early or late by its own
        return NotMeasured(why="nothing is taken and let go of")
    lags = np.arange(-_MOST_LAG, _MOST_LAG + 1)
    off = np.array([int((np.roll(presses, -lag)[core] != stopped[core]).sum()) for lag in lags])
    if off.min() > 2 * edges:
        return NotMeasured(why="the fingers press without being stopped")
    lag = float(lags[off == off.min()].mean())
    return Measurement(value=abs(lag), detail=f"{lag:+.1f} frames, taken and let go of {edges} times")


@physics_check(
    measures="contact force while there is nothing within reach, or of fingers that open, beyond that of their motors",
    unit="N",
)
def touches_nothing(episode: CheckedEpisode) -> Iterator[Found]:
    """Fingers far above all supports and away from all objects touch nothing but each other; and they press on nothing
    while they open, but with what force their motors have for it."""
    yield _pressed_while_opening(episode)
    c, scene = episode.columns, episode.info.scene
    tcp = episode.world_from_tcp[:, :3, 3]
    alone = tcp[:, 2] > max((top_of(body) for body in scene.fixed if body.collides), default=-math.inf) + 0.06
    for body in scene.movable:
        reach = math.hypot(*body.shape.extents) / 2 + 0.08
        alone &= np.linalg.norm(c.object_poses[body.name][:, :3] - tcp, axis=1) > reach
    # Closed fingers press on each other.
    alone &= c.gripper_width > episode.info.robot.gripper.min_width + 0.005
    if alone.any():
        yield worst_frame(np.where(alone, np.abs(c.contact_force), 0.0), f"{int(alone.sum())} frames alone")


def _pressed_while_opening(episode: CheckedEpisode) -> Found:
    c, robot = episode.columns, episode.info.robot
    if not (presses := c.contact_force > 0).any():
        return None
    motors = np.abs(c.joint_effort[:, episode.num_arm :]).sum(axis=1)
    at_work = float(np.median(motors[presses]))
    speed = np.diff(c.gripper_width, prepend=c.gripper_width[:1]) * episode.info.fps
    usual = _BESIDE_MOTORS * float(np.median(c.contact_force[presses]))
    allowed = usual * motors / at_work if at_work else np.full(len(motors), np.inf)
    beyond = np.where(speed > _OPENS * robot.gripper.open_width, c.contact_force - allowed, 0.0)
    return worst_frame(np.maximum(beyond, 0.0), "while the fingers open")


@physics_check(
    measures="largest motor torque or finger force in units of its limit",
    warn=1.001,
    fail=1.05,
)
def joint_effort(episode: CheckedEpisode) -> Measurement | None:
    """No motor gives more than it can; a gripper that presses gives all that it has."""
    c, n, robot = episode.columns, episode.num_arm, episode.info.robot
    limit = np.array([*robot.torque_limit, *[robot.gripper.force] * (len(robot.joint_names) - n)])
    return worst_entry(np.abs(c.joint_effort) / limit, robot.joint_names)
