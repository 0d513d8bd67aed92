"""Checks of episodes against each other: cut off, idle and unusual ones, and their instructions."""

from __future__ import annotations

import difflib
import math
import re
from collections import Counter
from collections.abc import Iterator

import numpy as np

from demorec.check.base import Fault, NotMeasuredError, check
from demorec.core.geometry import Array
from demorec.extensions.doctor.evidence import DROP, LOOK_OR_DROP, EpisodeEvidence, Evidence
from demorec.extensions.doctor.relation import relation_of
from demorec.extensions.doctor.robust import usual
from demorec.extensions.doctor.scores import score_episodes
from demorec.extensions.doctor.units import moving_elements, other_units

MIN_OTHERS = 7
"""Minimum number of episodes to compare one with: with fewer, "usual" means little."""
MAX_UNUSUAL_SCORE = 0.05
"""Score below which an episode is worth a look: one quantity at nine usual spreads, or two at seven or eight."""
MAX_UNUSUAL_SPREADS = 10.0
"""Number of usual spreads from which a quantity is far from the usual one."""
MAX_UNUSUAL_SHARE = 0.1
"""Maximum ratio of episodes with a quantity far from the median: more are another way to do the task."""
MIN_END_SPEED = 0.8
"""Minimum final speed, relative to the episode's root mean square, of an episode that ends during a motion."""
MAX_REST_SPEED = 0.3
"""Maximum final speed, relative to the same, of an episode that ends at rest."""
MIN_RESTING_SHARE = 0.9
"""Minimum ratio of other episodes ending at rest for a moving end to count as cut off."""
END_S = 0.2
MIN_SPAN = 0.05
"""Minimum range, relative to the largest, by which steps are divided: some elements move in few episodes only."""
MIN_IDLE_S = 3.0
"""Minimum idle time at an end, seconds, that is worth trimming."""
IDLE_TIMES = 4.0
"""Minimum factor over the usual idle time."""
IDLE_RATIO = 0.02
"""Maximum distance of an element at rest from its position, as a ratio of its usual range."""
MIN_RETURN = 0.08
"""Minimum distance of an arm from its start, as a ratio of the range, before it jumps back."""
MIN_LENGTH_TIMES = 3.0
"""Minimum factor over the usual length at which an episode contains several."""
_PLACEHOLDERS = frozenset(("", "none", "null", "nan", "task", "todo", "test", "unknown", "n/a", "default"))
MIN_COMMON = 5
"""Minimum number of episodes with the common instruction for a single other one to be questioned."""
MIN_SIMILARITY = 0.8
"""Minimum ratio of equal letters of two words that differ by a typing error."""


@check(
    family="set",
    needs="state, eight episodes",
    measures="episodes that are cut off",
    unit="% of usual speed",
    why="The end of the task is missing: the policy does not learn to finish.",
    do=LOOK_OR_DROP,
)
def cut_off_episodes(evidence: Evidence) -> Iterator[Fault]:
    """Find episodes that end during a motion, where nearly all others end at rest.

    The target must move, too: an arm reaches it tenths of a second later.
    """
    speeds: dict[int, float] = {}
    count = max(2, round(END_S * evidence.fps))
    for episode, state in evidence.need_state(3 * count):
        speed = _end_speed(evidence, state, count)
        if speed < math.inf:
            target = _target(evidence, episode, state)
            speeds[episode.number] = min(speed, _end_speed(evidence, target, count))
    if len(speeds) <= MIN_OTHERS:
        raise NotMeasuredError(f"it compares {MIN_OTHERS + 1} episodes or more")
    at_rest = sum(each < MAX_REST_SPEED for each in speeds.values()) / (len(speeds) - 1)  # of the others
    for number, end_speed in speeds.items() if at_rest >= MIN_RESTING_SHARE else ():
        if end_speed > MIN_END_SPEED:
            yield Fault(
                severity="look",
                episode=number,
                value=f"{end_speed:.0%}",
                message=f"it ends while the arm moves at {end_speed:.0%} of its speed; {at_rest:.0%} end at rest",
            )


def _end_speed(evidence: Evidence, values: Array, count: int) -> float:
    """Compute the speed in the last frames, relative to the root mean square; infinite without any motion."""
    speed = _arm_speed(evidence, values)
    size = float(np.sqrt((speed**2).mean()))
    return float(speed[-count:].mean()) / size if size > 0 else math.inf


