"""Laws of motion that hold for any robot, on every episode that has the features they need, whoever recorded it.

What is known of the elements of `observation.state` comes from the recording or the sidecar, or from the robot whose
joints their names are. An action is compared with the state where its elements are targets of the same joints.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray

from demorec.check.base import Found, Measurement, NotMeasured, check, worst_entry
from demorec.check.dataset import Dataset
from demorec.check.rows import finest_lag
from demorec.core.geometry import Array
from demorec.datasets.lerobot.robots import ELEMENT_SUFFIX, recognised_robot
from demorec.episode.features import ACTION, STATE, VELOCITY
from demorec.mcap import Recording
from demorec.robots.urdf import Urdf

GRIPPER = "gripper.width"
"""The element that is the opening of a simulated gripper, metres."""
_REACH_S = 1.0
"""How far apart in time an action and the state that follows it are looked for, seconds."""
_LATEST_S = 0.35
"""How far behind its action a state may be, seconds: hobby servos under teleoperation need 0.1 to 0.2."""
_FEW_FPS = 20
"""Frames a second below which exploration noise moves a joint to and fro between two frames."""
_HELD_S = 0.3
"""How long an action has not changed before its joint should be there, seconds."""
_FEWEST = 30
"""Frames below which an episode says nothing of lags and orders."""
_OWN = 0.5
"""Correlation with its own element above which an action is a target of the state: 0.97 and more in demonstrations of
Panda and iiwa, where increments and poses have 0.3 and less."""
_ALIKE = 3.0
"""Times the movement of the state that an action of its unit may move: teleoperation is scaled to half or double."""
_VELOCITY_S = 0.3
"""Over which velocities are added up: filters of drivers are 20 to 100 ms late, which cancels over longer times."""
_MOVES = 1e-3
"""Range, rad or m, below which an element stands still."""

Flags = NDArray[np.bool_]

motion_check = partial(check, group="physics", scope="motion", reads=(STATE, ACTION, VELOCITY, "/{feature}"))


@dataclass(frozen=True, kw_only=True, eq=False)
class Motion:
    """How a robot moves in one episode; elements are those of observation.state.

    Attributes:
        where: "episode 3", or "" where there is only one.
        fps: Frames per second.
        steps_s: (T - 1,) time from each frame to the next, seconds.
        names: Of the D elements.
        state: (T, D) rad or m where the joint is known, else as it came.
        velocity, action: (T, D) of the same elements and units, NaN where an element has none; None for no element.
        lower, upper: (D,) limits; infinite where they are not known.
        speed: (D,) largest speed, rad/s or m/s; infinite where it is not known.
    """

    where: str
    fps: float
    steps_s: Array
    names: tuple[str, ...]
    state: Array
    velocity: Array | None
    action: Array | None
    lower: Array
    upper: Array
    speed: Array


class Motions:
    """All motions of a dataset, or the one of a recording.

    Args:
        subject: It, open.
    """

    def __init__(self, subject: Dataset | Recording) -> None:
        self._subject = subject

    @cached_property
    def all(self) -> Sequence[Motion]:
        """Of every episode that has a state."""
        return list(_of_dataset(self._subject) if isinstance(self._subject, Dataset) else _of_recording(self._subject))

    @cached_property
    def targets(self) -> list[tuple[Array, Array]]:
        """(T, K) states and actions of each episode, of the K elements that have an action and move; less their means
        and in units of the state's deviation. Empty where the action is no target of the state."""
        pairs = [motion for motion in self.all if motion.action is not None and len(motion.state) >= _FEWEST]
        kept = self.moving
        if not pairs or not kept.any():
            return []
        found = [
            (_scaled(motion.state, motion.state)[:, kept], _scaled(_action(motion), motion.state)[:, kept])
            for motion in pairs
        ]
        own = np.diag(_correlations(found))
        return found if float(np.median(own)) > _OWN else []

    @cached_property
    def moving(self) -> Flags:
        """(D,) elements that have an action, and of which state and action change in some episode."""
        moves = [
            (np.ptp(motion.state, axis=0) > _MOVES) & (np.ptp(_action(motion), axis=0) > _MOVES)
            for motion in self.all
            if motion.action is not None
        ]
        return np.asarray(np.any(moves, axis=0)) if moves else np.zeros(0, dtype=np.bool_)


