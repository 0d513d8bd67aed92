"""Random layouts: numbers for placements, and bounded rejection sampling."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from demorec.core.errors import SceneError
from demorec.core.geometry import Array
from demorec.core.seeding import generator
from demorec.episode.scene import Shape
from demorec.episode.variation import PRESETS, Ranges
from demorec.objects.shelf import Shelf, Split

MAX_TRIES = 1000
STRATIFIED_NUMBERS = 12
"""Number of stratified placement coordinates of a layout: x, y and yaw of the first four objects."""


@dataclass(frozen=True, kw_only=True)
class Region:
    """A rectangle on the table, metres, world frame, intersected with a ring about the robot's base."""

    # x, y: (low, high).
    x: tuple[float, float]
    y: tuple[float, float]
    # min_radius, max_radius: range of distances from the base at (0, 0) that the hand reaches while pointing down.
    min_radius: float = 0.30
    max_radius: float = 0.72

    def contains(self, point: tuple[float, float]) -> bool:
        """Check whether a point (x, y) is inside."""
        radius = math.hypot(*point)
        return (
            self.x[0] <= point[0] <= self.x[1]
            and self.y[0] <= point[1] <= self.y[1]
            and self.min_radius <= radius <= self.max_radius
        )

    def cut(self, other: Region, what: str) -> Region:
        """Intersect the rectangle with another; SceneError if the intersection is empty."""
        x = (max(self.x[0], other.x[0]), min(self.x[1], other.x[1]))
        y = (max(self.y[0], other.y[0]), min(self.y[1], other.y[1]))
        if x[0] >= x[1] or y[0] >= y[1]:
            raise SceneError(
                f"The held-out rectangle x {other.x}, y {other.y} is outside the region of {what} "
                f"(x {self.x}, y {self.y}): choose another with ranges held_out_x and held_out_y."
            )
        return replace(self, x=x, y=y)


WORKSPACE = Region(x=(0.35, 0.65), y=(-0.25, 0.25))
"""Default region of objects."""


@dataclass
class Sampler:
    """Draws the numbers of a layout."""

    rng: np.random.Generator  # the stream of purpose "scene"
    # Coordinates in 0..1 of a stratified point (Sobol, Latin hypercube), used by the first placements, one per call of
    # `placement`; empty for plain random sampling.
    unit_point: Sequence[float] = ()
    ranges: Ranges = PRESETS["mild"]  # resolved ranges of the run, for `named` and for the initial joints
    # "train" keeps every point out of the held-out rectangle, "eval" puts the first one into it.
    split: Literal["all", "train", "eval"] = "all"
    fixed: bool = False  # whether to use the task's exact layout, if it has one
    shelves: Sequence[Shelf] = ()  # object sets, for tasks that draw from them
    object_split: Split = "all"  # subset of their shapes: `demorec.objects.shelf.Split`
    can_grasp: Callable[[Shape], bool] = lambda shape: True  # whether the robot's gripper can grasp a mesh
    # Whether an object may be at a point (x, y), in addition to the condition of `point`.
    is_free: Callable[[tuple[float, float]], bool] = lambda point: True
    _used: int = field(default=0, init=False)
    _points: int = field(default=0, init=False)

    def uniform(self, low: float, high: float) -> float:
        """Draw a number in low..high."""
        return float(self.rng.uniform(low, high))

    def named(self, name: Literal["cube_side", "cube_mass", "cube_friction"], low: float, high: float) -> float:
        """Draw a number in the user's range of that name, or in the task's own low..high."""
        chosen = getattr(self.ranges, name)
        return self.uniform(*((low, high) if chosen is None else chosen))

    def choice[T](self, options: Sequence[T]) -> T:
        """Draw one of the options."""
        return options[int(self.rng.integers(len(options)))]

    def placement(self, low: float, high: float) -> float:
        """Draw a number in low..high, stratified over the episodes of a stratified run."""
        if self._used < len(self.unit_point):
            value = self.unit_point[self._used]
            self._used += 1
            return low + (high - low) * value
        return self.uniform(low, high)

    def yaw(self) -> float:
        """Draw an angle in -pi..pi."""
        return self.placement(-math.pi, math.pi)

    def point(
        self,
        region: Region,
        *,
        away_from: Sequence[tuple[float, float]] = (),
        min_distance: float = 0.0,
        accept: Callable[[tuple[float, float]], bool] = lambda point: True,
        what: str = "an object",
    ) -> tuple[float, float]:
        """Draw a point (x, y) in a region, at least `min_distance` from the points of `away_from`.

        Raises:
            SceneError: No point was found in 1000 attempts.
        """
        held_out = Region(
            x=self.ranges.range("held_out_x"), y=self.ranges.range("held_out_y"), min_radius=0.0, max_radius=math.inf
        )
        self._points += 1
        if self.split == "eval" and self._points == 1:
            region = region.cut(held_out, what)
        for _ in range(MAX_TRIES):
            candidate = (self.placement(*region.x), self.placement(*region.y))
            far = all(math.dist(candidate, other) >= min_distance for other in away_from)
            allowed = self.split != "train" or not held_out.contains(candidate)
            if far and allowed and region.contains(candidate) and self.is_free(candidate) and accept(candidate):
                return candidate
        raise SceneError(
            f"No place was found for {what} in {MAX_TRIES} attempts: x {region.x}, y {region.y}, {min_distance:g} m "
            f"from {len(away_from)} others; widen the region or place fewer or smaller objects."
        )


def stratified_point(
    method: Literal["random", "sobol", "lhs"], *, root_seed: int, episode_index: int, block: int
) -> tuple[float, ...]:
    """Compute the stratified coordinates in 0..1 of one episode's layout; empty for "random".

    They follow a scrambled Sobol sequence, or one Latin hypercube per `block` episodes (scipy.stats.qmc).
    """
    if method == "random":
        return ()
    if method == "lhs":
        cube, row = divmod(episode_index, block)
        return tuple(_latin_hypercube(root_seed, cube, block)[row].tolist())
    from scipy.stats import qmc

    rng = generator(root_seed=root_seed, episode_index=0, attempt=0, purpose="sampling")
    sequence = qmc.Sobol(d=STRATIFIED_NUMBERS, scramble=True, seed=rng)
    if episode_index:
        sequence.fast_forward(episode_index)
    return tuple(sequence.random(1)[0].tolist())


@functools.lru_cache(maxsize=4)
def _latin_hypercube(root_seed: int, cube: int, block: int) -> Array:
    from scipy.stats import qmc

    rng = generator(root_seed=root_seed, episode_index=cube, attempt=1, purpose="sampling")
    return np.asarray(qmc.LatinHypercube(d=STRATIFIED_NUMBERS, seed=rng).random(block), dtype=np.float64)


def wording(rng: np.random.Generator, *templates: str, **words: object) -> str:
    """Choose one of several wordings of an instruction and fill it in."""
    return templates[int(rng.integers(len(templates)))].format(**words)
