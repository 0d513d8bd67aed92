"""Do actions and states of any robot belong together, where actions are targets of the state's elements."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import partial

import numpy as np

from demorec.check.base import (
    ACTIONS,
    GRIPPER,
    URDF,
    VELOCITIES,
    Found,
    Lacking,
    Measurement,
    NotMeasured,
    check,
    worst,
    worst_entry,
)
from demorec.check.dataset import Dataset, Recorded
from demorec.check.evidence import FEWEST, MOVES, Motion, correlations, is_gripper, quaternion_places
from demorec.check.motion import motion_check, of_each_motion, told_gripper
from demorec.check.rows import finest_lag
from demorec.core.geometry import Array
from demorec.episode.features import ACTION

_REACH_S = 1.0
"""How far apart in time an action and the state that follows it are looked for, seconds."""
_LATEST_S = 0.35
"""How far behind its action a state may be, seconds: hobby servos under teleoperation need 0.1 to 0.2."""
_HELD_S = 0.3
"""How long an action has not changed before its joint should be there, seconds."""
_ALIKE = 3.0
"""Times the movement of the state that an action of its unit may move: teleoperation is scaled to half or double."""
_COPIED = 1e-6
"""Share of the state's range within which an action is a state."""
_SEVERAL = 3
"""Episodes that do not all go to one place."""
_FAR, _FAR_SHARE = 0.2, 0.2
"""rad or m that no element goes by itself, and the share of what another one goes: some states are in degrees."""
_END, _LASTS, _MOST_STROKES = 0.25, 0.1, 8
"""Share of its range in which a gripper is open, or closed; of the frames in which it is, at least; and how often one
opens and closes in an episode. Of normal noise a fifteenth is in each."""
_JUMP, _STILL, _BEGUN = 0.3, 0.01, 0.05
"""Shares of a gripper's range: what a command jumps by, what it stays within before that, what shows in the opening."""
_STAYS, _GOES, _FEWEST_TIMES = 1e-5, 1e-3, 4
"""rad, m: by how much a state that stays changes at most, and an action that goes on at least; how often."""
_FEWEST_LEVELS = 5
"""Steps of an action below which it is of keys."""
_FEWEST_STEPS, _COMES_BACK = 12, 2
"""Steps between a joint's values from which on the least of them tells how fine they are; how often each is gone."""
_ANY_OTHER = 2.0
"""Times the second largest difference of a step from its velocities, beyond which the largest is a jump."""
NO_TARGETS = "the action is no target of the state's elements (by their names and courses)"

target_check = partial(check, on=("external", "dataset"), needs=ACTIONS)
"""Of simulated recordings the commands are known, by which `command_tracking` and `command_lag` judge more sharply."""


@target_check(
    measures="frames by which the state is too early for its action, or too late",
    warn=0.75,
    fail=0.95,
    group="alignment",
)
def state_follows_action(subject: Recorded) -> Found:
    """The state follows the action by about a frame or more, and by less than a third of a second: catches actions that
    were recorded late or early, or that are the state itself, from which a policy learns to stand still."""
    if not (targets := subject.motions.targets):
        return NotMeasured(why=NO_TARGETS)
    reach = max(2, round(_REACH_S * subject.motions.all[0].fps))
    lags = range(-reach, reach + 1)
    long = [(state, action) for state, action in targets if len(state) > 3 * reach]
    if not long:
        return NotMeasured(why="the episodes are too short to tell which of state and action is first")
    squares = np.zeros((len(lags), long[0][0].shape[1]))
    for state, action in long:
        core = slice(reach, len(state) - reach)
        # The variance: a zero that is off, and weight, keep state and action apart whatever the lag.
        squares += [len(state) * (state[core] - np.roll(action, lag, axis=0)[core]).var(axis=0) for lag in lags]
    off = np.sqrt(squares)
    first = subject.motions.all[0]
    elements = np.flatnonzero(subject.motions.moving)
    # A gripper is slower than the arm, and stops at what it holds.
    moved = np.flatnonzero((off.min(axis=0) < 0.8 * np.minimum(off[0], off[-1])) & (elements != first.gripper))
    if not len(moved):
        return NotMeasured(why="state and action of the arm move too little to tell which of them is first")
    lag = float(np.median([finest_lag(lags, off[:, element].tolist()) for element in moved]))
    late = lag - _LATEST_S * subject.motions.all[0].fps
    return Measurement(value=max(1 - lag, late, 0.0), detail=f"the state follows by {lag:+.2f} frames")