def _action(motion: Motion) -> Array:
    assert motion.action is not None
    return motion.action


def _scaled(values: Array, state: Array) -> Array:
    return np.asarray((values - values.mean(axis=0)) / np.maximum(state.std(axis=0), _MOVES))


def _correlations(targets: Sequence[tuple[Array, Array]]) -> Array:
    """(K, K) of each element of the state with each of the action, over all episodes; 0 where one does not change."""
    state, action = (np.concatenate(part) for part in zip(*targets, strict=True))
    size = np.sqrt(np.outer((state**2).sum(axis=0), (action**2).sum(axis=0)))
    return np.asarray(state.T @ action / np.maximum(size, 1e-12))


# ------------------------------------------------------------------------------------------------------ what is known


def _motion(
    where: str,
    fps: float,
    features: Mapping[str, Array],
    names: Mapping[str, Sequence[str]],
    joints: Sequence[str],
    units: Mapping[str, Sequence[str]],
    urdf: Urdf | None,
    *,
    opening: float = math.inf,
    time_ns: NDArray[np.int64] | None = None,
) -> Motion:
    state, elements = features[STATE].astype(np.float64), names[STATE]
    known = {} if urdf is None else {joint.name: joint for joint in urdf.joints}
    found = [known.get(joint) for joint in joints] or [None] * len(elements)
    lower = np.array([-math.inf if joint is None else joint.lower for joint in found])
    upper = np.array([math.inf if joint is None else joint.upper for joint in found])
    if opening < math.inf and GRIPPER in elements:
        place = list(elements).index(GRIPPER)
        lower[place], upper[place] = 0.0, opening

    def factor(feature: str) -> Array:
        """(D,) from the feature's own units: a leader may tell degrees of an arm that tells rad."""
        degrees = [math.radians(1) if unit in ("deg", "degree") else 1.0 for unit in units.get(feature, ())]
        return np.array(degrees if len(degrees) == len(names[feature]) else [1.0] * len(names[feature]))

    def alike(feature: str) -> Array | None:
        """The elements of another feature that have the names of the state's, or all of as many without names."""
        if feature not in features:
            return None
        values, theirs = features[feature].astype(np.float64) * factor(feature), names[feature]
        places = {ELEMENT_SUFFIX.sub("", name): index for index, name in enumerate(theirs)}
        columns = [places.get(ELEMENT_SUFFIX.sub("", name)) for name in elements]
        if all(column is None for column in columns):
            return None
        missing = np.full(len(state), np.nan)
        return np.stack([missing if column is None else values[:, column] for column in columns], axis=1)

    velocity, action = alike(VELOCITY), alike(ACTION)
    return Motion(
        where=where,
        fps=fps,
        steps_s=np.full(len(state) - 1, 1 / fps) if time_ns is None else np.maximum(np.diff(time_ns) / 1e9, 0.5 / fps),
        names=tuple(elements),
        state=state * factor(STATE),
        velocity=velocity,
        action=action,
        lower=lower,
        upper=upper,
        speed=np.array([math.inf if joint is None else joint.max_speed for joint in found]),
    )


def _of_recording(recording: Recording) -> Iterator[Motion]:
    info, columns = recording.info, recording.columns()
    described = {feature.name: feature for feature in info.features}
    if STATE not in described or not columns.num_frames:
        return
    state = described[STATE]
    names = {name: feature.names for name, feature in described.items()}
    joints, urdf = state.joints, Urdf.parse(info.urdf) if info.urdf else None
    if urdf is None and (robot := recognised_robot(state.names)) is not None:
        joints, urdf = robot.record.joints[STATE], robot.model
    units = {name: feature.units for name, feature in described.items()}
    yield _motion("", info.fps, columns.features, names, joints, units, urdf, time_ns=columns.time_ns)


