"""Do actions and states belong together in time, as the contract says: action t is taken after observation t."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from demorec.check.base import Found, Measurement, NotMeasured, alignment_check, sidecar_check
from demorec.check.dataset import Dataset
from demorec.check.episode import CheckedEpisode
from demorec.check.rows import finest_lag
from demorec.core.geometry import Array
from demorec.episode.features import ACTION, STATE
from demorec.episode.scene import POSITION_GAIN

_MAX_LAG = 5


def nearest_lag(
    before: Array, after: Array, moved: Array, *, reach: int, least: float = 0.0, fewest: int = 1
) -> tuple[int, float] | None:
    """By how many whole frames `after` (T, n) runs behind `before`, and how far apart the two are then.

    What counts is the third of the moving frames in which they are nearest, in units of the way of `moved` (T, n) to
    the next frame. None when nothing moves by `least`, or fewer than `fewest` frames do.
    """
    core = np.arange(reach, len(before) - reach)
    if len(core) < 10:
        return None
    step = np.linalg.norm(moved[core + 1] - moved[core - 1], axis=1) / 2
    moving = step > 0.3 * np.sqrt((step**2).mean())
    if moving.sum() < fewest or step.max() < least:
        return None
    core, step = core[moving], step[moving]
    lags = range(-reach, reach + 1)
    off = [float(np.quantile(np.linalg.norm(after[core + lag] - before[core], axis=1) / step, 0.33)) for lag in lags]
    best = int(np.argmin(off))
    return lags[best], off[best]


def servo_response(commands: Array, *, start: Array, substeps: int) -> Array:
    """(T, n) where joints must be at each frame, if command t is sent after observation t.

    The targets move linearly from one command to the next over `substeps` physics steps (one at least), and each step
    takes the joint by the servo's gain towards them: what `demorec.sim` does, without forces.
    """
    keep, substeps = 1.0 - POSITION_GAIN, max(substeps, 1)
    powers = POSITION_GAIN * keep ** np.arange(substeps - 1, -1, -1)
    share = np.arange(1, substeps + 1) / substeps
    from_new, from_old = float((powers * share).sum()), float((powers * (1 - share)).sum())
    out = np.empty_like(commands)
    position, previous = start, start
    for t, command in enumerate(commands):
        out[t] = position
        position = keep**substeps * position + from_old * previous + from_new * command
        previous = command
    return out


@alignment_check(measures="lag between states and what the commands ask for, frames")
def command_lag(episode: CheckedEpisode) -> Measurement | None:
    """Command t is sent after observation t and reached, but for the servo's lag, at observation t + 1.

    Least squares over whole lags from -5 to 5, all joints together, each on the scale of its speed and up to a
    constant, with a parabola through the best lag and its neighbours; infinite for unrelated motions.
    """
    c, info = episode.columns, episode.info
    start = np.array(info.scene.robot.joint_position)
    expected = servo_response(c.command_joint_target, start=start, substeps=info.physics_hz // info.fps)
    if len(expected) < 4 * _MAX_LAG:
        return None
    speed = np.sqrt((np.diff(expected, axis=0) ** 2).mean(axis=0))
    moving = speed > 1e-5
    if not moving.any():
        return None
    x, y = (table[:, moving] / speed[moving] for table in (expected, c.joint_position[:, : episode.num_arm]))
    core, lags = slice(_MAX_LAG, len(x) - _MAX_LAG), range(-_MAX_LAG, _MAX_LAG + 1)
    errors = [float((np.roll(y, -lag, axis=0)[core] - x[core]).var(axis=0).sum()) for lag in lags]
    if min(errors) > 0.5 * max(float(x[core].var(axis=0).sum()), 1e-12):
        return Measurement(value=math.inf, detail="states: the two do not follow each other at any lag")
    lag = finest_lag(lags, errors)
    return Measurement(value=abs(lag), detail=f"states: {lag:+.2f} frames off")


@alignment_check(measures="lag between action and executed command, frames")
def action_lag(episode: CheckedEpisode) -> Measurement | None:
    """The action of a frame is the wish behind that frame's command.

    Exploration noise hides this from least squares, but a good part of every episode has none: what counts is the
    third of the moving frames in which the two are nearest, in units of the way to the next frame.
    """
    action, command = episode.columns.action_joint_target, episode.columns.command_joint_target
    nearest = nearest_lag(action, command, action, reach=_MAX_LAG, least=1e-4)
    if nearest is None:
        return None
    lag, off = nearest
    if off > 3.0:
        return Measurement(value=math.inf, detail="commands do not follow the actions at any lag")
    return Measurement(value=abs(lag), detail=f"commands run {lag:+d} frames behind the actions")


_PRESSED = 0.2
"""Of the speed with which a gripper opens: slower, it is pressed apart."""


@alignment_check(measures="lag between gripper command and opening, frames beyond the motor's")
def gripper_lag(episode: CheckedEpisode) -> Iterator[Found]:
    """The opening starts to follow within a few frames of each command to close or open, and never before it."""
    c, fps = episode.columns, episode.info.fps
    jumps = np.flatnonzero(np.abs(np.diff(c.command_gripper)) > 0.01) + 1
    for frame in jumps.tolist():
        direction = math.copysign(1.0, float(c.command_gripper[frame] - c.command_gripper[frame - 1]))
        window = slice(max(frame - round(0.4 * fps), 0), frame + round(0.5 * fps) + 1)
        steps = direction * np.diff(c.gripper_width[window])
        moved = steps > 5e-4 * 30 / fps
        # What is put down may press fingers apart a little, before they open.
        moved[: frame - window.start] &= steps[: frame - window.start] > _PRESSED * steps.max(initial=0.0)
        if not moved.any():
            continue
        start = window.start + int(np.argmax(moved))  # the last frame before the opening changes
        # The command is sent after this observation: the opening may change from this frame to the next at the
        # earliest; closing fingers need a frame or two to speed up.
        late = start - frame
        off = float(-late if late < 0 else max(late - 0.1 * fps, 0.0))
        yield Measurement(value=off, frame=frame, detail=f"starts {late} frames after the command")


_BLURRED_S = 1 / 15
"""By which the noise that increments take back moves their course, seconds."""
_AS_ALIKE = 0.99
"""Share of the best shift's likeness from which one that is allowed fits as well: a clean set of 48 frames a second has
0.997, increments that are two frames early 0.98."""


@sidecar_check(measures="lag between action and state, off the contract's, frames")
def dataset_action_lag(dataset: Dataset) -> Iterator[Found]:
    """Action t is what leads from observation t to t + 1, in every episode; catches shifted and made-up actions.

    Poses are compared by position. Exploration noise is in the states and not in the actions: what counts is the
    third of the moving frames in which the two are nearest. Increments are summed up first; where noise was executed,
    it is taken back in them and they cannot be: then their course, smoothed, is compared with that of the changes of
    state, all episodes together, and two frames of 30 a second are allowed.
    """
    wishes, changes = [], []
    for each in dataset.described():
        rows, info, kind = each.rows, each.info, dataset.action_kind(each.info)
        poses, is_joint = dataset.tcp_poses(info, rows), kind in ("joint", "joint_increment")
        if kind is None or not (is_joint or poses):
            continue
        if is_joint:
            reached = rows[STATE].astype(np.float64)[:, : len(info.robot.arm_joints)]
            start = np.array(info.scene.robot.joint_position)
        else:
            reached = next(iter(poses.values()))[:, :3]
            start = reached[0]
        wish, substeps = rows[ACTION].astype(np.float64)[:, : reached.shape[1]], info.physics_hz // dataset.info.fps
        if kind in ("joint_increment", "ee_delta"):
            if info.behaviour.get("action_noise", 0.0):
                # The servo is linear: its response to increments is the increments of its response.
                wishes.append(servo_response(wish, start=np.zeros_like(start), substeps=substeps)[1:])
                changes.append(np.diff(reached, axis=0))
                continue
            wish = start + np.cumsum(wish, axis=0)
        expected = servo_response(wish, start=start, substeps=substeps)
        if (nearest := nearest_lag(expected, reached, reached, reach=3, fewest=10)) is not None:
            lag, off = nearest
            value, words = (math.inf, "unrelated") if off > 3.0 else (abs(lag), f"{lag:+d} frames")
            yield Measurement(value=value, detail=f"episode {each.number}: {words}")
    if wishes:
        yield _course_lag(wishes, changes, allowed=max(2, round(_BLURRED_S * dataset.info.fps)))


def _course_lag(wishes: list[Array], changes: list[Array], *, allowed: int, window: int = 9) -> Found:
    """By how many frames beyond those allowed changes run behind wishes, by the correlation of smoothed courses."""
    from scipy.ndimage import uniform_filter1d

    reach = 2 * allowed
    products, sizes = np.zeros(2 * reach + 1), np.zeros(2)
    for wish, change in zip(wishes, changes, strict=True):
        x, y = (uniform_filter1d(table, window, axis=0, mode="constant") for table in (wish, change))
        core = slice(reach, len(x) - reach)
        sizes += (x[core] ** 2).sum(), (y[core] ** 2).sum()
        products += [float((x[core] * np.roll(y, -k, axis=0)[core]).sum()) for k in range(-reach, reach + 1)]
    if not sizes.all():
        return NotMeasured(why="no episode with noise is long enough to compare the courses")
    best = int(np.argmax(products))
    likeness = products[best] / max(math.sqrt(sizes[0] * sizes[1]), 1e-12)
    lag = best - reach
    if likeness < 0.5:
        return Measurement(value=math.inf, detail=f"actions and changes of state are unrelated ({likeness:.2f})")
    fits = products[reach - allowed : reach + allowed + 1].max() >= _AS_ALIKE * products[best]
    value = 0 if fits else abs(lag) - allowed
    return Measurement(value=value, detail=f"all episodes: {lag:+d} frames, likeness {likeness:.2f}")
