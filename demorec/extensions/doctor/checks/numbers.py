"""Checks of numbers: missing ones, other units, jumps, and constant zeros."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from demorec.check.base import Fault, NotMeasuredError, check
from demorec.core.geometry import Array
from demorec.episode.element_names import joint_of
from demorec.extensions.doctor.evidence import DROP, Evidence
from demorec.extensions.doctor.relation import relation_of
from demorec.extensions.doctor.units import (
    MIN_MOTION_TICKS,
    MIN_UNIT_RATIO,
    element_ticks,
    moving_elements,
    other_units,
    state_bounds,
)

MIN_OTHERS = 3
"""Minimum number of episodes to compare one with."""
UNIT_FACTORS: Mapping[str, float] = {
    "degrees instead of radians": math.degrees(1.0),
    "millimetres instead of metres": 1000.0,
    "per cent instead of shares": 100.0,
    "encoder ticks instead of radians": 4096 / (2 * math.pi),
    "encoder ticks instead of degrees": 4096 / 360,
}
"""Confusion of units -> factor of the values."""
GRIPPER_QUANTILES = (0.02, 0.98)
"""Quantiles that bound a gripper in an episode: a few wrong readings are a jump, not another unit."""
MIN_JUMP_RANGE = 0.15
"""Minimum size of a jump, as a ratio of an element's range."""
MIN_JUMP_STEPS = 6.0
"""Minimum factor of a jump over the largest usual step and over its neighbours: motors accelerate over frames."""
MIN_COMPANY = 0.33
"""Minimum step of another element in an adjacent frame, relative to the jump, that shows fast motion of the whole arm;
both in units of each element's limit."""


@check(
    family="numbers",
    needs="numbers",
    measures="numbers that are NaN or infinite",
    unit="numbers",
    why="One NaN makes the loss, and with it all weights, NaN; statistics of its column are lost.",
    do=DROP,
)
def missing_numbers(evidence: Evidence) -> Iterator[Fault]:
    """Count NaN and infinite numbers in every column of every frame.

    They affect only these frames: all other checks continue with the preceding numbers.
    """
    for episode in evidence.episodes:
        counts: dict[str, int] = {}
        frames: list[int] = []
        for name, values in episode.columns.items():
            if values.dtype.kind != "f":
                continue
            bad = ~np.isfinite(values)
            if bad.any():
                counts[name] = int(bad.sum())
                frames += np.flatnonzero(bad.reshape(len(values), -1).any(axis=1)).tolist()
        if counts:
            yield Fault(
                severity="broken",
                episode=episode.number,
                frames=(min(frames), max(frames)),
                value=f"{sum(counts.values())} numbers",
                message=f"{', '.join(counts)} {'has' if len(counts) == 1 else 'have'} NaN or infinite numbers: "
                f"{sum(counts.values())}, the first in frame {min(frames)}",
            )


@check(
    family="numbers",
    needs="state or action",
    measures="episodes or columns in another unit",
    unit="ratio",
    why="Normalisation by the whole set squeezes all other episodes to nothing; targets of another unit are dangerous.",
    do="convert the episode in the program that recorded it, or drop it: " + DROP,
)
def unit_mismatch(evidence: Evidence) -> Iterator[Fault]:
    """Compare the magnitude of each episode's numbers with that of the others, and of the state with its action.

    Magnitudes are those of values and of ranges. Most elements must agree on a factor of at least seven.
    """
    evidence.need_state()
    for number, ratios in evidence.once(other_units).items():
        ratio = next(iter(ratios.values()))
        what = f"{' and '.join(ratios)} {'are' if len(ratios) > 1 else 'is'}"
        yield Fault(
            severity="broken",
            episode=number,
            value=f"{ratio:.3g} times",
            message=f"its {what} {_in_words(ratio)} the size of the others' ({_confusion(ratio)})",
        )
    yield from _gripper_units(evidence)
    yield from _action_units(evidence)


