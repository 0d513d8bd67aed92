"""Simulated teleoperation: an operator's movements with corrections and rests, and an arm that follows with a delay.

The operator moves along minimum-jerk curves, corrects at the end of a reach, rests and trembles. The arm has a delay, a
lag, a dead band, gravity sag and encoders; its gripper stops at the object. Nothing here uses demorec.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class ArmModel:
    """An arm and its gripper, which is the last element, in the units of the dataset.

    Attributes:
        names: Element names.
        home: (D,) pose at rest.
        reach: (3, D - 1) displacement of the elements for one unit of x, y and height.
        grip: Gripper values: open, closed, holding the object.
        tick: Encoder resolution of the arm and of the gripper; 0 for continuous values.
        delay_s: Transport delay of a command.
        lag_s: Time constant of the servo.
        dead_band: Error below which the servo does not move.
        sag: Error of the second and third element under gravity, at full reach.
        noise: Standard deviation of a reading.
        tremor: Standard deviation of the operator's hand.
        limits: Lowest and highest reading.
    """

    names: tuple[str, ...]
    home: tuple[float, ...]
    reach: tuple[tuple[float, ...], ...]
    grip: tuple[float, float, float]
    tick: tuple[float, float] = (0.0, 0.0)
    delay_s: float = 0.04
    lag_s: float = 0.06
    dead_band: float = 0.0
    sag: float = 0.0
    noise: float = 0.0
    tremor: float = 0.0
    limits: tuple[float, float] = (-np.inf, np.inf)

    def joints(self, place: Array) -> Array:
        """(..., D - 1) elements that bring the hand to (..., 3) x, y and height."""
        found: Array = np.array(self.home[:-1]) + place @ np.array(self.reach)
        return found

    def place(self, joints: Array) -> Array:
        """(T, 3) x, y and height of the hand for (T, D - 1) elements."""
        found: Array = (joints - np.array(self.home[:-1])) @ np.linalg.pinv(np.array(self.reach))
        return found

    def readings(self, values: Array) -> Array:
        """Encoder readings of (T, D) true values."""
        ticks = np.array([self.tick[0]] * (len(self.home) - 1) + [self.tick[1]])
        whole = np.where(ticks > 0, np.round(values / np.maximum(ticks, 1e-12)) * ticks, values)
        return np.clip(whole, *self.limits)


@dataclass(frozen=True, kw_only=True)
class Reach:
    """One movement of the operator to a place (x, y, height), the gripper's target, and the rest afterwards."""

    name: str
    place: Array
    grip: float
    duration_s: float
    rest_s: float


@dataclass(frozen=True, kw_only=True)
class Motion:
    """One demonstration.

    Attributes:
        command: (T, D) readings of the leader.
        state: (T, D) readings of the arm.
        true: (T, D) values of the arm without encoders and noise.
        thing: (T, 3) position of the object.
    """

    command: Array
    state: Array
    true: Array
    thing: Array


def sound_reaches(rng: np.random.Generator, arm: ArmModel, pace: float) -> list[Reach]:
    """Movements of a pick and place; `pace` is a factor on all durations."""
    opened, closed, held = arm.grip
    squeeze = held + 0.7 * (closed - held)
    height = 0.45 + rng.normal(0, 0.04)
    start = np.array([0, 0, 0.8]) + rng.normal(0, 0.02, 3)
    thing = np.array([rng.uniform(-0.2, 0.9), rng.uniform(-0.7, 0.2), 0])
    goal = np.array([-0.6, 0.5, 0.05]) + rng.normal(0, 0.03, 3)
    above = np.array([0, 0, height])
    rows: list[tuple[str, Array, float, float]] = [
        ("begin", start, closed, 0.05),
        ("over", thing + above, opened, 1.1),
        ("at", thing, opened, 0.7),
        ("grip", thing, squeeze, 0.4),
        ("lift", thing + above, squeeze, 0.6),
        ("carry", goal + above, squeeze, 1.1),
        ("lower", goal, squeeze, 0.7),
        ("release", goal, opened, 0.4),
        ("retreat", goal + above, opened, 0.6),
        ("home", start, closed, 1.0),
    ]
    return [
        Reach(
            name=name, place=place, grip=grip, duration_s=duration_s * pace * rng.lognormal(0, 0.12),
            rest_s=rng.uniform(0.2, 0.7) if name in ("begin", "home") else min(rng.lognormal(-2.3, 0.6), 0.5),
        )
        for name, place, grip, duration_s in rows
    ]  # fmt: skip


def _detour(reaches: list[Reach], rng: np.random.Generator, arm: ArmModel) -> list[Reach]:
    for name in rng.choice(["over", "at", "carry", "lower"], rng.integers(2, 4), replace=False):
        after = next(reach for reach in reaches if reach.name == name)
        aside = rng.uniform(0.4, 0.8, 3) * rng.choice([-1, 1], 3) * (1, 1, 0.2) + (0, 0, 0.3)
        grip = arm.grip[0] if name == "over" else after.grip
        place = reaches.index(after)
        reaches = [
            *reaches[:place],
            replace(after, place=after.place + aside, grip=grip, name="aside"),
            *reaches[place:],
        ]
    return reaches


def _slow(reaches: list[Reach], rng: np.random.Generator, arm: ArmModel) -> list[Reach]:
    factor = 1 + rng.uniform(0.7, 1.6)
    return [replace(r, duration_s=r.duration_s * factor, rest_s=r.rest_s * factor) for r in reaches]


