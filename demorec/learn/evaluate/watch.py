"""Watches a policy, and says when and why the expert takes over."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np

from demorec.core.geometry import Array
from demorec.episode.episode import Action
from demorec.gym_env import Situation
from demorec.learn.evaluate.moments import TakeOver
from demorec.learn.evaluate.rehearsal import Rehearsal
from demorec.loop import Episode
from demorec.sim.world import World

_STILL_METRES, _STILL_WIDTH = 0.005, 0.002
"""A hand is stuck while its TCP stays within so much along each axis, and its opening within so much."""


class Watch:
    """Watches a policy in one episode; a function of the episode and of what the policy does.

    Args:
        rules: When the expert takes over.
        episode: Whose random stream says at which moment, if at a random one.
        max_frames: Time limit of the policy.
        world: In which the expert's way is rehearsed; needed only where straying counts.
    """

    def __init__(self, rules: TakeOver, episode: Episode, *, max_frames: int, world: World | None = None) -> None:
        fps = episode.info.fps
        self._rules, self._episode, self._world = rules, episode, world
        self._limit = min(max_frames, round(rules.after_seconds * fps) or max_frames)
        random = episode.rng("takeover")
        is_random, moment = random.random() < rules.random_share, int(random.integers(1, self._limit + 1))
        self._moment = moment if is_random else self._limit
        self._past: deque[Array] = deque(maxlen=max(2, round(rules.stuck_seconds * fps)))
        self._max_astray = max(1, round(rules.stray_seconds * fps))
        self._astray = 0
        self._rehearsal: Rehearsal | None = None

    def begin(self, commands: Sequence[Action]) -> None:
        """The policy begins to act, or acts again, after these commands of the episode."""
        self._past.clear()
        self._astray = 0
        if commands:
            self._moment = self._limit  # the random moment has been
        if self._world is not None and (self._rules.stray_metres or self._rules.stray_radians):
            self._rehearsal = Rehearsal(self._world, self._episode, commands)

    def is_over(self, situation: Situation) -> bool:
        """Whether the policy has had its time."""
        return situation.frame_index >= self._limit

    def reason(self, situation: Situation, command: Action) -> str:
        """Why the expert takes over instead of this command; "" while the policy goes on. To be asked once a frame."""
        observation = situation.observation
        self._past.append(np.array([*observation.base_from_tcp.position, observation.gripper_width]))
        if self.is_over(situation):
            return "the policy has had its time"
        if situation.frame_index >= self._moment:
            return "a random moment"
        if self._rules.stuck_seconds > 0 and len(self._past) == self._past.maxlen:
            spread = np.ptp(np.array(self._past), axis=0)
            if (spread[:3] < _STILL_METRES).all() and spread[3] < _STILL_WIDTH:
                return "the policy is stuck"
        return self._stray(situation, command)

    def _stray(self, situation: Situation, command: Action) -> str:
        if self._rehearsal is None:
            return ""
        limits = self._rules
        tcp, angle, objects = self._rehearsal.distance(situation.observation, command)
        if 0.0 < limits.stray_metres < objects:
            return "an object is astray"
        is_astray = 0.0 < limits.stray_metres < tcp or 0.0 < limits.stray_radians < angle
        self._astray = self._astray + 1 if is_astray else 0
        return "the policy strays" if self._astray >= self._max_astray else ""
