"""Can a robot have moved like this: limits, kinematics, and the commands that are said to have caused it."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from demorec.check.base import (
    Found,
    Lacking,
    Measurement,
    NotMeasured,
    alignment_check,
    physics_check,
    worst,
    worst_entry,
    worst_frame,
)
from demorec.check.dataset import Recorded
from demorec.check.dynamics import MIN_FRAMES
from demorec.check.episode import CheckedEpisode
from demorec.check.motion import EVERYWHERE
from demorec.check.rows import displacement, matrices
from demorec.core.geometry import Array
from demorec.episode.episode import POLICY_PHASE
from demorec.episode.scene import POSITION_GAIN


@physics_check(
    measures="numbers that are NaN or infinite",
)
def finite_numbers(episode: CheckedEpisode) -> Measurement:
    """Every recorded number is one."""
    c = episode.columns
    tables = {
        "joint_position": c.joint_position,
        "joint_velocity": c.joint_velocity,
        "joint_effort": c.joint_effort,
        "gripper_width": c.gripper_width,
        "contact_force": c.contact_force,
        **c.sensed,
        "base_from_tcp": c.base_from_tcp,
        "action": np.column_stack([c.action_joint_target, c.action_gripper, c.action_base_from_tcp]),
        "command": np.column_stack([c.command_joint_target, c.command_gripper, c.command_base_from_tcp]),
        **{f"object {name}": poses for name, poses in c.object_poses.items()},
        **{f"camera {name}": poses for name, poses in c.world_from_camera.items()},
    }
    wrong = {name: ~np.isfinite(table).reshape(len(table), -1).all(axis=1) for name, table in tables.items()}
    total = int(sum(rows.sum() for rows in wrong.values()))
    first = next(((name, int(np.argmax(rows))) for name, rows in wrong.items() if rows.any()), ("", None))
    return Measurement(value=total, frame=first[1], detail=first[0])


_STANDS, _NEARLY_STANDS = 1e-6, 0.1
"""rad by which a target that stands differs from the one before; share of the speed before and after it at which it
nearly stands, as between two motions."""


@physics_check(
    measures="largest acceleration of the wanted motion in units of its limit",
)
def action_acceleration(episode: CheckedEpisode) -> Measurement | None:
    """The expert's joint targets (the labels) ask for no more than the motors give: it plans for 0.8 of their limits.

    A target that is the observed position stops the arm where it is, and asks for nothing; nor does the last one of a
    failure, which stays what it was.
    """
    c, fps, robot = episode.columns, episode.info.fps, episode.info.robot
    targets = c.action_joint_target
    stops = np.abs(targets - c.joint_position[:, : episode.num_arm]).max(axis=1) < _STANDS
    asked = ~(stops[2:] | stops[1:-1])
    if episode.outcome is not None and not episode.outcome.success and (targets[-1:] == targets[-2:-1]).all():
        asked[-1:] = False
    acceleration = np.abs(np.diff(targets, 2, axis=0)) * fps**2 * asked[:, None]
    return worst_entry(acceleration / np.array(robot.acceleration_limit), robot.arm_joints, first=1)


@physics_check(
    measures="largest acceleration of the measured motion in units of its limit",
)
def joint_acceleration(episode: CheckedEpisode) -> Measurement | None:
    """Steps of the recorded velocities.

    Looser than the limits of a real arm: exploration noise on the commands asks for several times as much.
    """
    velocity, robot = episode.columns.joint_velocity[:, : episode.num_arm], episode.info.robot
    acceleration = np.abs(np.diff(velocity, axis=0)) * episode.info.fps
    return worst_entry(acceleration / np.array(robot.acceleration_limit), robot.arm_joints, first=1)


_SLOW = 0.02
"""rad/s below which a joint's velocities say nothing."""

_AT_LIMIT = 0.99
"""Share of its torque from which on a motor does what it can, not what it is told."""
_MOST_LAG, _CLEAR = 3, 0.5
"""Frames by which velocities are shifted; below which share of what is off without a shift another fits better."""
_SCATTER = 0.2
"""By which the scatter of velocities counts beside their ratio to those of the servo."""


@physics_check(
    measures="EE pose against forward kinematics of the joints",
    unit="m",
    warn=1e-4,
    fail=1e-3,
    simulated=(1e-6, 1e-4),
    on=("simulated", "dataset"),
    needs="EE poses, and the robot and TCP link that demorec recorded",
)  # fmt: skip
def forward_kinematics(subject: Recorded) -> Iterator[Found]:
    """Observed, wanted and commanded TCP poses are those of their joints (0.1 m per rad of rotation added)."""
    is_known = False
    for where, poses, hand in subject.hand_poses():
        is_known = True
        yield worst_frame(displacement(matrices(poses), hand), where)
    if not is_known:
        yield Lacking(need="EE poses, and the robot and TCP link that demorec recorded")


