"""Checks of numbers against each other: velocities, quaternions, and the limits of the joints."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from demorec.check.base import Fault, NotApplicableError, NotMeasuredError, check
from demorec.core.geometry import Array
from demorec.extensions.doctor.arm import arm_of
from demorec.extensions.doctor.evidence import DROP, Evidence, joined, quaternion_places
from demorec.extensions.doctor.robust import usual, without_gaps

VELOCITY_WINDOW_S = 0.3
"""Integration time of velocities: drivers' filters delay them by 20 to 100 ms, which cancels over longer times."""
MAX_VELOCITY_ERROR = 0.2
"""Maximum distance from one of the ratio of displacement and integrated velocity: filters and rounding change it by a
tenth, 24 frames per second instead of 30 by a quarter."""
MIN_AGREED = 0.3
"""Minimum squared correlation of the two: that of different joints is lower."""
MAX_NORM_ERROR = 0.02
"""Maximum distance of a quaternion's length from one: float16 rounds to 0.001, interpolation loses 0.01."""


@check(
    family="numbers",
    needs="state, velocity",
    measures="velocities that do not match the state",
    unit="ratio",
    why="A policy that sees both learns a contradiction; a wrong ratio shows a wrong rate or unit.",
    do="compare units and rate of the two in the recorder",
)
def velocity_mismatch(evidence: Evidence) -> Iterator[Fault]:
    """Compare displacements with integrated velocities over 0.3 s: each element over all episodes, and each episode.

    Elements that hardly move are excluded, and grippers, which start and stop within a few frames.
    """
    parts = evidence.roles.having("velocity")
    columns = evidence.roles.in_state(parts) if parts and evidence.roles.state else []
    known = [(k, c) for k, c in enumerate(columns) if c is not None and not evidence.is_gripper[k]]
    if not known:
        raise NotMeasuredError("no column has velocities of the state's elements")
    window = max(2, round(VELOCITY_WINDOW_S * evidence.fps))
    elements, places = (list(part) for part in zip(*known, strict=True))
    found: dict[int, tuple[Array, Array]] = {}
    for episode, state in evidence.need_state(2 * window):
        velocity = joined(parts, episode.columns)
        if velocity is not None:
            found[episode.number] = _velocity_ratios(state[:, elements], velocity[:, places] / evidence.fps, window)
    known_ratios = {number: both for number, both in found.items() if np.isfinite(both[0]).any()}
    if not known_ratios:
        raise NotMeasuredError("nothing moves long enough to compare it with its velocity")
    by_element = _median_by_element([ratios for ratios, _ in known_ratios.values()])
    agreed = _median_by_element([agreement for _, agreement in known_ratios.values()])
    names = [evidence.elements[element] for element in elements]
    wrong = [k for k in range(len(names)) if abs(by_element[k] - 1) > MAX_VELOCITY_ERROR or agreed[k] < MIN_AGREED]
    if wrong:
        ratio = float(by_element[wrong[0]])
        yield Fault(
            severity="broken",
            value=f"{ratio:.2f} times",
            message=f"{', '.join(names[k] for k in wrong)} moves {ratio:.2f} times as far as its velocity implies",
        )
        return
    for number, (ratios, _) in known_ratios.items():
        ratio = float(np.nanmedian(ratios))
        if abs(ratio - 1) > MAX_VELOCITY_ERROR:
            yield Fault(
                severity="broken",
                episode=number,
                value=f"{ratio:.2f} times",
                message=f"its state moves {ratio:.2f} times as far as its velocities imply",
                do=DROP,
            )


def _median_by_element(values: Sequence[Array]) -> Array:
    """Compute the (K,) median of each element over episodes, from N times (K,); NaN if no episode has a number."""
    return np.array([usual(element)[0] for element in np.stack(values).T])


