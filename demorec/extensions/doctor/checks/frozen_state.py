"""Checks of readings that stop changing while the robot moves."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from demorec.check.base import Fault, NotMeasuredError, check
from demorec.core.geometry import Array
from demorec.extensions.doctor.checks.numbers import MIN_OTHERS, element_name
from demorec.extensions.doctor.evidence import DROP, EpisodeEvidence, Evidence
from demorec.extensions.doctor.relation import relation_of
from demorec.extensions.doctor.robust import runs
from demorec.extensions.doctor.units import moving_elements, other_units, state_bounds

MIN_FROZEN_S = 0.4
MIN_FROZEN_FRAMES = 5
"""Minimum number of frames of a frozen state."""
MIN_FROZEN_RANGE = 0.3
"""Minimum range of the action, as a ratio of the usual one, while an element of the state is constant, bit-exact."""
MIN_FROZEN_ERRORS = 2.0
"""Minimum factor of the distance between action and a frozen element over the usual one: a hobby servo holds its joint
for seconds while the difference is within its dead band and load."""
MIN_COMMANDED_RANGE = 0.1
"""Minimum range of an element's action, relative to the usual one, at which the element must move."""
MAX_FLICKER = 0.01
"""Maximum range of an element that does not move, relative to the usual one: an encoder flickers by a tick or two."""
MIN_UNCOMMANDED_RANGE = 0.3
"""Minimum range of an element without commands, relative to the arm's usual one: load and sag move a joint less."""
MAX_END_STOP_RANGE = 0.02
"""Maximum distance from an end stop, as a ratio of the range in the whole set, at which an element counts as there."""
MIN_LIVE_SHARE = 0.5
"""Minimum ratio of moving frames in which a sensor changes, for its rests to be judged."""
MIN_REST_S = 0.3
MIN_BROKEN_S = 1.0
REST_TIMES = 4.0
"""Minimum factor over the usual longest rest of the other episodes."""
MIN_SPEED = 0.3
"""Minimum speed, relative to the root mean square, at which the robot counts as moving."""


@check(
    family="numbers",
    needs="state",
    measures="readings of the state that stop changing",
    unit="s",
    why="The policy sees a robot that does not move while it acts.",
    do=DROP,
)
def frozen_state(evidence: Evidence) -> Iterator[Fault]:
    """Find elements with a bit-exact constant value while their action moves on, and whole states of this kind.

    The action must be more than twice its usual distance away from the element: servos hold a joint within their dead
    band, under load, and at end stops. Without an action, a whole state counts as frozen if it continues with a jump.
    An element that never changes in any episode while its action does is a fault of the whole set, and so is an action
    that never changes while its element moves.
    """
    episodes = evidence.need_state(8)
    yield from _never_moving(evidence, episodes)
    yield from _never_acting(evidence, episodes)
    targets = _targets(evidence, episodes)
    needed = max(MIN_FROZEN_FRAMES, round(MIN_FROZEN_S * evidence.fps))
    faults: list[Fault] = []
    others = evidence.once(other_units)
    for episode, state in episodes:
        if episode.number in others:
            continue
        fault = _frozen_element(evidence, targets, episode, state, needed) or _frozen_whole(
            evidence, episode, state, needed
        )
        if fault is not None:
            faults.append(fault)
    if len(faults) > max(MIN_OTHERS, len(episodes) / 2):
        yield Fault(
            severity="look",
            value=f"{len(faults)} of {len(episodes)} episodes",
            message=f"{faults[0].message}; so in {len(faults)} of {len(episodes)} episodes",
            do="compare the state with the command in the recorder: a blocked joint, or one that is not read",
        )
    else:
        yield from faults


def _never_moving(evidence: Evidence, episodes: Sequence[tuple[EpisodeEvidence, Array]]) -> Iterator[Fault]:
    """Find elements of the arm that are constant, but for a flicker, while their action moves as far as others."""
    acting = [each.action for each, _ in episodes if each.action is not None]
    if not acting:
        return
    spans = np.median(np.stack([np.ptp(action, axis=0) for action in acting]), axis=0)
    usual_span = float(np.median(spans[spans > 0])) if (spans > 0).any() else 0.0
    commanded = [element for element, column in enumerate(evidence.action_of) if column is not None]
    usual_range = float(np.median(evidence.ranges[commanded])) if commanded else 0.0
    names = []
    for element, column in enumerate(evidence.action_of):
        if column is None or evidence.is_gripper[element] or evidence.ranges[element] > MAX_FLICKER * usual_range:
            continue
        if spans[column] > MIN_COMMANDED_RANGE * usual_span > 0:
            names.append(element_name(evidence, element))
    if names:
        yield Fault(
            severity="broken",
            value="0",
            message=f"{', '.join(names)}: the state never changes although the action does",
            do="record the joint's own position",
        )