def _of_dataset(dataset: Dataset) -> Iterator[Motion]:
    features = dataset.info.features
    if STATE not in features or features[STATE].dtype not in ("float32", "float64"):
        return
    names = {
        name: features[name].names or tuple(map(str, range(features[name].shape[0])))
        for name in (STATE, VELOCITY, ACTION)
        if name in features
    }
    stranger = recognised_robot(tuple(names[STATE]))
    for number, rows in enumerate(dataset.rows):
        digest = dataset.robot_digests.get(number)
        robot = stranger if digest is None else dataset.robots[digest]
        joints: Sequence[str] = ()
        units: Mapping[str, Sequence[str]] = {}
        urdf, opening = None, math.inf
        if robot is not None:
            joints, units = robot.record.joints.get(STATE, ()), robot.record.units
            urdf, spec = robot.model, robot.record.spec
            opening = math.inf if spec is None else spec.gripper.max_width
        yield _motion(f"episode {number}", dataset.info.fps, rows, names, joints, units, urdf, opening=opening)


# -------------------------------------------------------------------------------------------------------------- laws


@motion_check(measures="how far joints are beyond their limits", unit="rad, m", warn=0.01, fail=0.2)
def joint_limits(motions: Motions) -> Iterator[Found]:
    """Observed joints are within the limits of the robot's URDF: catches degrees for radians, and offsets."""
    for motion in motions.all:
        known = np.isfinite(motion.lower) | np.isfinite(motion.upper)
        if not known.any():
            yield NotMeasured(why="no element of the state is known to be the position of a joint with limits")
            return
        beyond = np.maximum(np.maximum(motion.lower - motion.state, motion.state - motion.upper), 0.0)
        yield worst_entry(beyond[:, known], _labels(motion, known))


@motion_check(measures="speed of joints against the limit of their URDF, ratio", warn=1.2, fail=3)
def joint_speed(motions: Motions) -> Iterator[Found]:
    """No joint is faster than its motor: catches wrong rates, spikes, and episodes glued together."""
    for motion in motions.all:
        known = np.isfinite(motion.speed) & (motion.speed > 0)
        if not known.any():
            yield NotMeasured(why="no element of the state is known to be the position of a joint with a speed limit")
            return
        speed = np.abs(np.diff(motion.state[:, known], axis=0)) / motion.steps_s[:, None] / motion.speed[known]
        yield worst_entry(speed, _labels(motion, known), first=1)


@motion_check(measures="ratio of state differences to velocities, off 1", warn=0.1, fail=0.16)
def state_matches_velocity(motions: Motions) -> Found:
    """States change by velocity over time, each joint by itself, all episodes together: catches a wrong rate,
    other units, and other joints' velocities."""
    pairs = [motion for motion in motions.all if motion.velocity is not None and len(motion.state) > 1]
    if not pairs:
        return None
    sums = np.zeros((3, len(pairs[0].names)))
    for motion in pairs:
        assert motion.velocity is not None
        mean = (motion.velocity[1:] + motion.velocity[:-1]) / 2
        ways = np.vstack([np.zeros(mean.shape[1]), np.cumsum(mean * motion.steps_s[:, None], axis=0)])
        reach = min(max(1, round(_VELOCITY_S * motion.fps)), len(ways) - 1)
        told, moved = ways[reach:] - ways[:-reach], motion.state[reach:] - motion.state[:-reach]
        sums += [(moved * told).sum(axis=0), (told * told).sum(axis=0), (moved * moved).sum(axis=0)]
    known = np.flatnonzero(np.isfinite(sums[0]) & (sums[2] > 0))
    if not len(known):
        return None
    names = [pairs[0].names[element] for element in known]
    found = sums[:, known]
    if pairs[0].fps < _FEW_FPS:  # two velocities say little of the way between: what joints do in truth shows in all
        found, names = found.sum(axis=1, keepdims=True), ["all joints"]
    product, square, total = found
    ratio, share = product / np.maximum(square, 1e-12), total / total.max()
    # Of a joint that hardly moves, noise decides.
    off = np.abs(ratio - 1) * (share > 0.01) * min(1.0, pairs[0].fps / _FEW_FPS)
    worst = int(np.argmax(off))
    return Measurement(value=float(off[worst]), detail=f"{names[worst]}: ratio {ratio[worst]:.3f}")


