"""Laws of motion that hold for any robot, on every episode that has what they need, whoever recorded it.

An action is compared with the state where its elements are targets of the same joints.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property, partial
from typing import Protocol

import numpy as np

from demorec.check.base import (
    ACTIONS,
    EE_POSES,
    EFFORTS,
    GRIPPER,
    SENSED_TOPICS,
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
from demorec.check.dynamics import Dynamics, masses_of
from demorec.check.evidence import Flags, Motion
from demorec.check.rows import LinkMatrices, displacement, finest_lag, longest_run, matrices
from demorec.core.errors import SceneError
from demorec.core.geometry import Array
from demorec.episode.features import ACTION, EE_POSE, STATE, VELOCITY
from demorec.robots.urdf import Urdf

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
_SLOW = 0.05
"""Root mean square speed, rad/s or m/s, above which a joint is judged even where others move ten times as far."""
_MOVES = 1e-3
"""Range, rad or m, below which an element stands still."""
_SETTLE_S = 0.6
"""After a new command fingers need so long to arrive, closing at 0.2 m/s from 0.1 m; some jaws need longer."""
_STILL_FRAMES = 19
"""Of the arm's motion in which a sensor of another robot may stand still, if that is all of the episode."""
_LARGEST = 2.0
"""How many times as large as its model a robot may be built, or as small."""
_FITTED_FRAMES, _FITTED_EPISODES, _LEVER = 60, 20, 0.1
"""By which fixed mounts are found, and metres at which a turn counts beside a distance."""

EVERYWHERE: tuple[Form, ...] = ("simulated", "external", "dataset")

motion_check = partial(check, group="physics", on=EVERYWHERE)
target_check = partial(check, on=("external", "dataset"), needs=ACTIONS)
"""Of simulated recordings the commands are known, by which `command_tracking` and `command_lag` judge more sharply."""
_TOPICS = ("/{feature}", "/joint_states", "/action", "/command")


class Motions:
    """All motions of a dataset, or the one of a recording.

    Args:
        read: Gives them.
    """

    def __init__(self, read: Callable[[], Sequence[Motion]]) -> None:
        self._read = read

    @cached_property
    def all(self) -> Sequence[Motion]:
        """Of every episode that has a state."""
        return self._read()

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


class Moving(Protocol):
    """What the laws are about: it has motions."""

    @property
    def motions(self) -> Motions:
        """Of its episodes."""
        ...

    def dynamics_of(self, motion: Motion) -> Dynamics | NotMeasured | None:
        """The torques that a motion needs; None where the robot's model is not known."""
        ...


# -------------------------------------------------------------------------------------------------------------- laws


@motion_check(
    measures="how far the state, and what is sent to it, is beyond the limits of its joints",
    unit="rad, m",
    warn=0.01,
    fail=0.2,
    simulated=(0.005, 0.05),
    needs=URDF,
    reads=(STATE, *_TOPICS, "info.robot.position_lower", "info.robot.position_upper"),
)
def joint_limits(subject: Moving) -> Iterator[Found]:
    """Joints are within the limits of the robot's URDF: catches degrees for radians, and offsets."""
    for motion in subject.motions.all:
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
    fail=3,
    simulated=(1.1, 1.5),
    needs=URDF,
    reads=(STATE, *_TOPICS, "info.robot.velocity_limit"),
)
def joint_speed(subject: Moving) -> Iterator[Found]:
    """No joint is faster than its motor: catches wrong rates, spikes, and episodes glued together.

    By the recorded velocities too where these are known to be those of the joints.
    """
    for motion in subject.motions.all:
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
    reads=(STATE, VELOCITY, "/{feature}", "/joint_states", "info.fps"),
)
def velocity_matches_position(subject: Moving) -> Found:
    """States change by velocity over time, each joint by itself, all episodes together: catches a wrong rate,
    other units, and other joints' velocities."""
    pairs = [motion for motion in subject.motions.all if motion.velocity is not None and len(motion.state) > 1]
    if not pairs:
        return Lacking(need=VELOCITIES)
    sums, count = np.zeros((3, len(pairs[0].names))), 0
    for motion in pairs:
        assert motion.velocity is not None
        mean = (motion.velocity[1:] + motion.velocity[:-1]) / 2
        ways = np.vstack([np.zeros(mean.shape[1]), np.cumsum(mean * motion.steps_s[:, None], axis=0)])
        reach = min(max(1, round(_VELOCITY_S * motion.fps)), len(ways) - 1)
        told, moved = ways[reach:] - ways[:-reach], motion.state[reach:] - motion.state[:-reach]
        count += len(moved)
        sums += [(moved * told).sum(axis=0), (told * told).sum(axis=0), (moved * moved).sum(axis=0)]
    known = np.flatnonzero(np.isfinite(sums[0]) & (sums[2] > 0))
    if not len(known):
        return None
    names = [pairs[0].names[element] for element in known]
    found = sums[:, known]
    if pairs[0].fps < _FEW_FPS:  # two velocities say little of the way between: what joints do in truth shows in all
        found, names = found.sum(axis=1, keepdims=True), ["all joints"]
    product, square, total = found
    ratio = product / np.maximum(square, 1e-12)
    # Of a joint that hardly moves, beside the others or at all, noise decides.
    moves = (total > 0.01 * total.max()) | (total > count * (_SLOW * _VELOCITY_S) ** 2)
    off = np.abs(ratio - 1) * moves * min(1.0, pairs[0].fps / _FEW_FPS)
    worst = int(np.argmax(off))
    return Measurement(value=float(off[worst]), detail=f"{names[worst]}: ratio {ratio[worst]:.3f}")


