"""Is each frame measured: none repeats the one before, none is made up between two others, none was left out.

Whatever the file says of times: LeRobot's are those of the rate, whether or not a frame was lost.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from demorec.check.base import STATE_ALONE, Found, Measurement
from demorec.check.evidence import FEWEST, MOVES, Flags, Motion
from demorec.check.motion import motion_check, of_each_motion

_MIDWAY = 1e-6
"""Share of the state's range within which a state is midway between two others; float32 rounds to a tenth of it."""
_SLOWEST = 0.5
"""Share of the usual speed that counts as the speed around a frame where the arm hardly moves."""
_QUICK, _SLOW = 0.5, 0.01
"""Share of the usual velocity, and rad/s or m/s, above which a joint moves."""
_STEPS = 30
"""Finest steps that an element goes in an episode if it moves."""

_STIRS = 1e-3
"""Of an element's root mean square step: what changes by less rests, as a simulated arm does that settles."""


@motion_check(
    measures="share of frames that repeat the one before, number by number, while the arm moves",
    warn=0.01,
    fail=math.inf,
    simulated=(0.0, 0.0),
    needs=STATE_ALONE,
)
@of_each_motion
def repeated_frames(motion: Motion) -> Iterator[Found]:
    """Each frame is one of its own: catches gaps that were filled with what came before. Of simulated recordings, of
    which all numbers are measured anew, in any frame; else where the frames around it differ or a velocity says so."""
    tables = [motion.state, *motion.sensors.values(), *([] if motion.action is None else [motion.action])]
    rows = np.column_stack([table.reshape(len(table), -1) for table in tables])
    same = ((rows[1:] == rows[:-1]) | np.isnan(rows[1:])).all(axis=1)
    steps = np.abs(np.diff(motion.state, axis=0))
    changes = (steps > _STIRS * np.sqrt((steps**2).sum(axis=0) / max(len(steps), 1))).any(axis=1)
    moves = _is_quick(motion)[1:]
    moves[1:-1] |= changes[:-2] & changes[2:]
    wrong = same if motion.contact is not None else same & moves
    frame = int(np.argmax(wrong)) + 1 if wrong.any() else None
    yield Measurement(value=float(wrong.mean()) if len(wrong) else 0.0, frame=frame)


def _is_quick(motion: Motion) -> Flags:
    """(T,) where a joint has a velocity that is not small beside its usual one; nowhere, where none is known."""
    if motion.velocity is None:
        return np.zeros(len(motion.state), dtype=np.bool_)
    speed = np.abs(np.nan_to_num(motion.velocity))
    return np.asarray((speed > np.maximum(_QUICK * np.sqrt((speed**2).mean(axis=0)), _SLOW)).any(axis=1))


@motion_check(
    measures="share of moving frames in which every joint is exactly midway between its neighbours",
    warn=0.02,
    fail=0.2,
    needs=STATE_ALONE,
)
@of_each_motion
def interpolated_frames(motion: Motion) -> Iterator[Found]:
    """States were measured, not made by interpolation between others, which halves velocities where they turn.

    A gripper may move at one speed while the arm stands still.
    """
    state = motion.state[:, ~motion.grippers]
    if len(state) < FEWEST or not state.size:
        return
    near, way = _MIDWAY * max(float(np.ptp(state, axis=0).max()), 1e-9), np.abs(state[2:] - state[:-2])
    # Encoders of coarse steps may go as far twice; not several of them at once, over many steps.
    least = np.where(state[1:] == state[:-1], np.inf, np.abs(np.diff(state, axis=0))).min(axis=0)
    moves = (way > np.maximum(1e3 * near, 10 * least)).sum(axis=1) >= min(3, state.shape[1])
    midway = np.abs(state[1:-1] - (state[2:] + state[:-2]) / 2).max(axis=1) < near
    if moves.sum() >= FEWEST:
        yield Measurement(value=float(midway[moves].mean()))


@motion_check(
    measures="times as far as in the frames around it that the arm goes in one",
    warn=5.0,
    fail=10.0,
    on=("external", "dataset"),
    needs=STATE_ALONE,
)
@of_each_motion
def missing_frames(motion: Motion) -> Found:
    """An arm is as fast in a frame as in the two before and after, within a few times: catches frames that were lost,
    as the next one then is as far away as several, and angles that wrap.

    Grippers may be that quick, and are left out.
    """
    if len(motion.state) < FEWEST:
        return None
    state = motion.state[:, ~motion.grippers]
    way = np.abs(np.diff(state, axis=0))
    finest = np.where(way > 0, way, np.inf).min(axis=0)  # of an encoder of coarse steps one is no jump
    moves = np.ptp(state, axis=0) > np.maximum(_STEPS * finest, MOVES)
    if not moves.any():
        return None
    speed = np.maximum(way - finest, 0.0)[:, moves] / motion.steps_s[:, None]
    speed = np.linalg.norm(speed / np.maximum(np.sqrt((speed**2).mean(axis=0)), 1e-12), axis=1)
    beside = np.pad(speed, 2, mode="edge")
    around = np.max([beside[:-4], beside[1:-3], beside[3:-1], beside[4:]], axis=0)
    times = speed / np.maximum(around, max(_SLOWEST * math.sqrt(float((speed**2).mean())), 1e-12))
    frame = int(times.argmax())
    return Measurement(value=float(times[frame]), frame=frame + 1)
