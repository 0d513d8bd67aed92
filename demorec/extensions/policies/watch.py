"""Monitor of a policy that decides when and why the expert takes over.

The expert has a script but no action for every state. Its trajectory is therefore simulated beforehand in a separate
world from the same state, and the policy's commands are compared with the part of that trajectory that it has reached.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from demorec.core.geometry import Array, angle_between
from demorec.episode.episode import Action, Observation
from demorec.extensions.policies import TakeOver
from demorec.extensions.policies.gym_env import Situation
from demorec.loop import PreparedEpisode, Session
from demorec.sim.world import World
from demorec.tasks.script import Behaviour, ExpertFailure, Step
from demorec.tasks.skills import Expert

_AHEAD_SECONDS = 1.0
"""Maximum progress along the expert's trajectory from one frame to the next, s."""
_SAME_PLACE = 0.001
"""Maximum distance, metres, between two places that count as the same; the later one is used, because the expert also
waits.
"""


def correcting_behaviour(episode: PreparedEpisode, *, noise: bool) -> Behaviour:
    """The expert's behaviour when it takes over an episode: no deliberate misses, with or without `noise`."""
    behaviour = replace(episode.behaviour, miss_x=0.0, miss_y=0.0)
    return behaviour if noise else replace(behaviour, action_noise=0.0)


class Rehearsal:
    """The expert's simulated trajectory from a state.

    Args:
        world: World of the episode's robot; it is reset.
        episode: Episode with the scene and task.
        commands: Commands sent since the episode's start; the trajectory begins after them.
    """

    def __init__(self, world: World, episode: PreparedEpisode, commands: Sequence[Action]) -> None:
        session = Session(world, episode.info.simulated.scene, episode.task)
        session.reset()
        for command in commands:
            session.step(command)
        seen, actions = [session.observation], [world.hold()]
        for step in _steps(world, episode, is_start=not commands):
            seen.append(session.observation)
            actions.append(step.action)
            session.step(step.action)
        self._actions = actions
        self._wanted = np.array([action.base_from_tcp_target.position for action in actions])  # (T, 3)
        self._places = np.array([_place(observation) for observation in seen])  # (T, 4)
        self._objects = {
            name: np.array([observation.object_poses[name].position for observation in seen])  # (T, 3)
            for name in seen[0].object_poses
        }
        self._ahead = max(1, round(_AHEAD_SECONDS * episode.info.fps))
        self._reached = 0

    def distance(self, observation: Observation, command: Action) -> tuple[float, float, float]:
        """Compare a policy's command with the expert's; call once per frame, because the trajectory is followed
        forward.

        Returns:
            Distance, m, from the commanded TCP to the nearest TCP that the expert commands within the next second;
            angle, rad, between the hand directions there; and the largest distance, m, of an object from its position
            at the same place of the expert's trajectory.
        """
        window = slice(self._reached, self._reached + self._ahead)
        off = np.abs(self._places[window] - _place(observation)).sum(axis=1)
        self._reached += int(np.flatnonzero(off < off.min() + _SAME_PLACE)[-1])
        window = slice(self._reached, self._reached + self._ahead)
        shifts = np.linalg.norm(self._wanted[window] - command.base_from_tcp_target.position, axis=1)
        nearest = int(shifts.argmin())
        there = self._actions[self._reached + nearest].base_from_tcp_target
        here = observation.object_poses
        objects = (np.linalg.norm(way[self._reached] - here[name].position) for name, way in self._objects.items())
        angle = angle_between(there, command.base_from_tcp_target)
        return float(shifts[nearest]), angle, float(max(objects, default=0.0))


def _steps(world: World, episode: PreparedEpisode, *, is_start: bool) -> Iterator[Step]:
    """Steps of the expert until it is done or gives up."""
    expert = Expert(world, correcting_behaviour(episode, noise=False))
    try:
        yield from episode.task.script(expert) if is_start else episode.task.resume(expert)
    except ExpertFailure:
        return


def _place(observation: Observation) -> Array:
    """(4,) TCP position and opening, metres: a place on a trajectory."""
    return np.array([*observation.base_from_tcp.position, observation.gripper_width])


_STILL_METRES = 0.005
"""Maximum range of a stuck hand's TCP along each axis, metres."""
_STILL_WIDTH = 0.002
"""Maximum range of a stuck hand's opening, metres."""


class Watch:
    """Monitor of a policy in one episode; a function of the episode and the policy's actions.

    Args:
        rules: Conditions of a takeover.
        episode: Episode whose random stream determines a random moment.
        max_frames: Time limit of the policy.
        world: World in which the expert's trajectory is simulated; needed only for the straying conditions.
    """

    def __init__(
        self, rules: TakeOver, episode: PreparedEpisode, *, max_frames: int, world: World | None = None
    ) -> None:
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
        """Start monitoring when the policy begins to act, or acts again, after these commands of the episode."""
        self._past.clear()
        self._astray = 0
        if commands:
            self._moment = self._limit  # the random moment has passed
        if self._world is not None and (self._rules.stray_metres or self._rules.stray_radians):
            self._rehearsal = Rehearsal(self._world, self._episode, commands)

    def is_over(self, situation: Situation) -> bool:
        """Whether the policy's time is over."""
        return situation.frame_index >= self._limit

    def reason(self, situation: Situation, command: Action) -> str:
        """Reason why the expert takes over instead of this command; "" while the policy continues. Call once
        per frame.
        """
        observation = situation.observation
        self._past.append(_place(observation))
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