SPOILERS: dict[str, Callable[[list[Reach], np.random.Generator, ArmModel], list[Reach]]] = {
    "detour": _detour,
    "jerky": lambda reaches, rng, arm: reaches,  # `demonstrate` adds the tremor
    "cut off": lambda reaches, rng, arm: reaches[: int(rng.integers(4, len(reaches) - 3))],
    "slow": _slow,
}
"""Kinds of faulty demonstrations."""


def demonstrate(rng: np.random.Generator, arm: ArmModel, fps: int, pace: float = 1.0, *, spoilt: str = "") -> Motion:
    """Record one demonstration of a pick and place at `fps`, sound or of a kind in `SPOILERS`."""
    reaches = sound_reaches(rng, arm, pace * rng.lognormal(0, 0.1))
    if spoilt:
        reaches = SPOILERS[spoilt](reaches, rng, arm)
    wanted = _operator(reaches, rng, arm, fps)
    shake = arm.tremor + (0.03 * np.abs(np.array(arm.reach)).sum(0) if spoilt == "jerky" else 0)
    wanted[:, :-1] += _tremor(rng, wanted.shape[0], len(arm.home) - 1, fps) * shake
    command = arm.readings(wanted)
    ends_s = np.cumsum([reach.duration_s + reach.rest_s for reach in reaches])
    held = np.zeros(len(command), bool)
    for reach, end_s in zip(reaches, ends_s, strict=True):
        begin = int((end_s - reach.rest_s - reach.duration_s) * fps)
        if reach.name not in ("begin", "over", "at", "retreat", "home") and reach.grip not in arm.grip[:2]:
            held[begin : int(end_s * fps)] = True
    true = _follow(command, held, arm, fps)
    state = arm.readings(true + rng.normal(0, 1, true.shape) * arm.noise)
    return Motion(command=command, state=state, true=true, thing=_thing(true, held, reaches, arm))


def _operator(reaches: list[Reach], rng: np.random.Generator, arm: ArmModel, fps: int) -> Array:
    """(T, D) targets: each reach ends with a small error, and a second movement corrects it."""
    length = int(sum(reach.duration_s + reach.rest_s for reach in reaches) * fps)
    targets = np.empty((length, len(arm.home)))
    now = np.append(arm.joints(reaches[0].place), reaches[0].grip)
    style = rng.normal(0, 0.01, len(arm.home) - 1) * np.abs(np.array(arm.reach)).sum(0)
    begin_s = 0.0
    for reach in reaches:
        end = np.append(arm.joints(reach.place) + style, reach.grip)
        missed = end + (end - now) * rng.normal(0, 0.03, len(end)) * (np.arange(len(end)) < len(end) - 1)
        share = rng.uniform(0.7, 0.8)
        for first, last, from_s, length_s in (
            (now, missed, begin_s, reach.duration_s * share),
            (missed, end, begin_s + reach.duration_s * share, reach.duration_s * (1 - share)),
        ):
            rows = np.arange(int(from_s * fps), length)
            late = rng.uniform(0, 0.12, len(end))  # joints start at different times
            u = np.clip((((rows / fps - from_s) / length_s)[:, None] - late) / (0.88), 0, 1)
            targets[rows] = first + (last - first) * (10 * u**3 - 15 * u**4 + 6 * u**5)
        now, begin_s = end, begin_s + reach.duration_s + reach.rest_s
    return targets


def _tremor(rng: np.random.Generator, length: int, width: int, fps: int) -> Array:
    """(T, D) smooth noise of unit variance with most of its power below 4 Hz."""
    kernel = np.exp(-0.5 * (np.arange(-fps // 4, fps // 4 + 1) / (0.05 * fps)) ** 2)
    kernel /= np.sqrt((kernel**2).sum())
    noise = rng.normal(0, 1, (length + len(kernel) - 1, width))
    return np.stack([np.convolve(column, kernel, "valid") for column in noise.T], axis=1)


def _follow(command: Array, held: NDArray[np.bool_], arm: ArmModel, fps: int) -> Array:
    """(T, D) motion of the servos; the gripper stops at the object."""
    delay = max(1, round(arm.delay_s * fps))
    gain = 1 - np.exp(-1 / (fps * arm.lag_s))
    width = command.shape[1]
    span = np.append(np.abs(np.array(arm.reach)).sum(0), np.inf)
    sag = np.zeros(width)
    sag[1:3] = arm.sag
    band = np.full(width, arm.dead_band)
    now, moves = command[0].copy(), np.zeros(width, bool)
    home, found = np.array(arm.home), np.empty_like(command)
    opened, closed, stop = arm.grip
    for frame in range(len(command)):
        asked = command[max(0, frame - delay)] - sag * np.abs(now - home) / span
        error = asked - now
        moves = np.abs(error) > np.where(moves, band / 3, band)
        now = now + np.where(moves, gain * error, 0)
        if held[frame]:
            now[-1] = max(now[-1], stop) if opened > closed else min(now[-1], stop)
        found[frame] = now
    return found


def _thing(true: Array, held: NDArray[np.bool_], reaches: list[Reach], arm: ArmModel) -> Array:
    """(T, 3) position of the object: at rest, then in the hand, then below the place of release."""
    hand, found = arm.place(true[:, :-1]), np.empty((len(true), 3))
    now = next((reach.place for reach in reaches if reach.name == "at"), reaches[-1].place)
    for frame in range(len(true)):
        if held[frame]:
            now = hand[frame]
        elif frame and held[frame - 1]:
            now = now * (1, 1, 0)
        found[frame] = now
    return found
