"""Does the wrench at the hand's joint tell of the same load as the masses below it and the motors above it."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

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
    worst_frame,
)
from demorec.check.dynamics import (
    LIFTED_HEIGHT,
    MIN_FRAMES,
    MIN_LOAD,
    Dynamics,
    dynamics_by_frames,
    dynamics_by_servo,
    near_limit,
)
from demorec.check.episode import CheckedEpisode
from demorec.check.gripper import CARRIED_HEIGHT
from demorec.core.geometry import Array

_LEVER = 0.2
"""Metres at which a torque counts as much as a force."""
_GRIP = {"prismatic": 0.25, "revolute": 0.5}
"""Of the force with which fingers of a kind of joint hold something, which counts beside the weight: the wrench is what
is left of forces that cancel. After a turn of the hand PyBullet tells up to a fortieth of them as force (0.95 N of
40 N), of a jaw that turns a 26th (0.21 N of 5.5 N), and for
a second now and then a seventh (0.71 N of 5.3 N)."""
_LEAST_TORQUE = 0.018
"""N m below which nothing is said: motors of wrists that bear less differ from the wrench by up to 0.0089 N m (of 1,680
clean episodes of seed 51000, all tasks, two arms, 10 to 60 frames a second), half of this."""
_STOP = 2e-3
"""Radians before its limit at which a joint is at its stop."""
_STEADY = 5
"""Frames whose median torque is that of the weight alone."""
_OFTEN, _OWN_INERTIA = 0.9, 0.15
"""Share of the frames by whose worst efforts are judged; of a motor's peak that its links' own inertia may make."""
_SHAKEN = 7
"""Times what noise shakes a joint, the least unit of its efforts: of that the links' own inertia, which is left out,
makes up to 0.86 in a tenth of the frames and 2.07 in single ones (third joint of a Panda)."""
_AROUND = 6
"""Frames before and after a peak of the contact force in which it must be the only one."""
_MOVES = 0.3
"""Of the hand's opening, a second, from which on its fingers move."""
_FEWEST_FRAMES = 3
_LOST_SHARE = 0.5
"""Of the frames in which nothing is measured: more is a sensor that is not there, or an arm without weight."""
_FRAMES_A_SECOND = 20
"""Below which only the last motor tells a lag: what noise does to the links before it is over between two frames."""
_MOST_LAG, _CLEAR, _UNCLEAR = 3, 0.25, 0.5
"""Frames up to which wrench and motors are shifted against each other; below which share of the usual shift's squares
the best shift's is clear, and above which none fits: good recordings have 0.03, of arms of few joints 0.31."""


def _motors(episode: CheckedEpisode) -> list[str]:
    """Joints of the arm, but for one that the hand is on itself: its motor's torque is no load of it."""
    return [name for name in episode.info.robot.arm_joints if name != _mount(episode)]


class _Hand(NamedTuple):
    """The recorded wrench and what there is to compare it with.

    Attributes:
        force, torque: (T, 3) N and N m about the hand's joint, as recorded, along the axes of the world.
        loads_force, loads_torque: (T, 3) what the masses below need, in the same way.
        origin: (T, 3) metres, the hand's joint.
        rotation: (T, 3, 3) of the hand.
        dynamics: Of the arm.
    """

    force: Array
    torque: Array
    loads_force: Array
    loads_torque: Array
    origin: Array
    rotation: Array
    dynamics: Dynamics


def _mount(episode: CheckedEpisode) -> str:
    return episode.urdf.path_to(episode.info.robot.hand_link)[-1].name


def _hand(episode: CheckedEpisode) -> _Hand | NotMeasured | Lacking:
    wrench, dynamics = episode.columns.sensed.get("wrench"), episode.shared(dynamics_by_frames)
    if wrench is None:
        return Lacking(need="a wrench on the hand")
    if isinstance(dynamics, NotMeasured):
        return dynamics
    pose = episode.world_from_link(episode.info.robot.hand_link)
    rotation, origin = pose[:, :3, :3], pose[:, :3, 3]
    force, moment = dynamics.borne(_mount(episode))
    return _Hand(
        dynamics=dynamics,
        force=np.einsum("tij,tj->ti", rotation, wrench[:, :3]),
        torque=np.einsum("tij,tj->ti", rotation, wrench[:, 3:]),
        loads_force=force,
        loads_torque=moment - np.cross(origin, force),
        origin=origin,
        rotation=rotation,
    )


