"""Checks of alignment between the action and the state of its frame."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from demorec.check.base import Fault, NotMeasuredError, check
from demorec.core.geometry import Array
from demorec.extensions.doctor.evidence import DROP, LOOK_OR_DROP, Evidence
from demorec.extensions.doctor.relation import ActionRelation, EpisodeLag, relation_of
from demorec.extensions.doctor.robust import lagged_correlations, usual
from demorec.extensions.doctor.units import BOUND_QUANTILES

MIN_OTHERS = 3
"""Minimum number of episodes to compare one with."""
MIN_SHIFT = 0.7
"""Minimum difference, frames, of an episode's lag: frames are lost or doubled as a whole, not in part."""
MIN_GAIN = 0.7
"""Minimum natural logarithm of the factor by which an episode's own lag reduces the unexplained variance: two."""
MIN_GRIPPER_SHIFT = 4.0
"""Minimum difference, frames, of the lag of a gripper, which moves seldom and may be held open by an object."""
MAX_GRIPPER_LAG = -2
"""Maximum lag, frames, of a gripper whose action is late: it moves first. Widths of objects change positive lags."""
MIN_GRIPPER_WAIT_S = 0.3
"""Minimum additional delay of a gripper whose action is early."""
MIN_GRIPPER_GAIN = 1.4
"""As MIN_GAIN, for a gripper: a factor of four."""
MAX_OWN = 0.5
"""Maximum ratio of the variance that an episode's own action leaves unexplained; one of another episode explains some,
as tasks repeat."""
MAX_CLOSE_OWN = 0.1
"""The same where most states follow a target closely."""
MIN_FOREIGN_FACTOR = 10.0
"""Minimum factor over the usual ratio there."""
MIN_WEIGHED_RANGE = 0.2
"""Minimum range by which motion is divided, relative to the largest usual one: a parked arm sways by a tick or two."""
MIN_LEAD = 0.25
"""Minimum lead, frames, of the state over its action that indicates misalignment: a command is never late."""
MAX_LAG_S = 0.35
"""Maximum usual delay of the state: hobby servos under teleoperation need 0.1 to 0.2 s."""
EQUAL_RATIO = 1e-4
"""Maximum difference of action and state, as a ratio of the range, that counts as equal."""
MIN_EQUAL_SHARE = 0.95
"""Minimum ratio of moving frames with equal numbers at which the action is the state."""
MIN_MIRRORED = 0.8
"""Minimum negative correlation of a gripper that mirrors its action."""
MAX_UNIT_DIFFERENCE = 0.3
"""Maximum difference of the bounds of a gripper and its action in one unit, as a ratio of the range: an object stops
the fingers early."""
MAX_CONVENTION = 1.5
"""Maximum of a gripper by convention, in which 1 may be open or closed."""
MIN_PAIR_GAIN = 4.0
"""Minimum factor by which the other element explains an element's motion better if the two are exchanged."""


@check(
    family="alignment",
    needs="state, action",
    measures="actions that come late or early, or belong elsewhere",
    unit="frames",
    why="A policy learns the action of each observation: that of another moment makes it lag, oscillate or stray.",
    do="shift the action in the program that recorded it, or drop the episodes: " + DROP,
)
def action_lag(evidence: Evidence) -> Iterator[Fault]:
    """Compare the delay of the state after the action: over the whole set, and in each episode with the others.

    The lag is where the action explains most of the state's motion, as a target or as an increment. The state may
    follow by up to 0.35 s, but cannot lead; a velocity measured in its frame is half a frame late. An episode is judged
    by its difference from the usual lag, and by the motion that its action leaves unexplained at any lag.
    """
    relation = evidence.once(relation_of)
    usual_lag = relation.usual_lag
    is_outside = usual_lag >= relation.lags[-1]  # of the tried lags: those of single episodes mean nothing then
    if relation.kind == "increment" and abs(usual_lag + 0.5) < MIN_LEAD:
        yield Fault(
            severity="look",
            value=f"{-usual_lag:.1f} frames",
            message="the action is the velocity measured in its frame, not a command: it is half a frame late",
            do="record the command, or take the change of the state until the next frame as the action",
        )
    elif usual_lag < -MIN_LEAD:
        yield Fault(
            severity="broken",
            value=f"{-usual_lag:.1f} frames",
            message=f"the state moves {-usual_lag:.1f} frames before its action: actions are late or states early",
            do="shift the action by whole frames in the program that recorded it",
        )
    elif usual_lag > max(MAX_LAG_S * evidence.fps, 2.0):
        yield Fault(
            severity="look",
            value=f"{evidence.seconds(usual_lag):.2f} s",
            message=f"the state follows its action by {evidence.seconds(usual_lag):.2f} s"
            + (" or more" if is_outside else ""),
            do="compare the clocks of the two in the program that recorded them",
        )
    if is_outside or len(relation.episodes) <= MIN_OTHERS:
        return
    foreign = list(_foreign_actions(evidence, relation))
    yield from foreign
    of_others = {fault.episode for fault in foreign}
    known = {number: episode for number, episode in relation.episodes.items() if number not in of_others}
    _, spread = usual([episode.lag for episode in known.values()], floor=0.1)
    for number, episode in known.items():
        shift = episode.lag - usual_lag
        side = "late" if shift < 0 else "early"
        if abs(shift) > max(MIN_SHIFT, 6 * spread) and _prefers(episode, relation, shift):
            yield Fault(
                severity="broken",
                episode=number,
                value=f"{shift:+.1f} frames",
                message=f"its action is {abs(shift):.1f} frames {side}: the state follows it by {episode.lag:+.1f} "
                f"frames (others: {usual_lag:+.1f})",
            )