@target_check(
    measures="frames by which the state is too early for its action, or too late",
    warn=0.75,
    fail=1.5,
    group="alignment",
    reads=(STATE, ACTION, *_TOPICS),
)
def state_follows_action(subject: Moving) -> Found:
    """The state follows the action by about a frame or more, and by less than a third of a second: catches actions that
    were recorded late or early, or that are the state itself, from which a policy learns to stand still."""
    if not (targets := subject.motions.targets):
        return NotMeasured(why=_NO_TARGETS)
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
    told = np.flatnonzero(off.min(axis=0) < 0.8 * np.minimum(off[0], off[-1]))
    if not len(told):
        return NotMeasured(why="state and action move too little to tell which of them is first")
    # The middle one: a gripper is slower than the arm, and stops at what it holds.
    lag = float(np.median([finest_lag(lags, off[:, element].tolist()) for element in told]))
    late = lag - _LATEST_S * subject.motions.all[0].fps
    return Measurement(value=max(1 - lag, late, 0.0), detail=f"the state follows by {lag:+.2f} frames")


@target_check(
    measures="elements of the state that follow the action of another one",
    group="alignment",
    reads=(STATE, ACTION, *_TOPICS),
)
def actions_in_order(subject: Moving) -> Found:
    """Every element of the state follows its own action: catches joints exchanged in one of the two."""
    if not (targets := subject.motions.targets):
        return NotMeasured(why=_NO_TARGETS)
    table = _correlations(targets)
    count = len(table)
    names = [name for name, moves in zip(subject.motions.all[0].names, subject.motions.moving, strict=True) if moves]
    best = table.argmax(axis=1)
    # Two joints of one motion may go alike; an exchange shows where an element hardly follows its own action at all.
    wrong = [i for i in range(count) if best[i] != i and table[i, best[i]] - table[i, i] > 0.3]
    told = [f"{names[i]} follows that of {names[best[i]]}" for i in wrong]
    return Measurement(value=len(wrong), detail="; ".join(told[:3]))


@target_check(
    group="physics",
    measures="distance at which a joint always stays from its action",
    unit="rad, m",
    warn=0.1,
    fail=0.3,
    reads=(STATE, ACTION, *_TOPICS),
)
def state_reaches_action(subject: Moving) -> Found:
    """A joint that is held comes to where it was sent, at least at some time: catches a zero that is off.

    Weight and friction keep an arm off by a few hundredths of a rad, and what a gripper holds keeps its fingers apart;
    only a false zero does so always. Velocities, increments and shares of a range are no places to be at.
    """
    if not (targets := subject.motions.targets):
        return NotMeasured(why=_NO_TARGETS)
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
    measures="elements of the state that never change while their action does",
    needs=ACTIONS,
    reads=(STATE, ACTION, *_TOPICS),
)
def elements_alive(subject: Moving) -> Found:
    """Encoders are alive: no element stays at one value in all episodes while what it is sent changes."""
    pairs = [motion for motion in subject.motions.all if motion.action is not None and len(motion.state) >= _FEWEST]
    if not pairs:
        return Lacking(need=ACTIONS)
    stands = np.all([np.ptp(motion.state, axis=0) == 0 for motion in pairs], axis=0)
    sent = np.any([np.ptp(_action(motion), axis=0) > 50 * _MOVES for motion in pairs], axis=0)
    dead = [name for name, is_dead in zip(pairs[0].names, stands & sent, strict=True) if is_dead]
    return Measurement(value=len(dead), detail=", ".join(dead))