@physics_check(
    measures="force and torque on the hand against the weight and motion of what it bears, median difference of it",
)
def wrench_bears_the_hand(episode: CheckedEpisode) -> Found:
    """The arm holds the hand, and what it carries, with the force that their masses need: catches other units, axes,
    gains and an offset. The difference is a median along each axis of the hand, in which what shakes the arm cancels.
    """
    hand = episode.shared(_hand)
    if not isinstance(hand, _Hand):
        return hand
    free, c = hand.dynamics.is_judged, episode.columns
    if episode.info.scene.hold != "friction":
        free = free & (c.contact_force == 0)  # a constraint that holds an object is no load of the hand's joint
    lifted = {name: free & episode.is_carried(name, LIFTED_HEIGHT) for name in c.object_poses}
    empty = free & ~np.any([*lifted.values(), np.zeros_like(free)], axis=0)
    grips = {"nothing": empty, **lifted}
    pressed, is_jaw = _left_of_grip(episode), episode.info.robot.gripper.joint_kind != "prismatic"
    found = []
    for what, rows in grips.items():
        if rows.sum() >= MIN_FRAMES:  # of a jaw the better half of the time: what is left of its force comes and goes
            halves = np.array_split(np.flatnonzero(rows), 2 if is_jaw and what != "nothing" else 1)
            found.append(min((_unborne(hand, half, pressed[half], what) for half in halves), key=lambda one: one.value))
    return worst(*found) or NotMeasured(why=f"the hand is free and moves smoothly in fewer than {MIN_FRAMES} frames")


def _left_of_grip(episode: CheckedEpisode) -> Array:
    """(T,) N of the fingers' force that count beside the weight; of an unknown kind of joint as of one that turns."""
    share = _GRIP.get(episode.info.robot.gripper.joint_kind, _GRIP["revolute"])
    return np.asarray(share * episode.columns.contact_force)


def _unborne(hand: _Hand, rows: NDArray[np.intp], grip: Array, what: str) -> Measurement:
    """What force and torque differ by in some frames, in units of the weight that is borne, and of the grip's share."""
    weight = math.hypot(float(np.median(np.linalg.norm(hand.loads_force[rows], axis=1))), float(np.median(grip)))
    off = np.hstack([hand.force - hand.loads_force, (hand.torque - hand.loads_torque) / _LEVER])[rows]
    along = np.einsum("tji,tkj->tki", hand.rotation[rows], off.reshape(-1, 2, 3))
    force, torque = np.linalg.norm(np.median(along, axis=0), axis=1) / weight
    is_force = force >= torque
    return Measurement(
        value=float(max(force, torque)),
        detail=f"{'force' if is_force else 'torque'} while {what} is held, {len(rows)} frames",
    )


@physics_check(
    measures="torque of the wrist's motor against that of the wrench about its axis, root mean square difference of it",
)
def wrench_turns_the_wrist(episode: CheckedEpisode) -> Found:
    """The last motor of the arm gives what the wrench asks for about its axis, in every frame, contacts included:
    catches torques of the wrench that are zero, inverted, late, filtered or in another unit, and such efforts."""
    hand = episode.shared(_hand)
    if not isinstance(hand, _Hand):
        return hand
    needed, effort = _of_joint(episode, hand, _motors(episode)[-1])
    if len(needed) < MIN_FRAMES or max(np.abs(needed).max(), np.abs(effort).max()) < _LEAST_TORQUE:
        return NotMeasured(why="the last motor has nothing to turn")
    size = max(float((effort**2).mean()), _LEAST_TORQUE**2)
    return Measurement(value=math.sqrt(float(((effort - needed) ** 2).mean()) / size), detail=f"{len(needed)} frames")


