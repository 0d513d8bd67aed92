"""Laws of motion that hold for any robot, on every episode that has what they need, whoever recorded it.

An action is compared with the state where its elements are targets of the same joints.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial, wraps

import numpy as np
from numpy.typing import NDArray

from demorec.check.base import (
    EFFORTS,
    GRIPPER,
    STATE_ALONE,
    URDF,
    VELOCITIES,
    Form,
    Found,
    Lacking,
    Measurement,
    NotMeasured,
    check,
    worst_entry,
    worst_frame,
)
from demorec.check.dataset import Recorded
from demorec.check.dynamics import Dynamics, dynamics_by_frames, point_masses
from demorec.check.episode import CheckedEpisode
from demorec.check.evidence import Motion
from demorec.check.rows import held_for, longest_run
from demorec.core.geometry import Array
from demorec.episode.sensed import MAY_REST

_LATEST_S = 0.5
"""Lags of torques that are tried, seconds."""
_FEW_FPS = 20
"""Frames a second below which exploration noise moves a joint to and fro between two frames."""
FEWEST_TO_COMPARE = 4
"""Episodes from which on one is told to be unlike the others."""
_FEWEST_WAYS = 20
"""Ways of `_VELOCITY_S` below which an episode's velocities are not judged by themselves."""
_VELOCITY_S = 0.3
"""Over which velocities are added up: filters of drivers are 20 to 100 ms late, which cancels over longer times."""
_SLOW = 0.05
"""Root mean square speed, rad/s or m/s, above which a joint is judged even where others move ten times as far."""
_LIVELY = 0.25
"""Share of what all episodes move in a frame, squared, from which the velocities of one are judged by themselves."""
_SETTLE_S = 0.6
"""After a new command fingers need so long to arrive, closing at 0.2 m/s from 0.1 m; some jaws need longer."""
_STUCK, _INVERTED = 0.01, 0.5
"""Share of what a gripper can open by, below which one that is told to open and to close never moves; correlation with
a steady command, below nothing, of one that goes the other way."""
_LEAST_STROKE = 0.2
"""Share of what a gripper can open by, below which its command only trembles."""
_STILL_FRAMES = 19
"""Of the arm's motion in which a sensor of another robot may stand still, if that is all of the episode."""

EVERYWHERE: tuple[Form, ...] = ("simulated", "external", "dataset")

motion_check = partial(check, group="physics", on=EVERYWHERE)


def of_each_motion(law: Callable[[Motion], Found | Iterator[Found]]) -> Callable[[Recorded], Iterator[Found]]:
    """A law of each motion by itself: what is found names its episode, and one that lacks something ends the search."""

    @wraps(law)
    def of_all(subject: Recorded) -> Iterator[Found]:
        for motion in subject.motions.all:
            of_one = law(motion)
            for found in of_one if isinstance(of_one, Iterator) else (of_one,):
                if isinstance(found, Measurement):
                    found = replace(found, detail=", ".join(filter(None, (found.detail, motion.where))))
                yield found
                if isinstance(found, Lacking):
                    return

    return of_all


@motion_check(
    measures="how far the state, and what is sent to it, is beyond the limits of its joints",
    unit="rad, m",
    warn=0.01,
    fail=0.2,
    simulated=(0.005, 0.05),
    needs=URDF,
)
@of_each_motion
def joint_limits(motion: Motion) -> Iterator[Found]:
    """Joints are within the limits of the robot's URDF: catches degrees for radians, and offsets."""
    known = np.isfinite(motion.lower) | np.isfinite(motion.upper)
    if not known.any():
        yield Lacking(need=URDF)
        return
    for name, table in (("", motion.state), *motion.commands.items()):
        beyond = np.maximum(np.maximum(motion.lower - table, table - motion.upper), 0.0)
        labels = [f"{label} of the {name}" if name else label for label in motion.labels(known)]
        yield worst_entry(beyond[:, known], labels)


@motion_check(
    measures="largest speed of a joint in units of its limit",
    warn=1.2,
    fail=2.5,
    simulated=(1.5, 1.7),  # 1.245 where noise shakes an arm most, of 4,000 of seed 92000
    needs=URDF,
)
@of_each_motion
def joint_speed(motion: Motion) -> Iterator[Found]:
    """No joint is faster than its motor: catches wrong rates, spikes, and episodes glued together.

    By the recorded velocities too where these are known to be those of the joints.
    """
    known = np.isfinite(motion.speed) & (motion.speed > 0)
    if not known.any():
        yield Lacking(need=URDF)
        return
    labels, limit = motion.labels(known), motion.speed[known]
    if motion.commands and motion.velocity is not None:
        yield worst_entry(np.abs(motion.velocity[:, known]) / limit, labels)
    for table in (motion.state, *motion.commands.values()):
        speed = np.abs(np.diff(table[:, known], axis=0)) / motion.steps_s[:, None] / limit
        yield worst_entry(speed, labels, first=1)