def _foreign_actions(evidence: Evidence, relation: ActionRelation) -> Iterator[Fault]:
    """Find episodes with an action that leaves far more of their motion unexplained than in the others."""
    unexplained = _unexplained(evidence, relation)
    usual_ratio, ratio_spread = usual(list(unexplained.values()))
    most = MAX_OWN
    if relation.kind == "target":
        most = min(MAX_OWN, max(MAX_CLOSE_OWN, MIN_FOREIGN_FACTOR * usual_ratio))
    most = max(most, usual_ratio + 3 * ratio_spread)
    for number, ratio in unexplained.items():
        if ratio <= most:
            continue
        yield Fault(
            severity="broken" if ratio > MIN_FOREIGN_FACTOR * usual_ratio else "look",
            episode=number,
            value=f"{ratio:.0%} unexplained",
            message=f"its action leaves {ratio:.0%} of its motion unexplained (others: {usual_ratio:.0%}): is it of "
            "another episode?",
            do=LOOK_OR_DROP,
        )


def _unexplained(evidence: Evidence, relation: ActionRelation) -> dict[int, float]:
    """Compute episode -> ratio of its motion that its action leaves unexplained at its own lag, if it has one.

    Variances of the elements are added in units of their usual ranges, each up to its usual one: so noise on one that
    hardly moves, or an angle that jumps by a turn, counts little. Motion against the action, unlike in most episodes,
    counts as unexplained.
    """
    ranges = evidence.ranges[relation.elements]
    ranges = np.maximum(ranges, MIN_WEIGHED_RANGE * ranges.max())
    motions: dict[int, Array] = {}
    correlations: dict[int, Array] = {}
    for episode, _ in evidence.need_state():
        if episode.action is not None and episode.length > 3 * relation.lags[-1]:
            own = relation.episodes.get(episode.number)
            pair = relation.compared(episode, round(relation.usual_lag if own is None else own.lag))
            one, two = (part - part.mean(axis=0) for part in pair)
            size = np.sqrt((one**2).sum(axis=0) * (two**2).sum(axis=0))
            correlations[episode.number] = (one * two).sum(axis=0) / np.where(size > 0, size, 1.0)
            motions[episode.number] = one.var(axis=0) / ranges**2
    signs = np.sign(np.median(list(correlations.values()), axis=0))
    most = np.median(list(motions.values()), axis=0)
    motions = {number: np.minimum(motion, most) for number, motion in motions.items()}
    return {
        number: float(motion @ (1 - np.maximum(signs * correlations[number], 0) ** 2) / motion.sum())
        for number, motion in motions.items()
        if motion.any()
    }


def _prefers(episode: EpisodeLag, relation: ActionRelation, shift: float) -> bool:
    """Check whether the episode's own lag explains clearly more than the usual one, in most of its elements."""
    usual_place = int(np.argmin(np.abs(relation.lags - relation.usual_lag)))
    gain = float(episode.curve[usual_place] - episode.curve.min())
    same_side = np.sign(episode.element_lags - relation.usual_lag) == np.sign(shift)
    shifted = np.abs(episode.element_lags - relation.usual_lag) > MIN_SHIFT / 2
    return gain > MIN_GAIN and float((same_side & shifted).mean()) >= 2 / 3