@target_check(
    measures="elements of the state that follow the action of another one",
    group="alignment",
)
def actions_in_order(subject: Recorded) -> Found:
    """Every element of the state follows its own action: catches joints exchanged in one of the two."""
    if not (targets := subject.motions.targets):
        return NotMeasured(why=NO_TARGETS)
    table = correlations(targets)
    count = len(table)
    kept = np.flatnonzero(subject.motions.moving).tolist()
    names = [subject.motions.all[0].names[i] for i in kept]
    best = table.argmax(axis=1)
    # Two joints of one motion may go alike; an exchange shows where an element hardly follows its own action at all.
    # A quaternion is left out: its elements are of one rotation, and a small one follows any other.
    turns = {i for place in quaternion_places(subject.motions.all[0].names) for i in range(place, place + 4)}
    wrong = [i for i in range(count) if best[i] != i and table[i, best[i]] - table[i, i] > 0.3 and kept[i] not in turns]
    words = [f"{names[i]} follows that of {names[best[i]]}" for i in wrong]
    return Measurement(value=len(wrong), detail="; ".join(words[:3]))


@target_check(
    group="physics",
    measures="distance at which a joint always stays from its action",
    unit="rad, m",
    warn=0.1,
    fail=0.3,
)
def state_reaches_action(subject: Recorded) -> Found:
    """A joint that is held comes to where it was sent, at least at some time: catches a zero that is off.

    Weight and friction keep an arm off by a few hundredths of a rad, and what a gripper holds keeps its fingers apart;
    only a false zero does so always. Velocities, increments and shares of a range are no places to be at.
    """
    if not (targets := subject.motions.targets):
        return NotMeasured(why=NO_TARGETS)
    spread = float(np.median([np.nanmedian(action.std(axis=0)) for _, action in targets]))
    if not 1 / _ALIKE < spread < _ALIKE:
        return NotMeasured(why=f"actions move {spread:.3g} times as far as the state, so they are in another unit")
    offsets: dict[str, list[Array]] = {}
    for motion in subject.motions.all:
        if motion.action is None:
            continue
        still = max(2, round(_HELD_S * motion.fps))
        known = np.flatnonzero(np.isfinite(motion.lower) & np.isfinite(motion.action).all(axis=0))
        for element in known.tolist():
            action = motion.action[:, element]
            held = [t for t in range(still, len(action)) if np.ptp(action[t - still : t + 1]) < 0.01]
            offsets.setdefault(motion.names[element], []).append(np.abs(motion.state[held, element] - action[held]))
    least = {name: float(np.quantile(np.concatenate(of), 0.1)) for name, of in offsets.items() if sum(map(len, of))}
    if not least:
        return NotMeasured(why="no joint is known whose action stays where it is for a while")
    name = max(least, key=lambda key: least[key])
    return Measurement(value=least[name], detail=name)


@motion_check(
    measures="elements of the state that never change while their action does, or the other way round",
    needs=ACTIONS,
)
def elements_alive(subject: Recorded) -> Found:
    """Encoders and commands are alive: of no element one stays at one value in all episodes while the other changes;
    commands, in three episodes or more."""
    pairs = [
        (motion.state, motion.action)
        for motion in subject.motions.all
        if motion.action is not None and len(motion.state) >= FEWEST
    ]
    if not pairs:
        return Lacking(need=ACTIONS)
    stands = np.all([np.ptp(state, axis=0) == 0 for state, _ in pairs], axis=0)
    sent = np.any([np.ptp(action, axis=0) > 50 * MOVES for _, action in pairs], axis=0)
    sent_at_all = np.concatenate([action for _, action in pairs])
    unsent = np.all(sent_at_all == sent_at_all[0], axis=0) & (len(pairs) >= _SEVERAL)  # one may have one goal
    ways = np.max([np.ptp(state, axis=0) for state, _ in pairs], axis=0)
    moves = ways > max(_FAR, _FAR_SHARE * ways.max())
    gripper = subject.motions.all[0].gripper
    if gripper is not None:
        moves[gripper] = _opens_and_closes([state[:, gripper] for state, _ in pairs])
    is_dead = (stands & sent) | (unsent & moves)
    dead = [name for name, row in zip(subject.motions.all[0].names, is_dead, strict=True) if row]
    return Measurement(value=len(dead), detail=", ".join(dead))