def _target(evidence: Evidence, episode: EpisodeEvidence, state: Array) -> Array:
    """Return the (T, D) targets of the state's elements; the state itself where there are none."""
    try:
        if episode.action is None or evidence.once(relation_of).kind != "target":
            return state
    except NotMeasuredError:
        return state
    pairs = [(element, column) for element, column in enumerate(evidence.action_of) if column is not None]
    found = state.copy()
    found[:, [element for element, _ in pairs]] = episode.action[:, [column for _, column in pairs]]
    return found


def _arm_speed(evidence: Evidence, state: Array) -> Array:
    """Compute the (T - 1,) speed of the arm in units of the elements' ranges, of at least a part of the largest one."""
    arm = ~evidence.is_gripper & evidence.is_position
    ranges = evidence.ranges[arm]
    floor = MIN_SPAN * ranges.max(initial=0.0)
    steps = np.diff(state[:, arm], axis=0) if floor > 0 else np.zeros((len(state) - 1, 1))
    return np.asarray(np.linalg.norm(steps / np.maximum(ranges, floor or 1.0), axis=1))


@check(
    family="set",
    needs="state, eight episodes",
    measures="episodes that contain several",
    unit="times the length",
    why="Nothing marks where one attempt ends and the next begins: the policy learns to start over.",
    do="split it where the arm returns to its start, in the program that recorded it, or drop it: " + DROP,
)
def joined_episodes(evidence: Evidence) -> Iterator[Fault]:
    """Find episodes several times as long as the others that repeatedly return to their start."""
    episodes = evidence.need_state(8)
    lengths = [len(state) for _, state in episodes]
    length, _ = usual(lengths)
    for episode, state in episodes:
        returns = _returns(evidence, state)
        is_long = len(episodes) > MIN_OTHERS and len(state) > MIN_LENGTH_TIMES * length
        if returns >= 2 and (is_long or len(episodes) == 1):
            yield Fault(
                severity="broken" if is_long else "look",
                episode=episode.number,
                value=f"{len(state) / length:.1f} times" if is_long else f"{returns + 1} attempts",
                message=f"it seems to contain {returns + 1} episodes: it jumps back to its start {returns} times",
            )


def _returns(evidence: Evidence, state: Array) -> int:
    """Count how often the arm returns to its first position within one frame, at rest before and after."""
    span = np.ptp(state, axis=0)
    alive = (span > 0) & ~evidence.is_gripper
    if not alive.any():
        return 0
    away = (np.abs((state - state[0])[:, alive]) / span[alive]).max(axis=1)
    steps = (np.abs(np.diff(state[:, alive], axis=0)) / span[alive]).max(axis=1)
    is_jump = (steps[1:-1] > MIN_RETURN) & (np.maximum(steps[:-2], steps[2:]) < 0.3 * steps[1:-1])
    return int((is_jump & (away[2:-1] < MIN_RETURN / 2)).sum())


@check(
    family="set",
    needs="state",
    measures="idle time at the start or the end",
    unit="s",
    why="The policy learns to do nothing: at the start it may never begin to move.",
    do="demorec dataset trim {path} --idle --out NEW",
)
def idle_ends(evidence: Evidence) -> Iterator[Fault]:
    """Find episodes that stay at their first or last position for seconds, far longer than the others, or throughout.

    A slow motion leaves this position.
    """
    times: dict[int, tuple[float, float]] = {}
    alive = evidence.once(moving_elements)
    for episode, state in evidence.need_state(8):
        limit = IDLE_RATIO * evidence.ranges[alive]
        left, reached = (
            np.flatnonzero((np.abs(state[:, alive] - position) > limit).any(axis=1))
            for position in (state[0, alive], state[-1, alive])
        )
        if len(left):
            idle_frames = left[0] - 1, len(state) - 2 - reached[-1]
            times[episode.number] = (evidence.seconds(float(idle_frames[0])), evidence.seconds(float(idle_frames[1])))
        elif alive.any():
            yield Fault(
                severity="look",
                episode=episode.number,
                value="0",
                message="nothing moves in it",
                do=DROP,
            )
    for place, words in enumerate(("starts", "ends")):
        typical, _ = usual([each[place] for each in times.values()])
        for number, each in times.items():
            idle, length = each[place], evidence.seconds(evidence.by_number[number].length)
            if idle > max(MIN_IDLE_S, IDLE_TIMES * typical) and idle > 0.2 * length:
                yield Fault(
                    severity="look",
                    episode=number,
                    value=f"{idle:.1f} s",
                    message=f"it {words} with {idle:.1f} s without motion (usually {typical:.1f} s)",
                )