@physics_check(
    on=EVERYWHERE,
    needs="quaternions, by the names of elements",
    measures="deviation of a quaternion's length from 1",
    warn=1e-3,
    fail=1e-2,
    simulated=(1e-6, 1e-3),
)
def unit_quaternions(subject: Recorded) -> Iterator[Found]:
    """Every rotation is one."""
    for name, table in subject.quaternions():
        yield worst_frame(np.abs(np.linalg.norm(table, axis=1) - 1.0), name)


@physics_check(
    on=("external", "dataset"),
    needs="quaternions, by the names of elements",
    measures="episodes in which a quaternion jumps to its own negative",
    warn=0,
    fail=math.inf,
)
def quaternions_keep_sign(subject: Recorded) -> Found:
    """No quaternion changes its sign from one frame to the next: the rotation is the same, but a policy sees a jump.

    Where one element is never negative it chooses the sign, and a jump is where it is zero.
    """
    tables = list(subject.quaternions())
    if not tables:
        return None
    wrong = []
    for name, table in tables:
        jumps = 1 + np.flatnonzero((table[1:] * table[:-1]).sum(axis=1) < 0)
        if len(jumps) and not (table >= 0).all(axis=0).any():
            wrong.append((name, int(jumps[0])))
    name, frame = wrong[0] if wrong else ("", None)
    return Measurement(value=len(wrong), frame=frame, detail=name)


@physics_check(
    measures="gripper opening against its fingers and its range",
    unit="m",
    warn=1e-6,
    fail=2e-3,
)
def gripper_width(episode: CheckedEpisode) -> Iterator[Found]:
    """The opening is that of the finger joints and lies, as its target does, within 0 and the full opening.

    A millimetre of overshoot is allowed: the fingers have mass.
    """
    c, robot = episode.columns, episode.info.robot
    fingers = robot.gripper.width(c.joint_position[:, episode.num_arm :])
    yield worst_frame(np.abs(c.gripper_width - fingers), "against the fingers")
    widths = (("", c.gripper_width), (" of the action", c.action_gripper), (" of the command", c.command_gripper))
    for whose, width in widths:
        beyond = np.maximum(-width, width - robot.gripper.max_width)
        yield worst_frame(np.maximum(beyond - 1e-3, 0.0), f"range{whose}")


@physics_check(
    measures="distance of the joints from the command before",
    unit="rad",
)
def command_tracking(episode: CheckedEpisode) -> Measurement | None:
    """The arm goes where it is sent, rad, unless a motor is at its limit: catches commands of another episode, of
    another joint, or made up."""
    c, (is_free, _) = episode.columns, episode.shared(_by_servo)
    off = np.abs(c.joint_position[1:, : episode.num_arm] - c.command_joint_target[:-1])
    return worst_entry(np.where(is_free, off, 0.0), episode.info.robot.arm_joints, first=1)


@physics_check(
    measures="distance between action and executed command",
    unit="rad",
)
def action_matches_command(episode: CheckedEpisode) -> Measurement | None:
    """The label differs from what was executed by exploration noise at most, rad."""
    c = episode.columns
    return worst_entry(np.abs(c.action_joint_target - c.command_joint_target), episode.info.robot.arm_joints)


@physics_check(
    measures="share of frames in which nothing moves and nothing is asked",
)
def idle_frames(episode: CheckedEpisode) -> Measurement | None:
    """A policy that learns from idle frames learns to stand still."""
    c, n = episode.columns, episode.num_arm
    if c.num_frames < 2:
        return None
    still = np.abs(np.diff(c.action_joint_target, axis=0)).max(axis=1) < 1e-4
    still &= np.abs(np.diff(c.action_gripper)) < 1e-4
    still &= np.abs(c.joint_velocity[1:, :n]).max(axis=1) < 0.02
    still &= np.abs(c.joint_velocity[1:, n:]).max(axis=1, initial=0.0) < 2e-3
    frame = int(np.argmax(still)) + 1 if still.any() else None
    return Measurement(value=float(still.mean()), frame=frame, detail=f"{int(still.sum())} of {len(still)} frames")


@physics_check(
    measures="largest speed of a joint in the first frame in units of its limit",
)
def starts_at_rest(episode: CheckedEpisode) -> Measurement | None:
    """The first frame is the scene's start, before any command: catches frames cut off at the head."""
    robot, n = episode.info.robot, episode.num_arm
    return worst_entry(
        np.abs(episode.columns.joint_velocity[:1, :n]) / np.array(robot.velocity_limit), robot.arm_joints
    )