@check(
    family="alignment",
    needs="state, action",
    measures="actions that are the state of the same frame",
    unit="% of frames",
    why="A policy learns to command the arm's current position: the arm does not move.",
    do="record the command that was sent, or take the state of a later frame as the action",
)
def action_equals_state(evidence: Evidence) -> Iterator[Fault]:
    """Count the moving frames in which the action equals the state of the same frame.

    Elements are paired by name. Grippers are excluded, since they rest on objects.
    """
    pairs = [
        (element, column)
        for element, column in enumerate(evidence.action_of)
        if column is not None and not evidence.is_gripper[element]
    ]
    if not pairs:
        raise NotMeasuredError("no element of the action has the name of an element of the state")
    elements, columns = (list(part) for part in zip(*pairs, strict=True))
    shares: dict[int, float] = {}
    for episode, state in evidence.need_state():
        if episode.action is None:
            continue
        moves = np.diff(state[:, elements], axis=0, prepend=state[:1, elements]) != 0
        error = np.abs(episode.action[:, columns] - state[:, elements])
        equal = error <= EQUAL_RATIO * np.maximum(evidence.ranges[elements], 1e-9)
        if moves.sum() >= 10:
            shares[episode.number] = float(equal[moves].mean())
    if not shares:
        raise NotMeasuredError("nothing moves, or the action is missing")
    bad = [number for number, share in shares.items() if share > MIN_EQUAL_SHARE]
    if len(bad) > len(shares) / 2:
        share = float(np.median(list(shares.values())))
        yield Fault(
            severity="broken",
            value=f"{share:.0%} of frames",
            message=f"the action is the state of the same frame in {len(bad)} of {len(shares)} episodes",
        )
        return
    for number in bad:
        yield Fault(
            severity="broken",
            episode=number,
            value=f"{shares[number]:.0%} of frames",
            message="its action is the state of the same frame, unlike in the others",
            do=DROP,
        )


@check(
    family="alignment",
    needs="state, action",
    measures="elements of the action that are exchanged",
    why="The policy moves one joint where it should move another.",
    do="fix the column order in the program that wrote them, or drop the episodes: " + DROP,
)
def swapped_elements(evidence: Evidence) -> Iterator[Fault]:
    """Find two elements with actions that explain the other's motion several times better than their own."""
    relation = evidence.once(relation_of)
    if len(relation.elements) < 2:
        raise NotMeasuredError("it needs two moving elements with actions")
    place = round(relation.usual_lag)
    matrices = {number: _unexplained_by_any(evidence, relation, number, place) for number in relation.episodes}
    names = [evidence.elements[element] for element in relation.elements]
    stacked = np.stack(list(matrices.values()))
    whole = np.ones(stacked.shape[1:])
    known = np.isfinite(stacked).any(axis=0)
    whole[known] = np.nanmedian(stacked[:, known], axis=0)
    swapped = _swaps(whole)
    for one, two in swapped:
        yield Fault(
            severity="broken",
            message=f"the action's {names[one]} moves the state's {names[two]}, and the other way round",
            value=f"{whole[one, one]:.0%} against {whole[one, two]:.0%} unexplained",
            do="fix the column order in the program that wrote them",
        )
    for number, matrix in matrices.items() if len(matrices) > MIN_OTHERS else ():
        for one, two in _swaps(matrix):
            if (one, two) not in swapped:
                yield Fault(
                    severity="broken",
                    episode=number,
                    message=f"its action's {names[one]} moves the state's {names[two]}, and the other way round",
                    value=f"{matrix[one, one]:.0%} against {matrix[one, two]:.0%} unexplained",
                )


def _unexplained_by_any(evidence: Evidence, relation: ActionRelation, number: int, lag: int) -> Array:
    """Compute (K, K) ratio of the variance of state i that action j leaves unexplained; NaN if one of them rests."""
    one, two = relation.compared(evidence.by_number[number], lag)
    one, two = one - one.mean(axis=0), two - two.mean(axis=0)
    sizes = np.outer((one**2).sum(axis=0), (two**2).sum(axis=0))
    return np.where(sizes > 0, 1 - (one.T @ two) ** 2 / np.where(sizes > 0, sizes, 1.0), np.nan)


def _swaps(matrix: Array) -> list[tuple[int, int]]:
    """Find pairs of elements that explain each other and not themselves."""
    count = len(matrix)
    return [
        (one, two)
        for one in range(count)
        for two in range(one + 1, count)
        if matrix[one, two] < 0.2
        and matrix[two, one] < 0.2
        and matrix[one, one] > MIN_PAIR_GAIN * max(matrix[one, two], 0.02)
        and matrix[two, two] > MIN_PAIR_GAIN * max(matrix[two, one], 0.02)
    ]


@check(
    family="alignment",
    needs="gripper, action",
    measures="grippers that ignore, invert, lead or lag their action",
    unit="correlation",
    why="A policy learns to open the hand when it must close it, or that commands have no effect.",
    do=DROP,
)
def gripper_action(evidence: Evidence) -> Iterator[Fault]:
    """Compare each gripper's correlation with its action in an episode with that in the others.

    Conventions differ (1 may mean open or closed), so the usual sign is the reference. A gripper that never follows in
    any episode is a fault of the whole set.
    """
    grippers = [
        (element, column)
        for element, column in enumerate(evidence.action_of)
        if column is not None and evidence.is_gripper[element]
    ]
    if not grippers:
        raise NotMeasuredError("no gripper has an action of its name")
    for element, column in grippers:
        yield from _gripper_faults(evidence, element, column)