@motion_check(
    measures="ratio of state differences to velocities, off 1",
    warn=0.1,
    fail=0.16,
    needs=VELOCITIES,
)
def velocity_matches_position(subject: Recorded) -> Iterator[Found]:
    """States change by velocity over time, each joint by itself, all episodes together, and all joints in each episode:
    catches a wrong rate, also of one episode, other units, and other joints' velocities."""
    pairs = [motion for motion in subject.motions.all if motion.velocity is not None and len(motion.state) > 1]
    if not pairs:
        yield Lacking(need=VELOCITIES)
        return
    parts, counts = [], []
    for motion in pairs:
        assert motion.velocity is not None
        mean = (motion.velocity[1:] + motion.velocity[:-1]) / 2
        ways = np.vstack([np.zeros(mean.shape[1]), np.cumsum(mean * motion.steps_s[:, None], axis=0)])
        reach = min(max(1, round(_VELOCITY_S * motion.fps)), len(ways) - 1)
        integrated, moved = ways[reach:] - ways[:-reach], motion.state[reach:] - motion.state[:-reach]
        parts.append([(moved * integrated).sum(axis=0), (integrated**2).sum(axis=0), (moved**2).sum(axis=0)])
        counts.append(len(moved))
    yield from _of_single_episodes(pairs, np.array(parts), np.array(counts))
    sums, count = np.sum(parts, axis=0), sum(counts)
    known = np.flatnonzero(np.isfinite(sums[0]) & (sums[2] > 0))
    if not len(known):
        return
    names = [pairs[0].names[element] for element in known]
    found = sums[:, known]
    if pairs[0].fps < _FEW_FPS:  # two velocities say little of the way between: what joints do in truth shows in all
        found, names = found.sum(axis=1, keepdims=True), ["all joints"]
    product, square, total = found
    ratio = product / np.maximum(square, 1e-12)
    # Of a joint that hardly moves, beside the others or at all, noise decides.
    moves = (total > 0.01 * total.max()) | (total > count * (_SLOW * _VELOCITY_S) ** 2)
    off = np.abs(ratio - 1) * moves * min(1.0, pairs[0].fps / _FEW_FPS)
    if len(off) > 1:  # fingers start and stop within a few frames
        off = np.where(pairs[0].grippers[known], off / 2, off)
    worst = int(np.argmax(off))
    yield Measurement(value=float(off[worst]), detail=f"{names[worst]}: ratio {ratio[worst]:.3f}")


def _of_single_episodes(motions: Sequence[Motion], parts: Array, counts: NDArray[np.int64]) -> Iterator[Measurement]:
    """Of all joints in each of several episodes, by half: one episode's ratio has more of the noise. Of one that moves
    little, noise is the most.
    """
    if len(motions) < 2:
        return
    product, square, total = np.nansum(np.where(np.isfinite(parts[:, :1]), parts, 0.0), axis=2).T
    moves = (total > _LIVELY * counts * total.sum() / counts.sum()) & (counts >= _FEWEST_WAYS)
    for row in np.flatnonzero(moves):
        ratio = product[row] / max(square[row], 1e-12)
        yield Measurement(value=abs(ratio - 1) / 2, detail=f"{motions[row].where}: ratio {ratio:.3f}")


@motion_check(
    measures="longest run of frames in which a sensor stands still to the last bit while the arm moves",
    warn=_STILL_FRAMES,
    fail=math.inf,
    simulated=(2, 4),
    needs=STATE_ALONE,
)
@of_each_motion
def stuck_sensors(motion: Motion) -> Iterator[Found]:
    """What is measured changes, if ever so little, while the arm moves, and each of its elements in some frame.

    Of other robots than simulated ones a sensor is reported that never changes in an episode. One that may rest counts
    only where it is not zero.
    """
    moves = np.abs(np.diff(motion.state, axis=0)).max(axis=1, initial=0.0) > 1e-5
    if motion.contact is not None:
        moves = np.abs(np.diff(motion.state[:, :-1], axis=0)).max(axis=1, initial=0.0) > 1e-5
    for name, table in motion.sensors.items():
        same, stands = (table[1:] == table[:-1]).all(axis=1) & moves, np.ptp(table, axis=0) == 0
        if name in MAY_REST:
            same, stands = same & table[1:].any(axis=1), stands & table.any(axis=0)
        length, start = longest_run(same)
        if motion.contact is None:  # sensors slower than the frames hold a value, and contacts come and go
            length, start = int(same.sum() * stands.all()), 0
        elif stands.any():
            length, start = int(moves.sum()), 0
        yield Measurement(value=length, frame=start + 1 if length else None, detail=name)