@physics_check(
    measures="speed at the end of the last wanted motion times its length, against the joints' accelerations, at 30 "
    "frames a second",
    unit="s^2",
)
def ends_at_rest(episode: CheckedEpisode) -> Found:
    """The script of a success ends where its last motion does: catches frames cut off at the tail.

    Motions are of least jerk: over the way D in the time T the last step is 10 D (dt/T)^3, the largest acceleration
    5.77 D/T^2. That is 0.8 of the joint's limit at most: 0.00154 s^2 of a whole motion, whatever its length.
    """
    c, fps = episode.columns, episode.info.fps
    if episode.outcome is None or not episode.outcome.success or c.num_frames < 2:
        return None
    if POLICY_PHASE in c.phase:
        return NotMeasured(why="a policy may succeed in mid-motion")
    steps, robot = np.abs(np.diff(c.action_joint_target, axis=0)), episode.info.robot
    # A motion begins where the last one stood, or nearly did, or where its phase begins.
    speed = steps.max(axis=1)
    begins = (speed < _STANDS) | (np.array(c.phase[1:]) != np.array(c.phase[:-1]))
    around = np.minimum(np.maximum.accumulate(speed), np.maximum.accumulate(speed[::-1])[::-1])
    begins[1:-1] |= (speed[1:-1] <= np.minimum(speed[:-2], speed[2:])) & (speed[1:-1] < _NEARLY_STANDS * around[1:-1])
    begins[0] = True
    length = (len(steps) - 1 - np.flatnonzero(begins)[-1]) / fps
    last = steps[-1:] * fps * (fps / 30) ** 2 / np.array(robot.acceleration_limit)
    return worst_entry(last * length, robot.arm_joints, first=c.num_frames - 1)


def _by_servo(episode: CheckedEpisode) -> tuple[NDArray[np.bool_], Array]:
    """(T - 1, n) of frames 1 on: whether a motor is below its limit, and the velocities that the servo gives, rad/s.

    It takes a joint by a fixed share of what is left to its target in each physics step.
    """
    c, info, n = episode.columns, episode.info, episode.num_arm
    is_free = np.abs(c.joint_effort[1:, :n]) < _AT_LIMIT * np.array(info.robot.torque_limit)
    left = c.command_joint_target[:-1] - c.joint_position[1:, :n]
    return is_free, left * (info.physics_hz * POSITION_GAIN / (1 - POSITION_GAIN))


@alignment_check(
    measures="frames by which velocities are off those that the servo's distance from its target gives",
)
def velocity_lag(episode: CheckedEpisode) -> Found:
    """Velocities are those of their frames: no shift fits the servo's better, of all joints together."""
    is_free, due = episode.shared(_by_servo)
    velocity, core = episode.columns.joint_velocity[1:, : episode.num_arm], slice(_MOST_LAG, -_MOST_LAG)
    counts = (is_free & (np.abs(due) > _SLOW))[core]
    if counts.sum() < MIN_FRAMES:
        return NotMeasured(why="no joint moves for long")
    off = {
        lag: float(((np.roll(velocity, -lag, axis=0) - due)[core][counts] ** 2).sum())
        for lag in range(-_MOST_LAG, _MOST_LAG + 1)
    }
    lag = min(off, key=off.__getitem__)
    if off[lag] >= _CLEAR * off[0]:
        lag = 0
    return Measurement(value=abs(lag), detail=f"{lag:+d} frames")


@physics_check(
    measures="velocity of a joint against that which the servo's distance from its target gives, ratio off 1, or a "
    "fifth of its scatter",
)
def velocity_follows_servo(episode: CheckedEpisode) -> Found:
    """What is left to the servo's target in a frame gives the velocity in it, unless the motor is at its limit: catches
    velocities a few per cent off, or of another joint."""
    c, info = episode.columns, episode.info
    is_free, expected = episode.shared(_by_servo)
    found: list[Found] = []
    for joint, name in enumerate(info.robot.arm_joints):
        rows = is_free[:, joint] & (np.abs(expected[:, joint]) > _SLOW)
        if rows.sum() >= MIN_FRAMES:
            seen, due = c.joint_velocity[1:, joint][rows], expected[rows, joint]
            # What pushes the joint adds to slow motions and hardly to fast ones; false velocities are so in both.
            usual, fast = np.median(np.abs(seen / due - 1)), np.abs(seen - due).sum() / np.abs(due).sum()
            # What noise does to and fro cancels in a ratio; elsewhere the scatter shows it.
            ratio, gain = abs(np.median(seen / due) - 1), abs((seen * due).sum() / (due * due).sum() - 1)
            value = float(max(min(ratio, gain), _SCATTER * min(usual, fast)))
            found.append(Measurement(value=value, detail=f"{name}, {int(rows.sum())} frames"))
    return worst(*found) or NotMeasured(why="no joint moves for long")