def _gripper_faults(evidence: Evidence, element: int, column: int) -> Iterator[Fault]:
    followed: dict[int, float] = {}
    lags: dict[int, tuple[int, Array]] = {}
    ignored: dict[int, float] = {}
    commanded = usual([np.ptp(e.action[:, column]) for e, _ in evidence.with_state() if e.action is not None])[0]
    for episode, state in evidence.with_state(10):
        if episode.action is None:
            continue
        opening, command = state[:, element], episode.action[:, column]
        if np.ptp(command) < 0.5 * commanded or np.ptp(command) == 0:
            continue
        if np.ptp(opening) < 0.02 * evidence.ranges[element] or np.ptp(opening) == 0:
            ignored[episode.number] = float(np.ptp(command))
        else:
            reach = max(3, round(0.7 * evidence.fps))
            followed[episode.number] = _best_correlation(opening, command, reach)
            if len(opening) > 3 * reach:
                curve = np.abs(lagged_correlations(opening[:, None], command[:, None], -reach, reach)[:, 0])
                lags[episode.number] = int(np.argmax(curve)) - reach, curve
    name = evidence.elements[element]
    if ignored and not followed:
        yield Fault(
            severity="broken",
            value="0",
            message=f"{name} never moves although its action does",
            do="record the gripper's own position",
        )
        return
    for number in ignored if len(followed) >= MIN_OTHERS else ():
        yield Fault(
            severity="broken", episode=number, value="0", message=f"{name} stays where it is although its action moves"
        )
    if len(followed) <= MIN_OTHERS:
        return
    usual_correlation = float(np.median(list(followed.values())))
    if usual_correlation < -MIN_MIRRORED and _have_one_unit(evidence, element, column):
        yield Fault(
            severity="look",
            value=f"{usual_correlation:+.2f}",
            message=f"{name} opens when its action closes, in the same unit: one of the two is inverted",
            do="compare the signs of gripper and command in the program that recorded them",
        )
    for number, correlation in followed.items():
        if abs(usual_correlation) > 0.6 and correlation * np.sign(usual_correlation) < -0.5:
            yield Fault(
                severity="broken",
                episode=number,
                value=f"{correlation:+.2f}",
                message=f"{name} moves against its action (correlation {correlation:+.2f}, usual "
                f"{usual_correlation:+.2f})",
            )
    yield from _gripper_lags(name, lags, evidence.fps)


def _gripper_lags(name: str, lags: Mapping[int, tuple[int, Array]], fps: float) -> Iterator[Fault]:
    """Find episodes in which a gripper follows its action much earlier or later than in the others."""
    if len(lags) <= MIN_OTHERS:
        return
    usual_lag, spread = usual([lag for lag, _ in lags.values()], floor=0.5)
    for number, (lag, curve) in lags.items():
        shift = lag - usual_lag
        is_late = lag <= MAX_GRIPPER_LAG
        if abs(shift) < max(MIN_GRIPPER_SHIFT, 6 * spread) or not (is_late or shift > MIN_GRIPPER_WAIT_S * fps):
            continue
        unexplained = 1 - np.minimum(curve, 1 - 1e-9) ** 2
        usual_place = round(len(curve) // 2 + usual_lag)
        if np.log(unexplained[usual_place] / unexplained.min()) > MIN_GRIPPER_GAIN:
            yield Fault(
                severity="broken",
                episode=number,
                value=f"{shift:+.0f} frames",
                message=f"the action of {name} is {abs(shift):.0f} frames {'late' if shift < 0 else 'early'}: the "
                f"gripper follows it by {lag:+d} frames (others: {usual_lag:+.0f})",
            )


def _have_one_unit(evidence: Evidence, element: int, column: int) -> bool:
    """Check whether a gripper and its action have the same range; 0 to 1 is a convention, not a unit."""
    states = [state[:, element] for _, state in evidence.with_state()]
    actions = [each.action[:, column] for each in evidence.episodes if each.action is not None]
    opening, command = (np.quantile(np.concatenate(part), BOUND_QUANTILES) for part in (states, actions))
    is_near = np.abs(opening - command).max() < MAX_UNIT_DIFFERENCE * np.ptp(opening)
    return bool(is_near and opening[1] > MAX_CONVENTION)


def _best_correlation(values: Array, others: Array, reach: int) -> float:
    """Find the correlation of largest magnitude with the action some frames before."""
    found = lagged_correlations(values[:, None], others[:, None], 0, min(reach, len(values) - 8))[:, 0]
    return float(found[np.argmax(np.abs(found))])