@motion_check(
    measures="longest run of frames in which a sensor stands still to the last bit while the arm moves",
    warn=_STILL_FRAMES,
    fail=math.inf,
    simulated=(2, 4),
    needs=STATE_ALONE,
    reads=(STATE, VELOCITY, EE_POSE, "/{feature}", "/joint_states", "/ee_pose", *SENSED_TOPICS),
)
def stuck_sensors(subject: Moving) -> Iterator[Found]:
    """What is measured changes, if ever so little, while the arm moves.

    Of other robots than simulated ones a sensor is reported that never changes in an episode.
    """
    for motion in subject.motions.all:
        moves = np.abs(np.diff(motion.state, axis=0)).max(axis=1, initial=0.0) > 1e-5
        if motion.contact is not None:
            moves = np.abs(np.diff(motion.state[:, :-1], axis=0)).max(axis=1, initial=0.0) > 1e-5
        for name, table in motion.sensors.items():
            same = (table[1:] == table[:-1]).all(axis=1) & moves
            length, start = longest_run(same)
            if motion.contact is None:  # sensors slower than the frames hold a value, and contacts come and go
                length, start = int(same.sum() * (np.ptp(table, axis=0) == 0).all()), 0
            label = f"{name}, {motion.where}" if motion.where else name
            yield Measurement(value=length, frame=start + 1 if length else None, detail=label)