@motion_check(
    measures="frames by which the state is too early for its action, or too late",
    warn=0.75,
    fail=1.5,
    group="alignment",
)
def state_follows_action(motions: Motions) -> Found:
    """The state follows the action by about a frame or more, and by less than a third of a second: catches actions that
    were recorded late or early, or that are the state itself, from which a policy learns to stand still."""
    if not (targets := motions.targets):
        return NotMeasured(why=_NO_TARGETS)
    reach = max(2, round(_REACH_S * motions.all[0].fps))
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
    told = np.flatnonzero(off.min(axis=0) < 0.8 * np.minimum(off[0], off[-1]))
    if not len(told):
        return NotMeasured(why="state and action move too little to tell which of them is first")
    # The middle one: a gripper is slower than the arm, and stops at what it holds.
    lag = float(np.median([finest_lag(lags, off[:, element].tolist()) for element in told]))
    late = lag - _LATEST_S * motions.all[0].fps
    return Measurement(value=max(1 - lag, late, 0.0), detail=f"the state follows by {lag:+.2f} frames")


@motion_check(measures="elements of the state that follow the action of another one", group="alignment")
def actions_in_order(motions: Motions) -> Found:
    """Every element of the state follows its own action: catches joints exchanged in one of the two."""
    if not (targets := motions.targets):
        return NotMeasured(why=_NO_TARGETS)
    table = _correlations(targets)
    count = len(table)
    names = [name for name, moves in zip(motions.all[0].names, motions.moving, strict=True) if moves]
    best = table.argmax(axis=1)
    # Two joints of one motion may go alike; an exchange shows where an element hardly follows its own action at all.
    wrong = [i for i in range(count) if best[i] != i and table[i, best[i]] - table[i, i] > 0.3]
    told = [f"{names[i]} follows that of {names[best[i]]}" for i in wrong]
    return Measurement(value=len(wrong), detail="; ".join(told[:3]))


@motion_check(measures="distance at which a joint always stays from its action", unit="rad, m", warn=0.1, fail=0.3)
def state_reaches_action(motions: Motions) -> Found:
    """A joint that is held comes to where it was sent, at least at some time: catches a zero that is off.

    Weight and friction keep an arm off by a few hundredths of a rad, and what a gripper holds keeps its fingers apart;
    only a false zero does so always. Velocities, increments and shares of a range are no places to be at.
    """
    if not (targets := motions.targets):
        return NotMeasured(why=_NO_TARGETS)
    spread = float(np.median([np.nanmedian(action.std(axis=0)) for _, action in targets]))
    if not 1 / _ALIKE < spread < _ALIKE:
        return NotMeasured(why=f"actions move {spread:.3g} times as far as the state, so they are in another unit")
    offsets: dict[str, list[Array]] = {}
    for motion in motions.all:
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


@motion_check(measures="elements of the state that never change while their action does")
def elements_alive(motions: Motions) -> Found:
    """Encoders are alive: no element stays at one value in all episodes while what it is sent changes."""
    pairs = [motion for motion in motions.all if motion.action is not None and len(motion.state) >= _FEWEST]
    if not pairs:
        return NotMeasured(why="no element of the state has an action of its own")
    stands = np.all([np.ptp(motion.state, axis=0) == 0 for motion in pairs], axis=0)
    sent = np.any([np.ptp(_action(motion), axis=0) > 50 * _MOVES for motion in pairs], axis=0)
    dead = [name for name, is_dead in zip(pairs[0].names, stands & sent, strict=True) if is_dead]
    return Measurement(value=len(dead), detail=", ".join(dead))


_NO_TARGETS = "the action is no target of the state's elements (by their names and courses)"


def _labels(motion: Motion, known: Flags) -> list[str]:
    return [
        f"{name}, {motion.where}" if motion.where else name
        for name, is_known in zip(motion.names, known, strict=True)
        if is_known
    ]
