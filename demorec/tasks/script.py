"""Episode-specific behaviour of the expert, the steps of its script, and conditions to wait for."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass

from demorec.episode.episode import Action, Event
from demorec.sim.world import World


class ExpertFailure(Exception):
    """The expert cannot continue; ends the script with a failure."""

    def __init__(self, phase: str, reason: str) -> None:
        super().__init__(phase, reason)
        self.phase, self.reason = phase, reason


@dataclass(frozen=True, kw_only=True)
class Behaviour:
    """Variation in how the expert does one episode; recorded as `EpisodeInfo.behaviour`."""

    speed: float = 1.0  # factor on the speeds of all motions, except that objects never touch down faster than at 1
    # approach_height, lift_height: heights above the grasp, metres.
    approach_height: float = 0.12
    lift_height: float = 0.15
    grasp_offset: float = 0.0  # shift of the grasp along the fingers' faces, metres
    action_noise: float = 0.02  # standard deviation of the exploration noise on the executed joint targets, rad
    # miss_x, miss_y: deliberate error of the first grasp in the hand's frame, metres, x along the fingers' faces; 0 if
    # none. The actual miss may be larger, on the other side or omitted, so that nothing is touched.
    miss_x: float = 0.0
    miss_y: float = 0.0
    # perception_x, perception_y: error of every perceived object position, metres.
    perception_x: float = 0.0
    perception_y: float = 0.0
    perception_yaw: float = 0.0  # error of every perceived object yaw, rad

    @property
    def misses(self) -> bool:
        """Whether the first grasp is missed on purpose."""
        return self.miss_x != 0.0 or self.miss_y != 0.0

    def as_mapping(self) -> dict[str, float]:
        """Convert to name -> value."""
        return {name: float(value) for name, value in asdict(self).items()}


@dataclass(frozen=True, kw_only=True)
class Step:
    """Decision of an agent, such as the script, for one control step; recorded in the `Frame` of that step."""

    action: Action  # the label that a policy learns
    command: Action | None = None  # command for the motors; None: the action
    phase: str = ""  # "approach", "lift", ..
    noise_allowed: bool = False  # whether exploration noise is harmless now (free motion, away from objects)
    events: tuple[Event, ...] = ()  # events since the previous step
    is_deliberate_miss: bool = False  # whether this belongs to a deliberate miss


def lasting(condition: Callable[[], bool], *, steps: int) -> Callable[[], bool]:
    """Make a condition that holds once another one has held for `steps` consecutive control steps."""
    count = 0

    def done() -> bool:
        nonlocal count
        count = count + 1 if condition() else 0
        return count >= steps

    return done


def steady_width(world: World, *, tolerance: float = 0.006, seconds: float = 0.06) -> Callable[[], bool]:
    """Make a condition that holds once the opening has changed by less than `tolerance` (m/s) for `seconds`."""
    last = math.inf

    def is_steady() -> bool:
        nonlocal last
        width = world.arm.gripper_width()
        change, last = abs(width - last) * world.fps, width
        return change < tolerance

    return lasting(is_steady, steps=max(1, round(seconds * world.fps)))