@check(
    group="physics",
    on=("external", "dataset"),  # of simulated recordings the mounts are known: `forward_kinematics` judges these
    measures="how far the EE pose strays from the joints' forward kinematics, between fixed mounts, nine tenths of it",
    unit="m",
    warn=0.02,
    fail=0.05,
    needs=EE_POSES,
    reads=(STATE, EE_POSE, "/{feature}"),
)
def pose_follows_joints(subject: Moving) -> Iterator[Found]:
    """The hand goes where the joints take it, whatever its frame and the base's are: catches exchanged joints,
    other units and orders of a quaternion, and some zeros that are off. 0.1 m are added for each rad of rotation.

    A robot that is known by the names of its joints may be built larger or smaller, to half or double.
    """
    motions = subject.motions.all
    for motion in motions[:: max(1, len(motions) // _FITTED_EPISODES)]:
        if motion.ee_pose is None or motion.urdf is None:
            yield Lacking(need=EE_POSES)
            return
        if motion.tcp_link:
            yield NotMeasured(why="the link is known of which these are the poses, and forward_kinematics judges them")
            continue
        if len(motion.state) < _FEWEST:
            yield NotMeasured(why=f"an episode has fewer than {_FEWEST} frames")
            continue
        links = LinkMatrices(motion.urdf, motion.joint_position, len(motion.state))
        last = [joint.child for joint in motion.urdf.depth_first() if joint.name in motion.joint_position][-1]
        off = _mounted(links[last], matrices(motion.ee_pose))
        frame = int(np.argmax(off))
        yield Measurement(value=float(np.quantile(off, 0.9)), frame=frame, detail=motion.where)


def _mounted(links: Array, poses: Array) -> Array:
    """(T,) metres by which poses (T, 4, 4) are off X @ links @ Y, for the fixed X and Y and the size that fit best."""
    from scipy.optimize import least_squares
    from scipy.spatial.transform import Rotation

    def fixed(numbers: Array) -> Array:
        out = np.eye(4)
        out[:3, :3], out[:3, 3] = Rotation.from_rotvec(numbers[:3]).as_matrix(), numbers[3:]
        return out

    def placed(numbers: Array, links: Array) -> Array:
        sized = links.copy()
        sized[:, :3, 3] *= _LARGEST ** math.tanh(numbers[12])
        return np.asarray(fixed(numbers[:6]) @ sized @ fixed(numbers[6:12]))

    rows = np.unique(np.linspace(0, len(links) - 1, _FITTED_FRAMES).astype(int))

    def residual(numbers: Array) -> Array:
        off = placed(numbers, links[rows]) - poses[rows]
        return np.asarray((off[:, :3] * [_LEVER, _LEVER, _LEVER, 1.0]).reshape(-1))

    best = None
    for yaw in np.arange(4) * (math.pi / 2):  # bases that are turned may be far from each other's fit
        start = np.array([0.0, 0.0, yaw, 0.0, 0.0, 0.0])
        mount = np.linalg.inv(fixed(start) @ links[0]) @ poses[0]
        guess = np.concatenate([start, Rotation.from_matrix(mount[:3, :3]).as_rotvec(), mount[:3, 3], [0.0]])
        found = least_squares(residual, guess)
        best = found if best is None or found.cost < best.cost else best
        if best.cost < 1e-3 * _LEVER * len(rows):
            break
    assert best is not None
    return displacement(placed(best.x, links), poses)


@motion_check(
    measures="gripper opening against a command that it has had the time to follow, as a share of what is commanded",
    warn=0.25,
    fail=0.5,
    needs=GRIPPER,
    reads=(STATE, ACTION, "/{feature}", "/gripper", "/command", "/joint_states"),
)
def gripper_follows(subject: Moving) -> Iterator[Found]:
    """The fingers stand where they were told to, or further apart where something is between them.

    Catches openings and commands that are inverted, halved or frozen. Whether something is between the fingers says
    the force on them; where nobody measures it, they may be kept open by it whenever they were told to close.
    """
    for motion in subject.motions.all:
        place = motion.gripper
        if place is None or motion.action is None or not np.isfinite(motion.action[:, place]).all():
            yield Lacking(need=GRIPPER)
            return
        yield _followed(motion, place, motion.commands.get("command", motion.action)[:, place])


def _followed(motion: Motion, place: int, command: Array) -> Found:
    settle_s = max(_SETTLE_S, motion.stroke_s + 0.1)
    opening, wait = motion.state[:, place], math.ceil(settle_s * motion.fps)
    span = float(motion.upper[place] - motion.lower[place])
    reach = span if math.isfinite(span) else float(np.ptp(command))
    if len(command) <= wait:
        return NotMeasured(why=f"an episode is shorter than {settle_s:g} s")
    # Of increments and speeds nothing is told: they are small beside the opening, and come back to 0.
    if reach < 0.2 * float(np.ptp(opening)) or reach < 1e-4:
        return NotMeasured(why="the gripper's command is none of its opening, or never changes")
    steady = np.ones(len(command), dtype=np.bool_)
    for back in range(1, wait + 1):
        steady[back:] &= np.abs(command[back:] - command[:-back]) < 1e-3 * reach
    steady[:wait] = False
    if not steady.any():
        return NotMeasured(why="the gripper's command never lasts")
    gap = opening - command
    is_open = command > command.min() + 0.5 * reach
    holds = ~is_open if motion.contact is None else motion.contact > 0
    off = np.where(holds, np.maximum(-gap, 0.0), np.abs(gap)) / reach
    where = f", {motion.where}" if motion.where else ""
    return worst_frame(np.where(steady, off, 0.0), f"{int(steady.sum())} frames after the motion{where}")


@motion_check(
    measures="torques of the arm against inverse dynamics, median difference of the load",
    warn=0.6,
    fail=math.inf,
    needs=EFFORTS,
    reads=(
        "/joint_states",
        "info.scene.physics.gravity",
        "info.scene.bodies.mass",
        "/robot_description",
        "/{feature}",
    ),
)
def effort_matches_dynamics(subject: Moving) -> Iterator[Found]:
    """The motors of the joints that bear the arm give the torques that its weight and motion need.

    Catches torques of other joints, of another sign or unit, halved or frozen. Of other robots than simulated ones the
    load in the hand and the friction are not known, and some drivers leave out the weight: they are only warned of.
    """
    for motion in subject.motions.all:
        dynamics = subject.dynamics_of(motion)
        if motion.effort is None or dynamics is None:
            yield Lacking(need=EFFORTS)
            return
        yield dynamics if isinstance(dynamics, NotMeasured) else dynamics.compare(motion.joints, motion.effort)


def point_masses(motion: Motion) -> Dynamics | NotMeasured | None:
    """Inverse dynamics of an arm that stands upright and carries nothing; None where its model is not known."""
    if motion.urdf is None or not motion.model:
        return None
    try:
        masses = masses_of(motion.model)
    except SceneError as error:
        return NotMeasured(why=f"the robot's masses are not to be had here: {error}")
    links = LinkMatrices(motion.urdf, motion.joint_position, len(motion.state))
    masses = {link: mass for link, mass in masses.items() if link == motion.urdf.root or link in _children(motion.urdf)}
    tip = [joint.child for joint in motion.urdf.depth_first() if joint.name in motion.joint_position][-1]
    down = np.array([0.0, 0.0, -9.81])
    return Dynamics(links.__getitem__, motion.urdf, masses, gravity=down, fps=motion.fps, tip=tip)


def _children(urdf: Urdf) -> set[str]:
    return {joint.child for joint in urdf.joints}


_NO_TARGETS = "the action is no target of the state's elements (by their names and courses)"