def _opens_and_closes(openings: list[Array]) -> bool:
    """Whether a gripper goes from one end of its range to the other a few times in most episodes, as noise does not."""
    lowest, highest = (float(end(np.concatenate(openings))) for end in (np.min, np.max))
    count = 0
    for opening in openings:
        share = (opening - lowest) / max(highest - lowest, 1e-9)
        closed, opened = share < _END, share > 1 - _END
        ends = opened[closed | opened]
        lasts = min(closed.mean(), opened.mean()) > _LASTS
        count += lasts and np.count_nonzero(ends[1:] != ends[:-1]) <= _MOST_STROKES
    return count > len(openings) / 2


@check(
    group="physics",
    on=("external", "dataset"),  # of simulated recordings `velocity_follows_servo` judges each frame
    measures="a single step of a joint that its velocities do not tell, beyond twice any other, of the joint's range",
    warn=0.02,
    fail=0.04,
    needs=VELOCITIES,
)
@of_each_motion
def steps_as_velocities(motion: Motion) -> Iterator[Found]:
    """No joint jumps: catches an encoder that slips, a single wrong value, and frames that are missing.

    Velocities that are coarse, late or of another unit differ from the steps everywhere, and tell nothing.
    """
    if motion.velocity is None:
        yield Lacking(need=VELOCITIES)
        return
    if len(motion.state) < FEWEST:
        return
    expected = (motion.velocity[1:] + motion.velocity[:-1]) / 2 * motion.steps_s[:, None]
    # Within a step a joint may start and stop: only what is more than its fastest could do is a jump.
    fastest = np.abs(motion.velocity).max(axis=0) * motion.steps_s[:, None]
    off = np.sort(np.maximum(np.abs(np.diff(motion.state, axis=0) - expected) - fastest, 0.0), axis=0)[-2:]
    beyond = np.maximum(off[1] - _ANY_OTHER * off[0], 0.0) / np.maximum(np.ptp(motion.state, axis=0), _GOES)
    known = np.isfinite(beyond) & (np.arange(len(beyond)) != motion.gripper)
    if known.any():
        yield worst_entry(beyond[None, known], motion.labels(known))


@target_check(
    group="alignment",
    measures="share of an episode's moving frames whose action is an observed state, number by number",
    warn=0.5,
    fail=float("inf"),
)
def action_is_no_observation(subject: Recorded) -> Iterator[Found]:
    """Actions are what was sent, not the states that came of it: what is copied from this observation or the next lacks
    what the robot was told beyond what it did. Of a gripper the two may be the same."""
    if not subject.motions.targets:
        yield NotMeasured(why=NO_TARGETS)
        return
    for motion in subject.motions.all:
        if motion.action is None or len(motion.state) < FEWEST:
            continue
        arm = [i for i in range(len(motion.names)) if i != motion.gripper and np.isfinite(motion.action[:, i]).all()]
        state, action = motion.state[:, arm], motion.action[:, arm]
        near = _COPIED * max(float(np.ptp(state, axis=0).max(initial=0.0)), 1e-9)
        moves = np.abs(np.diff(state, axis=0)).max(axis=1, initial=0.0) > 10 * near
        if moves.sum() >= FEWEST // 2:
            off = [np.abs(seen - action[:-1]).max(axis=1, initial=0.0)[moves] for seen in (state[1:], state[:-1])]
            share = max(float((each < near).mean()) for each in off)
            yield Measurement(value=share, detail=f"of {moves.sum()} frames, {motion.where}".rstrip(", "))


@target_check(
    group="physics",
    measures="how far the action of a joint goes while its state stays at one value, median of all such times",
    unit="rad, m",
    warn=0.008,
    fail=0.015,
    needs=f"{ACTIONS}, and {URDF}",
)
def dead_band(subject: Recorded) -> Found:
    """A joint's state changes when its action does: catches play between encoder and joint, and coarse encoders.

    An encoder has a thousandth of a turn or finer, 0.006 rad; clean data have 0.004. A joint that waits once, or is
    blocked, has no dead band, nor has a state of which all elements stay, being measured less often than frames are.
    """
    if not subject.motions.targets:
        return NotMeasured(why=NO_TARGETS)
    ways: dict[str, list[float]] = {}
    for motion in subject.motions.all:
        known = np.isfinite(motion.lower) & (np.arange(len(motion.names)) != motion.gripper)
        measured = np.append(0, np.cumsum((np.abs(np.diff(motion.state, axis=0)) > _STAYS).any(axis=1)))
        for element in np.flatnonzero(known).tolist():
            if motion.action is None or not np.isfinite(action := motion.action[:, element]).all():
                continue
            changes = np.flatnonzero(np.abs(np.diff(motion.state[:, element])) > _STAYS) + 1
            begins, ends = np.append(0, changes), np.append(changes, len(action)) - 1
            acted = np.maximum(ends - 1, begins)  # what the last frame is sent moves the one after it
            way = np.abs(action[acted] - action[begins]) * (measured[ends] > measured[begins])
            ways.setdefault(motion.names[element], []).extend(way[way > _GOES].tolist())
    if not ways:
        return Lacking(need=URDF)
    of_joint = {name: float(np.median(way)) for name, way in ways.items() if len(way) >= _FEWEST_TIMES}
    name = max(of_joint, key=lambda key: of_joint[key], default="")
    return Measurement(value=of_joint.get(name, 0.0), detail=f"{name}, {len(ways[name])} times" if name else "")