@check(
    family="set",
    needs="state, eight episodes",
    measures="episodes unlike the others of their task",
    unit="usual spreads",
    why="Detours, pauses and shaking are learned like everything else.",
    do=LOOK_OR_DROP,
)
def unusual_motion(evidence: Evidence) -> Iterator[Fault]:
    """Compare duration, pauses, detours, shaking and switches of the gripper with those of the other episodes.

    These are the reasons of the score; an episode with a score below 0.05 is worth a look.
    """
    evidence.need_state(8)
    if len(evidence.episodes) <= MIN_OTHERS:
        raise NotMeasuredError(f"it compares {MIN_OTHERS + 1} episodes or more")
    others = evidence.once(other_units)
    scores = {number: score for number, score in evidence.once(score_episodes).items() if number not in others}
    far = Counter(r.kind for score in scores.values() for r in score.reasons if r.spreads > MAX_UNUSUAL_SPREADS)
    common = {kind for kind, count in far.items() if count > max(1, MAX_UNUSUAL_SHARE * len(scores))}
    for number, score in scores.items():
        reasons = [reason for reason in score.reasons if reason.kind not in common | {"flaw", "lag"}]
        if math.prod(reason.factor for reason in reasons) < MAX_UNUSUAL_SCORE:
            worst = reasons[0]
            yield Fault(
                severity="look",
                episode=number,
                frames=(worst.first, worst.last),
                value=f"{worst.spreads:.0f} spreads",
                message=f"it {worst.text}" if not worst.text.startswith("the ") else worst.text,
            )


@check(
    family="set",
    needs="instructions",
    measures="episodes without an instruction",
    unit="episodes",
    why="A policy that reads instructions learns that none of them matters.",
    do="demorec dataset set-task {path} --task 'WORDS' --out NEW",
)
def empty_instructions(evidence: Evidence) -> Iterator[Fault]:
    """Find episodes with an empty instruction or a placeholder."""
    words = {episode.number: episode.instruction.strip() for episode in evidence.episodes}
    empty = [number for number, text in words.items() if text.lower() in _PLACEHOLDERS]
    if not words:
        raise NotMeasuredError("no episode can be read")
    if len(empty) == len(words):
        yield Fault(
            severity="look",
            value=f"{len(empty)} episodes",
            message=f"no episode has an instruction ({words[empty[0]]!r})",
        )
        return
    for number in empty:
        yield Fault(
            severity="look",
            episode=number,
            message=f"its instruction is {words[number]!r}",
            do="demorec dataset set-task {path} --task 'WORDS' --episodes {episode} --out NEW",
        )


@check(
    family="set",
    needs="instructions",
    measures="a task in different words, or in unique words",
    unit="episodes",
    why="Words that differ by a typing error are two tasks for a policy; unique ones are often an operator's error.",
    do="demorec dataset set-task {path} --task 'WORDS' --episodes {episode} --out NEW",
)
def odd_instructions(evidence: Evidence) -> Iterator[Fault]:
    """Find instructions that differ only by a typing error, and one that only a single episode has."""
    counts = Counter(each.instruction for each in evidence.episodes if each.instruction.strip())
    if len(counts) < 2:
        return
    common = counts.most_common()
    for text, count in common[1:]:
        usual = next((other for other, number in common if number > count and _is_misspelled(text, other)), None)
        lone = len(counts) == 2 and count == 1 and common[0][1] >= MIN_COMMON
        if usual is None and not lone:
            continue
        reason = f"{counts[usual]} others have {usual!r}" if usual is not None else f"all others have {common[0][0]!r}"
        for episode in evidence.episodes:
            if episode.instruction == text:
                yield Fault(
                    severity="look",
                    episode=episode.number,
                    value=f"{count} of {len(evidence.episodes)}",
                    message=f"its instruction is {text!r}, {reason}",
                )


def _is_misspelled(text: str, other: str) -> bool:
    """Check whether two instructions differ only in case, punctuation, or a letter within a word."""
    one, two = (re.sub(r"\W+", " ", each.lower()).split() for each in (text, other))
    if one == two:
        return True
    if len(one) != len(two):
        return False
    different = [(a, b) for a, b in zip(one, two, strict=True) if a != b]
    return len(different) == 1 and _is_one_word(*different[0])


def _is_one_word(one: str, two: str) -> bool:
    """Check whether two words of five letters or more differ by a typing error; "left1" and "left2" do not."""
    if min(len(one), len(two)) < 5 or any(letter.isdigit() for letter in one + two):
        return False
    return difflib.SequenceMatcher(None, one, two).ratio() >= MIN_SIMILARITY