@alignment_check(
    measures="frames by which the wrench is off the torque of the wrist's motors",
)
def wrench_lag(episode: CheckedEpisode) -> Found:
    """Wrench and efforts are of one instant: of all shifts against each other none fits the last motors best. Where no
    shift fits clearly, one of the two was filtered, or they do not belong together.

    Of the last two motors those count that tell the shift clearly, and at few frames a second only the last one: noise
    moves what is between the other and the hand in a way that frames do not show.
    """
    hand = episode.shared(_hand)
    if not isinstance(hand, _Hand):
        return hand
    if episode.info.scene.hold != "friction":
        return NotMeasured(why="what is carried is held by a constraint")
    if episode.num_arm < 2 or episode.num_frames < MIN_FRAMES + 2 * _MOST_LAG:
        return NotMeasured(why="there are too few joints or frames")
    lags, core = range(-_MOST_LAG, _MOST_LAG + 1), slice(_MOST_LAG, -_MOST_LAG)
    share = size = 0.0
    found = []
    for name in _motors(episode)[-2 if episode.info.fps >= _FRAMES_A_SECOND else -1 :]:
        needed, effort = _of_joint(episode, hand, name)
        off = np.array([float(((np.roll(effort, -lag) - needed)[core] ** 2).mean()) for lag in lags])
        size, usual = float(np.sqrt((effort**2).mean())), float(np.median(off))
        share, lag = float(off.min()) / max(usual, 1e-12), lags[int(np.argmin(off))]
        if share < _CLEAR:
            found.append(Measurement(value=abs(lag), detail=f"{lag:+d} frames by {name}"))
    if not found and share > _UNCLEAR and size > _LEAST_TORQUE / 2:  # nothing but the hand is beyond the last motor
        return Measurement(value=_MOST_LAG + 1, detail=f"no shift fits {name}")
    return worst(*found) or NotMeasured(why="the wrist's motors do not tell one shift from another")


@physics_check(
    measures="torques of the joints that bear the arm against those that the servo's motion needs, difference that a "
    "tenth of the frames exceed, of the usual torque",
)
def effort_in_each_frame(episode: CheckedEpisode) -> Found:
    """The motors give in each frame what the arm's weight and its acceleration in that frame need, also where noise
    shakes it: catches torques that are late, filtered or made up. The links' own inertia is left out."""
    servo, found = episode.shared(_servo), list[Found]()
    if isinstance(servo, NotMeasured):
        return servo
    rows = servo.dynamics.is_judged
    for index in np.flatnonzero(servo.is_loaded):
        off = np.abs(episode.columns.joint_effort[rows, index] - servo.torque[rows, index])
        share = float(np.quantile(off, _OFTEN) / max(servo.usual[index], _SHAKEN * servo.shaken[index]))
        found.append(
            Measurement(value=share, detail=f"{episode.info.robot.arm_joints[index]}, {int(rows.sum())} frames")
        )
    return worst(*found) or NotMeasured(why="no joint bears the arm")


class _Servo(NamedTuple):
    """What the arm's n motors need to give, by what the servo did in the steps before each frame.

    Attributes:
        torque: (T, n) N m.
        usual: (n,) N m, root mean square over the frames that are judged.
        shaken: (n,) N m, root mean square of what is left of it beside its slow part: what noise shakes.
        is_loaded: (n,) whether the weight that the joint bears is more than noise shakes it.
        dynamics: Which frames are judged; of the hand.
    """

    torque: Array
    usual: Array
    shaken: Array
    is_loaded: NDArray[np.bool_]
    dynamics: Dynamics