def _never_acting(evidence: Evidence, episodes: Sequence[tuple[EpisodeEvidence, Array]]) -> Iterator[Fault]:
    """Find elements of the arm that move as far as others while their action has one value in all episodes."""
    acting = [each.action for each, _ in episodes if each.action is not None]
    pairs = [(e, c) for e, c in enumerate(evidence.action_of) if c is not None and not evidence.is_gripper[e]]
    if not acting or not pairs:
        return
    usual_range = float(np.median([evidence.ranges[element] for element, _ in pairs]))
    constant = np.ptp(np.concatenate(acting), axis=0) == 0
    names = [
        element_name(evidence, element)
        for element, column in pairs
        if constant[column] and evidence.ranges[element] > MIN_UNCOMMANDED_RANGE * usual_range > 0
    ]
    if names:
        yield Fault(
            severity="look",  # a finger that another one drives moves like this
            value="0",
            message=f"{', '.join(names)}: the state moves although the action never changes",
            do="record the command that was sent to these joints, unless they have no motor",
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class _ElementTarget:
    """Target of one element of the state, frame by frame, according to the action.

    Attributes:
        element: Its index in the state.
        kind: "increment": only changes of the target are known.
        wanted: Episode number -> (T,) target, at the frames at which the state usually reaches it.
        min_distance: Minimum distance of a state that does not follow.
        offset: Usual difference between target and state.
        end_stops: Lowest and highest position; infinite if unknown.
    """

    element: int
    kind: Literal["target", "increment"]
    wanted: Mapping[int, Array]
    min_distance: float
    offset: float
    end_stops: tuple[float, float]

    def unfollowed(self, number: int, held: float, first: int, end: int) -> Array:
        """Compute (N,) distance of the held state from its target in some frames, excluding end stops."""
        wanted = self.wanted[number][first : end + 1]
        found = wanted - (wanted[0] if self.kind == "increment" else held + self.offset)
        lowest, highest = self.end_stops
        if held <= lowest:
            found = np.maximum(found, 0.0)
        if held >= highest:
            found = np.minimum(found, 0.0)
        return found


def _targets(evidence: Evidence, episodes: Sequence[tuple[EpisodeEvidence, Array]]) -> list[_ElementTarget]:
    """Compute the targets of the arm's elements; empty if the state does not follow its action."""
    try:
        relation = evidence.once(relation_of)
    except NotMeasuredError:
        return []
    lag, moves = max(round(relation.usual_lag), 0), evidence.once(moving_elements)
    lowest, highest = evidence.once(state_bounds)
    margin = MAX_END_STOP_RANGE * (highest - lowest)
    found = []
    for element, column in enumerate(evidence.action_of):
        if column is None or evidence.is_gripper[element] or not moves[element]:
            continue
        wanted = {each.number: each.action[:, column] for each, _ in episodes if each.action is not None}
        end_stops = (float(lowest[element] + margin[element]), float(highest[element] - margin[element]))
        if len(wanted) <= MIN_OTHERS:  # too few to distinguish an end stop from the position where the reading froze
            end_stops = (-math.inf, math.inf)
        errors: list[Array] = [np.zeros(1)]
        if relation.kind == "increment":
            gain = evidence.ranges[element] / max(_usual_sum(evidence, column), 1e-12)
            wanted = {number: gain * np.cumsum(each) for number, each in wanted.items()}
        wanted = {number: each[np.maximum(np.arange(len(each)) - lag, 0)] for number, each in wanted.items()}
        if relation.kind == "target":
            errors = _moving_errors(wanted, episodes, element) or errors
        offset = float(np.median([_ranked(each, 0.5) for each in errors]))
        usual_error = float(np.median([_ranked(np.abs(each - offset), 0.99) for each in errors]))
        found.append(
            _ElementTarget(
                element=element,
                kind=relation.kind,
                wanted=wanted,
                min_distance=MIN_FROZEN_ERRORS * usual_error,
                offset=offset,
                end_stops=end_stops,
            )
        )
    return found


def _ranked(values: Array, share: float) -> float:
    """Return the value (N,) above the given share of the others: fast for many small arrays."""
    return float(np.sort(values)[round(share * (len(values) - 1))])


def _moving_errors(
    wanted: Mapping[int, Array], episodes: Sequence[tuple[EpisodeEvidence, Array]], element: int
) -> list[Array]:
    """Compute the difference between target and state in each episode, in frames in which the element moves."""
    found = []
    for episode, state in episodes:
        values = state[:, element]
        moves = np.flatnonzero(values[1:] != values[:-1])
        if episode.number in wanted and len(moves):
            found.append(wanted[episode.number][moves] - values[moves])
    return found


def _usual_sum(evidence: Evidence, column: int) -> float:
    spans = [np.ptp(np.cumsum(e.action[:, column])) for e in evidence.episodes if e.action is not None and e.length]
    return float(np.median(spans))


def _frozen_element(
    evidence: Evidence, targets: Sequence[_ElementTarget], episode: EpisodeEvidence, state: Array, needed: int
) -> Fault | None:
    """Find the longest rest of an element of the arm while its action is unusually far away."""
    worst: Fault | None = None
    longest = needed
    for target in targets if episode.action is not None else ():
        values = state[:, target.element]
        min_motion = MIN_FROZEN_RANGE * evidence.ranges[target.element]
        for first, end in runs(values[1:] == values[:-1]):
            if end - first < longest:
                continue
            distance = target.unfollowed(episode.number, float(values[first]), first, end)
            moved = float(np.ptp(distance))
            if moved > min_motion and float(np.abs(distance).max()) > target.min_distance:
                longest = end - first + 1
                seconds = evidence.seconds(end - first)
                worst = Fault(
                    severity="broken",
                    episode=episode.number,
                    frames=(first, end),
                    value=f"{seconds:.1f} s",
                    message=f"{element_name(evidence, target.element)} keeps one value for {seconds:.1f} s "
                    "while its action moves",
                )
    return worst


def _frozen_whole(evidence: Evidence, episode: EpisodeEvidence, state: Array, needed: int) -> Fault | None:
    """Find a rest of the whole state that ends with a jump, or during which the whole action moves."""
    same = (state[1:] == state[:-1]).all(axis=1)
    rests = [(first, end) for first, end in runs(np.asarray(same)) if end - first >= needed]
    alive = evidence.ranges > 0
    for first, end in rests:
        if end >= len(state) - 1:
            continue
        steps = np.abs(np.diff(state[:, alive], axis=0))
        jump = steps[end] > np.maximum(4 * np.quantile(steps, 0.95, axis=0), 0.1 * evidence.ranges[alive])
        if jump.mean() >= 0.5:
            return Fault(
                severity="broken",
                episode=episode.number,
                frames=(first, end),
                value=f"{evidence.seconds(end - first):.1f} s",
                message=f"the whole state keeps its values for {evidence.seconds(end - first):.1f} s, then jumps",
            )
    return None


@check(
    family="numbers",
    needs="state, other measured columns",
    measures="sensors that stop changing",
    unit="s",
    why="The policy sees a force or a speed that is not there.",
    do=DROP,
)
def frozen_sensors(evidence: Evidence) -> Iterator[Fault]:
    """Find measured columns that repeat bit-exactly while the robot moves, though they usually change.

    A sensor may rest at zero, as a contact sensor does, or at a value that it keeps in half of the moving frames. Rests
    must exceed those of the other episodes: the pose of an object rests in each until the robot touches it.
    """
    episodes = evidence.need_state(8)
    measured = evidence.roles.having("sensor", "velocity", "pose")
    names = [name for name in measured if name not in evidence.roles.state and evidence.roles.columns[name].is_vector]
    if not names:
        raise NotMeasuredError("the state is the only measured column")
    for name in names:
        having = [episode for episode, _ in episodes if name in episode.columns]
        rests = [_longest_rest(episode, episode.columns[name]) or (0, 0, 0) for episode in having]
        for number, (episode, (first, end, moving)) in enumerate(zip(having, rests, strict=True)):
            others = [other for _, _, other in rests[:number] + rests[number + 1 :]]
            usual = float(np.median(others)) if len(others) >= MIN_OTHERS else 0.0
            seconds = evidence.seconds(moving)
            if seconds > MIN_REST_S and moving > REST_TIMES * usual:
                yield Fault(
                    severity="broken" if seconds > MIN_BROKEN_S else "look",
                    episode=episode.number,
                    frames=(first, end),
                    value=f"{seconds:.1f} s",
                    message=f"{name} keeps its values for {seconds:.1f} s while the robot moves",
                )


def _longest_rest(episode: EpisodeEvidence, table: Array) -> tuple[int, int, int] | None:
    """Find (first frame, last frame, moving frames) of the longest rest; None if the sensor often rests."""
    speed = episode.speed
    moves = speed > MIN_SPEED * np.sqrt((speed**2).mean()) if speed.any() else np.zeros(len(speed), dtype=np.bool_)
    same = (table[1:] == table[:-1]).all(axis=1) & table[1:].any(axis=1)
    counts = np.concatenate([[0], np.cumsum(same & moves)])
    found = [(int(counts[end] - counts[first]), first, end) for first, end in runs(same | ~moves)]
    moving, first, end = max(found, default=(0, 0, 0))
    outside = np.ones(len(same), dtype=np.bool_)
    outside[first:end] = False
    changes = (table[1:] != table[:-1]).any(axis=1) & moves & outside
    if not moving or changes.sum() < MIN_LIVE_SHARE * (moves & outside).sum():
        return None
    return first, end, moving