@motion_check(
    measures="step in which the readings of a joint come",
    unit="rad, m",
    warn=0.01,
    fail=math.inf,
    on=("external", "dataset"),
    needs=URDF,
)
def encoder_steps(subject: Recorded) -> Iterator[Found]:
    """A joint's readings are as fine as its encoder, a thousandth of a turn: catches angles in whole degrees or a byte.

    The step is the least distance of two of its values in all episodes, to which it comes back often: of a continuous
    reading no value comes twice.
    """
    columns: dict[str, list[Array]] = {}
    for motion in subject.motions.all:
        for element in np.flatnonzero(np.isfinite(motion.lower)).tolist():
            if element != motion.gripper:
                columns.setdefault(motion.names[element], []).append(motion.state[:, element])
    if not columns:
        yield Lacking(need=URDF)
    for name, parts in columns.items():
        yield Measurement(value=step_of(parts, _FEWEST_STEPS), detail=name)


def step_of(parts: Sequence[Array], fewest: int) -> float:
    """In which the values of all parts come, at least so many of them and each more than once; 0 of continuous ones."""
    steps = np.diff(np.unique(np.concatenate(parts)))
    steps = steps[steps > _STAYS]
    changes = sum(int((np.abs(np.diff(part)) > _STAYS).sum()) for part in parts)
    return float(steps.min()) if fewest <= len(steps) <= changes / _COMES_BACK else 0.0


@check(
    group="alignment",
    on=("dataset",),
    needs="an action",
    measures="step in which an element of the action comes, as a share of its deviation",
    warn=0.25,
    fail=math.inf,
)
def action_steps(dataset: Dataset) -> Iterator[Found]:
    """An action is finer than what it does: catches small increments that were rounded, or stored in a few bits. Keys
    and grippers, which know a few values, are left out."""
    feature = dataset.info.features.get(ACTION)
    if feature is None or not feature.is_numeric:
        yield Lacking(need="an action")
        return
    actions = [rows[ACTION].reshape(len(rows[ACTION]), -1).astype(np.float64) for rows in dataset.rows]
    for element in range(actions[0].shape[1] if actions else 0):
        name = feature.names[element] if feature.names and element < len(feature.names) else str(element)
        parts = [action[:, element] for action in actions]
        values = np.concatenate(parts)
        if not is_gripper(name) and np.ptp(values) > MOVES:
            yield Measurement(value=step_of(parts, _FEWEST_LEVELS) / float(values.std()), detail=name)


@check(
    group="alignment",
    on=("external", "dataset"),  # of simulated recordings `gripper_lag` knows when the motor may begin
    measures="frames by which a gripper moves before its command jumps",
    warn=1,
    fail=3,
    needs=GRIPPER,
)
@of_each_motion
def gripper_waits_for_action(motion: Motion) -> Found:
    """A gripper opens and closes after it was told to: catches actions that are late in one of the two directions."""
    if (told := told_gripper(motion)) is None:
        return Lacking(need=GRIPPER)
    command, opening = told[1], motion.state[:, told[0]]
    reach, before = float(np.ptp(command)), round(_HELD_S * 2 * motion.fps)
    found = []
    for frame in np.flatnonzero(np.abs(np.diff(command)) > _JUMP * max(reach, 1e-9)) + 1:
        if frame < before or np.ptp(command[frame - before : frame]) > _STILL * reach:
            continue
        direction = np.sign(command[frame] - command[frame - 1])
        moved = direction * (opening[frame - before : frame + 1] - opening[frame - before]) > _BEGUN * np.ptp(opening)
        ahead = int(moved[::-1].argmin()) if moved[-1] else 0  # frames in a row up to the command
        found.append(Measurement(value=ahead, frame=int(frame)))
    return worst(*found) or NotMeasured(why="the gripper's command never jumps after a pause")