@motion_check(
    measures="gripper opening against a command that it has had the time to follow, as a share of what is commanded",
    warn=0.25,
    fail=0.5,
    needs=GRIPPER,
)
@of_each_motion
def gripper_follows(motion: Motion) -> Found:
    """The fingers stand where they were told to, or on the way there where something is between or beside them.

    Catches openings and commands that are inverted, halved or frozen. Whether something is at the fingers says the
    force on them; where nobody measures it, they may be kept open by it whenever they were told to close, and from
    opening in fewer than half of the frames in which they were told to open.
    """
    if (told := told_gripper(motion)) is None:
        return Lacking(need=GRIPPER)
    place, command = told
    command = motion.commands["command"][:, place] if "command" in motion.commands else command
    settle_s = max(_SETTLE_S, motion.stroke_s + 0.1)
    opening, wait = motion.state[:, place], math.ceil(settle_s * motion.fps)
    span = float(motion.upper[place] - motion.lower[place])
    reach = span if math.isfinite(span) else float(np.ptp(command))
    if len(command) <= wait:
        return NotMeasured(why=f"an episode is shorter than {settle_s:g} s")
    # Increments and speeds are left out: they are small beside the opening, and come back to 0.
    if reach < 0.2 * float(np.ptp(opening)) or reach < 1e-4:
        return NotMeasured(why="the gripper's command is none of its opening, or never changes")
    steady = np.ones(len(command), dtype=np.bool_)
    for back in range(1, wait + 1):
        steady[back:] &= np.abs(command[back:] - command[:-back]) < 1e-3 * reach
    steady[:wait] = False
    if not steady.any():
        return NotMeasured(why="the gripper's command never lasts")
    gap = opening - command
    # Tasks may open a gripper by a part of what it can; a command that only trembles opens nothing.
    is_open = command > command.min() + 0.5 * max(float(np.ptp(command)), _LEAST_STROKE * reach)
    holds = ~is_open
    if motion.contact is not None:
        holds = held_for(motion.contact > 0, wait)  # what was let go of has as much time, from then on
    beyond = np.where(is_open, gap, -gap)  # things keep fingers from closing between them, and from opening beside them
    off = np.where(holds, np.maximum(beyond, 0.0), np.abs(gap)) / reach
    if motion.contact is None and float(np.ptp(command[steady])) > _LEAST_STROKE * reach:
        if float(np.ptp(opening[steady])) < _STUCK * reach:
            return Measurement(value=1.0, detail="it never moves")
        if float(np.corrcoef(opening[steady], command[steady])[0, 1]) < -_INVERTED:
            return Measurement(value=1.0, detail="it opens when told to close, and closes when told to open")
    if motion.contact is None and (rows := steady & is_open).any():  # what is beside them shows in some frames
        off = np.where(is_open, np.median(off[rows]), off)
    return worst_frame(np.where(steady, off, 0.0), f"{int(steady.sum())} frames after the motion")


def told_gripper(motion: Motion) -> tuple[int, Array] | None:
    """The element that is the opening of a gripper, and (T,) its action; None where either is not known."""
    place = motion.gripper
    if place is None or motion.action is None or not np.isfinite(motion.action[:, place]).all():
        return None
    return place, motion.action[:, place]


@motion_check(
    measures="torques of the arm against inverse dynamics, median difference of the load",
    warn=0.6,
    fail=math.inf,
    needs=EFFORTS,
)
def effort_matches_dynamics(subject: Recorded) -> Iterator[Found]:
    """The motors of the joints that bear the arm give the torques that its weight and motion need.

    Catches torques of other joints, of another sign or unit, halved or frozen. Of other robots than simulated ones the
    load in the hand and the friction are not known, and some drivers leave out the weight: they are only warned of. By
    how much more than usual one of four episodes is off counts twice.
    """
    found = list[Measurement]()
    for motion in subject.motions.all:
        dynamics = _dynamics(subject, motion)
        if motion.effort is None or dynamics is None:
            yield Lacking(need=EFFORTS)
            return
        told = dynamics if isinstance(dynamics, NotMeasured) else dynamics.compare(motion.joints, motion.effort)
        if isinstance(told, Measurement):
            found.append(replace(told, detail=f"{told.detail}, {motion.where}".rstrip(", ")))
        yield told
    usual = float(np.median([told.value for told in found])) if len(found) >= FEWEST_TO_COMPARE else math.inf
    yield from (replace(told, value=2 * (told.value - usual)) for told in found if told.value > 2 * usual)


@motion_check(
    on=("external", "dataset"),
    measures="how far torques are behind the motion that needs them, or before it",
    unit="s",
    warn=0.15,
    fail=math.inf,
    needs=EFFORTS,
)
def effort_lag(subject: Recorded) -> Iterator[Found]:
    """Torques are of the same moment as the joints, where the load of a joint changes much: filters are faster."""
    for motion in subject.motions.all:
        dynamics = _dynamics(subject, motion)
        if motion.effort is None or dynamics is None:
            yield Lacking(need=EFFORTS)
            return
        if isinstance(dynamics, NotMeasured):
            yield dynamics
        elif (lag := dynamics.lag_of(motion.joints, motion.effort, reach=math.ceil(_LATEST_S * motion.fps))) is None:
            yield NotMeasured(why="no joint's load changes much")
        else:
            yield Measurement(value=abs(lag) / motion.fps, detail=f"{lag:+.1f} frames, {motion.where}".rstrip(", "))


def _dynamics(subject: Recorded, motion: Motion) -> Dynamics | NotMeasured | None:
    """The torques that a motion needs; None where the robot's model is not known."""
    if isinstance(subject, CheckedEpisode) and subject.form == "simulated":
        return subject.shared(dynamics_by_frames)
    return point_masses(motion)
