"""Checks of numbers against each other: velocities and quaternions."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from demorec.check.base import Fault, NotApplicableError, NotMeasuredError, check
from demorec.core.geometry import Array
from demorec.extensions.doctor.evidence import DROP, Evidence, joined, quaternion_places
from demorec.extensions.doctor.robust import usual, without_gaps

VELOCITY_WINDOW_S = 0.3
"""Integration time of velocities: drivers' filters delay them by 20 to 100 ms, which cancels over longer times."""
MAX_VELOCITY_ERROR = 0.2
"""Maximum distance from one of the ratio of displacement and integrated velocity: filters and rounding change it by a
tenth, 24 frames per second instead of 30 by a quarter."""
MIN_AGREED = 0.3
"""Minimum squared correlation of the two: that of different joints is lower."""
MIN_OTHERS = 3
"""Minimum number of episodes to compare one with."""
MIN_COMMON_AXIS = 0.95
"""Minimum agreement of mean rotations, the cosine of half their angle: 36 degrees, as hands at one task differ."""
MAX_OTHER_AXIS = 0.8
"""Maximum agreement of a rotation that is another one: they differ by 74 degrees or more."""
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
    measures="quaternions of wrong length, order or sign",
    unit="length",
    why="It is another rotation, or none; a change of sign is a jump of the state without any motion.",
    do="compare the order of the elements in the recorder with their names",
)
def quaternion_form(evidence: Evidence) -> Iterator[Fault]:
    """Measure the length of each group of four elements named x, y, z and w of one rotation.

    An episode has another order of elements if its usual rotation agrees with that of the others only with w moved from
    one end to the other. A sign that changes between two frames is worth a look if it does not in most episodes.
    """
    places = [
        (name, place)
        for name, column in evidence.roles.columns.items()
        if column.is_vector
        for place in quaternion_places(column.elements)
    ]
    if not places:
        raise NotApplicableError("no elements have the names of a quaternion")
    for name, place in places:
        fours = {
            episode.number: without_gaps(episode.columns[name])[:, place : place + 4]
            for episode in evidence.episodes
            if name in episode.columns and evidence.roles.of[name] not in ("command", "action")
        }
        yield from _order_faults(name, fours)
        yield from _sign_faults(name, fours)
        worst = {n: float(np.median(np.abs(np.linalg.norm(four, axis=1) - 1))) for n, four in fours.items()}
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


def _order_faults(name: str, fours: Mapping[int, Array]) -> Iterator[Fault]:
    """Find episodes with w at the other end than in most."""
    axes = {number: _main_axis(four) for number, four in fours.items() if len(four)}
    if len(axes) <= MIN_OTHERS:
        return
    common = _main_axis(np.stack(list(axes.values())))
    if np.median([abs(axis @ common) for axis in axes.values()]) < MIN_COMMON_AXIS:
        return
    for number, axis in axes.items():
        moved = max(abs(np.roll(axis, step) @ common) for step in (1, -1))
        if moved > MIN_COMMON_AXIS and abs(axis @ common) < MAX_OTHER_AXIS:
            yield Fault(
                severity="broken",
                episode=number,
                message=f"its quaternion in {name} has its scalar at the other end than those of the others",
                do=DROP,
            )


def _main_axis(four: Array) -> Array:
    """Compute the (4,) mean of (N, 4) quaternions, for which both signs are the same rotation."""
    return np.asarray(np.linalg.eigh(four.T @ four)[1][:, -1])


def _sign_faults(name: str, fours: Mapping[int, Array]) -> Iterator[Fault]:
    """Find episodes in which a quaternion changes its sign between two frames, unlike in most."""
    changes = {n: np.flatnonzero((four[1:] * four[:-1]).sum(axis=1) < 0) for n, four in fours.items()}
    changing = {number: frames for number, frames in changes.items() if len(frames)}
    for number, frames in changing.items() if len(changing) <= len(changes) / 2 else ():
        yield Fault(
            severity="look",
            episode=number,
            frames=(int(frames[0]) + 1, int(frames[-1]) + 1),
            value=f"{len(frames)} changes",
            message=f"its quaternion in {name} changes its sign in frame {frames[0] + 1}, without any motion",
            do="keep the sign of the preceding frame in the program that recorded it, or drop the episode: " + DROP,
        )