def _servo(episode: CheckedEpisode) -> _Servo | NotMeasured:
    dynamics = dynamics_by_servo(episode)
    if isinstance(dynamics, NotMeasured):
        return dynamics
    rows = dynamics.is_judged
    if rows.sum() < MIN_FRAMES:
        return NotMeasured(why=f"the servo alone moves the free hand in {int(rows.sum())} frames")
    torque = np.stack([dynamics.torque(name) for name in episode.info.robot.arm_joints], axis=1)
    padded = np.pad(torque, ((_STEADY // 2, _STEADY // 2), (0, 0)), mode="edge")
    steady = np.median(np.lib.stride_tricks.sliding_window_view(padded, _STEADY, axis=0)[rows], axis=2)
    shaken = np.sqrt(((torque[rows] - steady) ** 2).mean(axis=0))
    return _Servo(
        torque=torque,
        usual=np.sqrt((torque[rows] ** 2).mean(axis=0)),
        shaken=shaken,
        is_loaded=np.median(np.abs(steady), axis=0) >= np.maximum(MIN_LOAD, shaken),
        dynamics=dynamics,
    )


@physics_check(
    measures="peak of a single frame in wrench or efforts that the other does not show, or of the force on what is "
    "carried, in units of what is borne",
)
def force_spikes(episode: CheckedEpisode) -> Iterator[Found]:
    """No single frame is far from both of its neighbours, or empty: catches lost values and glitches of an amplifier.

    Wrench and efforts are those that the servo's motion needs, in each frame in which it alone moves the free hand and
    its fingers stay; of the motors those count that bear weight. The force on what is carried is that of the gripper's
    motors in each frame.
    """
    if episode.num_frames < _FEWEST_FRAMES:
        yield NotMeasured(why="no frame has neighbours")
        return
    yield from _peaks_of_grip(episode)
    for name, table in (("wrench", episode.columns.sensed.get("wrench")), ("efforts", episode.columns.joint_effort)):
        if table is not None and (lost := (table == 0).all(axis=1)).mean() < _LOST_SHARE:  # weight is always there
            yield worst_frame(lost.astype(np.float64), f"{name} of zero")
    hand, servo = episode.shared(_hand), episode.shared(_servo)
    if not isinstance(hand, _Hand) or isinstance(servo, NotMeasured):
        yield None if isinstance(hand, _Hand) else hand
        return
    robot, width = episode.info.robot, episode.columns.gripper_width
    moving = np.abs(np.gradient(width)) * episode.info.fps > _MOVES * robot.gripper.open_width  # fingers weigh, too
    free = servo.dynamics.is_judged & ~moving
    free[1:-1] &= free[:-2] & free[2:]  # a peak is one beside both neighbours
    of_wrench, (of_motors, of_all) = _peaks_of_wrench(episode, hand, servo), _peaks_of_motors(episode, servo)
    # What accelerates the arm otherwise than the servo, as an impact does, shows in both: in one of them less, as links
    # or hand are accelerated more, and in motors that bear no weight, if it goes sideways.
    yield worst_frame(np.where(free, np.maximum(of_wrench - 2 * of_all, 0.0), 0.0), "wrench")
    yield worst_frame(np.where(free, np.maximum(of_motors - 2 * of_wrench, 0.0), 0.0), "efforts")


def _peaks_of_motors(episode: CheckedEpisode, servo: _Servo) -> tuple[Array, Array]:
    """(T,) of the motors that bear weight, in units of what each bears; of all, in units of the most that one bears."""
    effort = episode.columns.joint_effort[:, : episode.num_arm]
    peaks = _peaks(effort - servo.torque) - _OWN_INERTIA * _peaks(servo.torque)
    peaks *= _weight_near_limit(episode)[:, None]
    of_loaded = np.where(servo.is_loaded, peaks, 0.0)
    of_all = (of_loaded / np.maximum(servo.usual, 1e-12)).max(axis=1)
    of_all = np.maximum(of_all, peaks.max(axis=1) / max(float(servo.usual.max()), 1e-12))
    unit = np.maximum(np.maximum(servo.usual, _SHAKEN * servo.shaken), 1e-12)
    return (of_loaded / unit).max(axis=1), of_all


def _peaks_of_wrench(episode: CheckedEpisode, hand: _Hand, servo: _Servo) -> Array:
    """(T,) of force and torque, in units of what the hand bears; what shifts between the fingers shows, too."""
    force, moment = servo.dynamics.borne(_mount(episode))
    weight = float(np.sqrt((force[servo.dynamics.is_judged] ** 2).sum(axis=1).mean()))  # noise adds to it
    needed = np.hstack([force, (moment - np.cross(hand.origin, force)) / _LEVER]) / weight
    peaks = _peaks(np.hstack([hand.force, hand.torque / _LEVER]) / weight - needed)
    peaks -= _OWN_INERTIA * _peaks(needed).max(axis=1, keepdims=True)
    gripped = _peaks(_left_of_grip(episode)[:, None])[:, 0] / weight
    return np.asarray(np.maximum(peaks.max(axis=1) * _weight_near_limit(episode) - gripped, 0.0))


def _weight_near_limit(episode: CheckedEpisode) -> Array:
    """(T,) a half where a motor is near its limit, else 1: in the step before it may have been at it, and have moved
    otherwise than the servo wanted."""
    effort = episode.columns.joint_effort[:, : episode.num_arm]
    return np.where(near_limit(effort, episode.info.robot), 0.5, 1.0)


def _peaks_of_grip(episode: CheckedEpisode) -> Iterator[Found]:
    force = episode.columns.contact_force
    carried = [episode.is_carried(body.name, CARRIED_HEIGHT) for body in episode.info.scene.movable]
    rows = np.any([*carried, np.zeros(len(force), dtype=np.bool_)], axis=0)
    if rows.sum() < MIN_FRAMES or not (usual := float(np.median(force[rows]))):
        yield NotMeasured(why="nothing is carried for long")
        return
    peaks = np.where(rows, _peaks(force[:, None])[:, 0], 0.0) / usual
    motors = np.abs(episode.columns.joint_effort[:, episode.num_arm :]).sum(axis=1)
    if at_work := float(np.median(motors[rows])):  # what pushes the fingers apart takes as much from both
        of_motors = np.where(rows, _peaks(motors[:, None])[:, 0], 0.0) / at_work
        yield worst_frame(_alone(np.maximum(of_motors - peaks, 0.0)), "efforts of the gripper")
        peaks = np.maximum(peaks - of_motors, 0.0)
    yield worst_frame(_alone(peaks), "contact force")


def _alone(peaks: Array) -> Array:
    """(T,) less those around: an arm that noise shakes has such peaks one after the other."""
    around: Array = np.max([np.roll(peaks, by) for by in (*range(-_AROUND, -1), *range(2, _AROUND + 1))], axis=0)
    return np.asarray(np.maximum(peaks - around, 0.0))


def _peaks(table: Array) -> Array:
    """(T, n) by how much each value is above both of its neighbours, or below both."""
    peaks = np.zeros_like(table)
    before, after = table[1:-1] - table[:-2], table[1:-1] - table[2:]
    peaks[1:-1] = np.where(before * after > 0, np.minimum(np.abs(before), np.abs(after)), 0.0)
    return peaks


def _of_joint(episode: CheckedEpisode, hand: _Hand, name: str) -> tuple[Array, Array]:
    """(T - 4,) N m each: what a joint's motor needs to give by the wrench and the links above it, and what it gave.

    Both are 0 where the joint is at its stop, which bears what the motor adds.
    """
    joint = next(joint for joint in episode.urdf.joints if joint.name == name)
    pose = episode.world_from_link(joint.child)
    force, moment = hand.dynamics.borne(name)  # of the links between the two joints, what bears no hand
    moment = moment - hand.loads_torque - np.cross(hand.origin, hand.loads_force)
    total = hand.torque + np.cross(hand.origin, hand.force) + moment
    total -= np.cross(pose[:, :3, 3], hand.force + force - hand.loads_force)
    needed = ((pose[:, :3, :3] @ np.array(joint.axis)) * total).sum(axis=1)
    index = episode.info.robot.arm_joints.index(name)
    position = episode.columns.joint_position[:, index]
    robot = episode.info.robot
    free = (position > robot.position_lower[index] + _STOP) & (position < robot.position_upper[index] - _STOP)
    return (needed * free)[2:-2], (episode.columns.joint_effort[:, index] * free)[2:-2]
