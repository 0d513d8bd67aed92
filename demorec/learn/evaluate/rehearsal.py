"""What the expert would do from here, found out in a world of its own, and how far a policy is from that.

The expert has a script, and no action for every state: so its way is simulated beforehand, from the same state on, and
a policy's commands are compared with the part of that way that it has reached.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from demorec.core.geometry import Array
from demorec.episode.episode import Action, Observation
from demorec.learn.evaluate.correction import correcting_behaviour
from demorec.loop import Episode, Session
from demorec.robots.motion import angle_between
from demorec.sim.world import World
from demorec.tasks.script import Step
from demorec.tasks.skills import Expert, GaveUp

_AHEAD_SECONDS = 1.0
"""How far ahead on the expert's way a policy may be from one frame to the next."""
_SAME_PLACE = 0.001
"""Metres within which two places of the way are one; the later one counts, since the expert also waits."""


class Rehearsal:
    """The expert's way from a state on.

    Args:
        world: Of the episode's robot; it is reset.
        episode: Whose scene and task.
        commands: What was sent since the episode's start; the way begins after them.
    """

    def __init__(self, world: World, episode: Episode, commands: Sequence[Action]) -> None:
        session = Session(world, episode.info.scene, episode.task)
        session.reset()
        for command in commands:
            session.step(command)
        seen, said = [session.observation], [world.hold()]
        for step in _steps(world, episode, is_start=not commands):
            seen.append(session.observation)
            said.append(step.action)
            session.step(step.action)
        self._actions = said
        self._wanted = np.array([action.base_from_tcp_target.position for action in said])  # (T, 3)
        self._places = np.array([_place(observation) for observation in seen])  # (T, 4)
        self._objects = {
            name: np.array([observation.object_poses[name].position for observation in seen])  # (T, 3)
            for name in seen[0].object_poses
        }
        self._ahead = max(1, round(_AHEAD_SECONDS * episode.info.fps))
        self._reached = 0

    def distance(self, observation: Observation, command: Action) -> tuple[float, float, float]:
        """How far a policy is that commands this now; to be asked once a frame, since the way is followed forward.

        Returns:
            Metres from the TCP that it commands to the nearest one that the expert commands within the next second;
            radians between the directions of the hand there; and metres from the objects to where the expert has them
            at the same place of its way, the largest.
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


def _steps(world: World, episode: Episode, *, is_start: bool) -> Iterator[Step]:
    """What the expert does until it is done or gives up."""
    expert = Expert(world, correcting_behaviour(episode, noise=False))
    try:
        yield from episode.task.script(expert) if is_start else episode.task.resume(expert)
    except GaveUp:
        return


def _place(observation: Observation) -> Array:
    """(4,) TCP position and opening, metres: where on a way somebody is."""
    return np.array([*observation.base_from_tcp.position, observation.gripper_width])