def _gripper_units(evidence: Evidence) -> Iterator[Fault]:
    """Find episodes in which a gripper's values and range are both larger by a known confusion of units."""
    episodes = [each for each in evidence.need_state() if each[0].number not in evidence.once(other_units)]
    for element in np.flatnonzero(evidence.is_gripper).tolist() if len(episodes) > MIN_OTHERS else ():
        bounds = np.array([np.quantile(state[:, element], GRIPPER_QUANTILES) for _, state in episodes])
        sizes = np.abs(bounds).max(axis=1)
        spans = np.ptp(bounds, axis=1)
        usual_size, usual_span = np.median(sizes), np.median(spans)
        for (episode, _), size, span in zip(episodes, sizes, spans, strict=True) if usual_span > 0 else ():
            ratio = float(span / usual_span)
            if min(ratio, size / usual_size) > MIN_UNIT_RATIO and not _confusion(ratio).startswith("another"):
                yield Fault(
                    severity="broken",
                    episode=episode.number,
                    value=f"{ratio:.3g} times",
                    message=f"its {element_name(evidence, element)} opens {_in_words(ratio)} as far as in the others "
                    f"({_confusion(ratio)})",
                    do=DROP,
                )


def _in_words(ratio: float) -> str:
    return f"{ratio:.3g} times" if ratio >= 1 else f"1/{1 / ratio:.3g} of"


def _confusion(ratio: float) -> str:
    """Name the confusion of units with the nearest factor."""
    size = max(ratio, 1 / ratio)
    name, factor = min(UNIT_FACTORS.items(), key=lambda item: abs(math.log(item[1] / size)))
    if abs(math.log(factor / size)) > math.log(1.2):
        return "another unit or scale?"
    if ratio < 1:
        one, _, two = name.partition(" instead of ")
        name = f"{two} instead of {one}"
    return f"{name}?"


def _action_units(evidence: Evidence) -> Iterator[Fault]:
    """Check whether targets have a different unit from the state that follows them."""
    try:
        relation = evidence.once(relation_of)
    except NotMeasuredError:
        return
    if relation.kind != "target":
        return
    ratios = []
    for number in relation.episodes:
        episode = evidence.by_number[number]
        assert episode.state is not None
        assert episode.action is not None
        state, action = episode.state[:, relation.elements], episode.action[:, relation.columns]
        moved = np.ptp(state, axis=0) > 0
        ratios.append(np.where(moved, action.std(axis=0) / np.maximum(state.std(axis=0), 1e-12), np.nan))
    ratio = float(np.nanmedian(np.stack(ratios)))
    if not 1 / MIN_UNIT_RATIO < ratio < MIN_UNIT_RATIO:
        yield Fault(
            severity="look" if _confusion(ratio).startswith("another") else "broken",
            value=f"{ratio:.3g} times",
            message=f"the action is {_in_words(ratio)} the size of the state that follows it ({_confusion(ratio)})",
            do="convert one of the two in the program that recorded them",
        )