def _velocity_ratios(state: Array, steps: Array, window: int) -> tuple[Array, Array]:
    """Compute (K,) ratio of displacement to integrated steps (T, K), and their agreement; NaN if an element rests."""
    course = np.cumsum((steps[1:] + steps[:-1]) / 2, axis=0)
    integrated = course[window:] - course[:-window]
    moved = state[1 + window :] - state[1:-window]
    squares, total = (integrated**2).sum(axis=0), (moved**2).sum(axis=0)
    products = (moved * integrated).sum(axis=0)
    alive = total > 0.02 * total.max(initial=0.0)
    ratios = np.where(squares > 0, products / np.where(squares > 0, squares, 1.0), 0.0)
    sizes = squares * total
    agreed = np.where(sizes > 0, products**2 / np.where(sizes > 0, sizes, 1.0), 0.0)
    return np.where(alive, ratios, np.nan), np.where(alive, agreed, np.nan)


@check(
    family="numbers",
    needs="quaternions",
    measures="quaternions that are not of unit length",
    unit="length",
    why="It is not a rotation: the order of the elements is wrong, or one of them is missing.",
    do="compare the order of the elements in the recorder with their names",
)
def quaternion_length(evidence: Evidence) -> Iterator[Fault]:
    """Measure the length of each group of four elements named x, y, z and w of one rotation."""
    places = [
        (name, place)
        for name, column in evidence.roles.columns.items()
        if column.is_vector
        for place in quaternion_places(column.elements)
    ]
    if not places:
        raise NotApplicableError("no elements have the names of a quaternion")
    for name, place in places:
        worst: dict[int, float] = {}
        for episode in evidence.episodes:
            if name in episode.columns and evidence.roles.of[name] not in ("command", "action"):
                four = without_gaps(episode.columns[name])[:, place : place + 4]
                error = np.abs(np.linalg.norm(four, axis=1) - 1)
                worst[episode.number] = float(np.median(error))
        bad = {number: error for number, error in worst.items() if error > MAX_NORM_ERROR}
        if len(bad) > len(worst) / 2:
            number, error = max(bad.items(), key=lambda item: item[1])
            yield Fault(
                severity="broken",
                value=f"{error:.2f} off 1",
                message=f"the quaternion in {name} is not of unit length in {len(bad)} of {len(worst)} episodes",
            )
            continue
        for number, error in bad.items():
            yield Fault(
                severity="broken",
                episode=number,
                value=f"{error:.2f} off 1",
                message=f"its quaternion in {name} is not of unit length",
                do=DROP,
            )


@check(
    family="numbers",
    needs="state, the robot's URDF",
    measures="positions beyond the joints' limits",
    unit="rad, m",
    why="The numbers are not those of this robot: another unit, order of joints, or zero.",
    do="compare units and zero positions with the URDF; name servos by --motor-units",
)
def joint_limits(evidence: Evidence) -> Iterator[Fault]:
    """Compare the state with the limits of the robot's URDF.

    The robot is that of the recording or the sidecar, the one named by --urdf or --motor-units, or a known one with
    joints named like the state's elements. Up to 0.1 rad or m beyond a limit is attributed to calibration.
    """
    arm = evidence.once(arm_of)
    known = np.flatnonzero(np.isfinite(arm.lower) | np.isfinite(arm.upper))
    if not len(known):
        raise NotMeasuredError("the URDF has no limits of the state's joints")
    for episode, state in evidence.need_state():
        beyond = np.maximum(np.maximum(arm.lower - state, state - arm.upper), 0.0)[:, known]
        frame, place = np.unravel_index(int(beyond.argmax()), beyond.shape)
        worst = float(beyond[frame, place])
        if worst > 0.1:
            frames = np.flatnonzero((beyond > 0.1).any(axis=1))
            yield Fault(
                severity="broken" if worst > 0.5 else "look",
                episode=episode.number,
                frames=(int(frames[0]), int(frames[-1])),
                value=f"{worst:.2f} rad",
                message=f"{evidence.elements[known[place]]} is {worst:.2f} rad or m beyond its limit",
            )