@check(
    family="numbers",
    needs="state",
    measures="jumps of the state within one frame",
    unit="% of the range",
    why="No arm jumps: frames are missing, a reading failed, or two episodes were written as one.",
    do="look at it: demorec view {path} --episodes {episode}; then cut it: demorec dataset cut {path} --jumps "
    "--out NEW, or drop it: " + DROP,
)
def state_jumps(evidence: Evidence) -> Iterator[Fault]:
    """Find steps several times as large as the largest usual one and as the steps before and after them.

    Grippers are excluded, because they snap, and so are velocities and forces. A reading that jumps away and back also
    counts. Steps next to which other elements also move fast are excluded: a whole arm that starts or stops in a few
    frames.
    """
    episodes = evidence.need_state(8)
    arm, moves = evidence.is_position & ~evidence.is_gripper, evidence.once(moving_elements)
    largest = [np.abs(np.diff(state, axis=0)).max(axis=0) for _, state in episodes]
    typical = [np.quantile(np.abs(np.diff(state, axis=0)), 0.98, axis=0) for _, state in episodes]
    lowest, highest = evidence.once(state_bounds)
    limit = np.maximum(MIN_JUMP_STEPS * np.median(typical, axis=0), MIN_JUMP_RANGE * (highest - lowest))
    limit = np.maximum(limit, MIN_MOTION_TICKS * evidence.once(element_ticks))
    if len(episodes) > MIN_OTHERS:
        limit = np.maximum(limit, 2 * np.median(largest, axis=0))
    for episode, state in episodes:
        sizes = np.abs(np.diff(state, axis=0))
        before = np.vstack([np.zeros_like(sizes[:1]), sizes[:-1]])
        after = np.vstack([sizes[1:], np.zeros_like(sizes[:1])])
        own = MIN_JUMP_STEPS * np.quantile(sizes, 0.95, axis=0)
        smaller, other = np.minimum(before, after), np.maximum(before, after)
        spike = (other > 0.5 * sizes) & (smaller * MIN_JUMP_STEPS < sizes)
        alone = other * MIN_JUMP_STEPS / 2 < sizes
        jumps = (sizes > np.maximum(limit, own)) & (spike | alone) & arm & (evidence.ranges > 0)
        jumps &= ~_accompanied(sizes / np.maximum(limit, 1e-12), jumps)
        if not jumps.any():
            continue
        frames = np.flatnonzero(jumps.any(axis=1))
        places = np.unravel_index(int(np.argmax(np.where(jumps, sizes / np.maximum(limit, 1e-12), 0))), sizes.shape)
        frame, element = int(places[0]), int(places[1])
        share = sizes[frame, element] / max(evidence.ranges[element], highest[element] - lowest[element], 1e-12)
        count = f" and {len(frames) - 1} more" if len(frames) > 1 else ""
        yield Fault(
            severity="broken" if moves[element] and (len(frames) > 1 or share > 0.5) else "look",
            episode=episode.number,
            frames=(int(frames[0]) + 1, int(frames[-1]) + 1),
            value=f"{share:.0%} of its range",
            message=f"{element_name(evidence, element)} jumps from {state[frame, element]:.3g} to "
            f"{state[frame + 1, element]:.3g} within one frame (frame {frame + 1}{count})",
        )


def _accompanied(speeds: Array, jumps: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Find (T - 1, D) steps next to which elements without a jump move comparably fast.

    Args:
        speeds: (T - 1, D) steps in units of each element's limit.
        jumps: (T - 1, D) flags of the jumps.
    """
    fastest = np.where(jumps.any(axis=0), 0.0, speeds).max(axis=1)
    beside = np.maximum(np.append(fastest[1:], 0.0), np.insert(fastest[:-1], 0, 0.0))
    return np.asarray(beside[:, None] > MIN_COMPANY * speeds)


def element_name(evidence: Evidence, element: int) -> str:
    """Name an element of the state in messages."""
    name = evidence.elements[element]
    return f"element {name} of the state" if name.isdigit() else name


@check(
    family="numbers",
    needs="state",
    measures="elements that are exactly zero throughout",
    why="A converter that lacks a joint writes zeros: the policy learns nothing about it, and commands zero.",
    do="compare the order of the joints in the recorder with the names in info.json",
)
def zero_elements(evidence: Evidence) -> Iterator[Fault]:
    """Find elements of state and action that are exactly zero in all rows while others of the same arm move.

    An arm that rests as a whole is excluded, and so are elements that rest at another value.
    """
    episodes = evidence.need_state()
    zero = np.all([~state.any(axis=0) for _, state in episodes], axis=0)
    groups = [_group(name) for name in evidence.elements]
    acting = [e.action for e, _ in episodes if e.action is not None]
    found = []
    for element in np.flatnonzero(zero).tolist():
        column = evidence.action_of[element]
        if column is not None and any(action[:, column].any() for action in acting):
            continue
        peers = [k for k, group in enumerate(groups) if group == groups[element]]
        if np.mean([evidence.ranges[k] > 0 for k in peers]) >= 0.5:
            found.append(evidence.elements[element])
    if found:
        yield Fault(
            severity="look",
            value=f"{len(found)} of {len(evidence.elements)} elements",
            message=f"state and action of {', '.join(found)} are exactly zero in all frames, and other joints move",
        )


def _group(name: str) -> str:
    """Determine the arm of an element: "left" or "right" if its name implies it."""
    words = joint_of(name).lower().replace(".", "_").replace("/", "_").split("_")
    return next((word for word in words if word in ("left", "right", "l", "r")), "")
