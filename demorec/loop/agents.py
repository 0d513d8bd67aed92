"""What an agent is to a session; the agent that follows a task's script, and the exploration noise on its commands."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np

from demorec.core.geometry import Array
from demorec.episode.episode import Action
from demorec.episode.features import NOISE_DECAY
from demorec.loop.prepare import Episode
from demorec.sim.world import World
from demorec.tasks.interjection import mistake
from demorec.tasks.script import Step
from demorec.tasks.skills import Expert, GaveUp


class ActionNoise:
    """Ornstein-Uhlenbeck noise on the executed joint targets; nothing is added except in free motion.

    The label stays clean, so that a policy learns how to come back (DART, Laskey et al. 2017,
    https://arxiv.org/abs/1703.09327). The noise lets go at the same rate whether more is added or not
    (`demorec.episode.features.NOISE_DECAY`), so that there is one way back from it, which increments of the command can
    hold. Every command stays within the joint limits in position and velocity.
    """

    def __init__(self, world: World, *, sigma: float, rng: np.random.Generator, fps: int) -> None:
        self._arm = world.arm
        self._sigma, self._rng = sigma, rng
        self._decay = (1.0 - NOISE_DECAY) ** (30 / fps)
        self._max_step = np.array(world.robot.velocity_limit) / fps
        self._noise: Array = np.zeros(len(self._max_step))
        self._last: Array = world.arm.target.copy()

    def command(self, step: Step) -> Action:
        """What is sent to the motors for a step: its clean action plus the noise."""
        if self._sigma == 0.0:
            return step.action
        drawn = self._rng.normal(0.0, self._sigma, len(self._noise))
        self._noise = self._decay * self._noise
        if step.noise_allowed:
            self._noise = self._noise + math.sqrt(1 - self._decay**2) * drawn
        target = step.action.joint_target + self._noise
        target = np.clip(target, self._arm.kinematics.lower, self._arm.kinematics.upper)
        target = np.clip(target, self._last - self._max_step, self._last + self._max_step)
        self._last = target
        return self._arm.action(target, step.action.gripper_target)


class Agent(Protocol):
    """Acts in a run of a session."""

    @property
    def num_retries(self) -> int:
        """How often something had to be tried again."""

    def decide(self, world: World) -> Iterator[Step]:
        """What to do, step by step, from a reset world on; the world has advanced when the iterator resumes."""

    def failure(self, failed: Sequence[str]) -> tuple[str, str]:
        """Phase and reason of a failure, ("", "") for a success.

        Args:
            failed: Names of the task's conditions that do not hold in the end.
        """


class ScriptAgent:
    """The expert, who follows the task's script; exploration noise is on the commands, never on the labels."""

    def __init__(self, episode: Episode) -> None:
        self._episode = episode
        self._expert: Expert | None = None
        self._gave_up: GaveUp | None = None

    @property
    def num_retries(self) -> int:
        """See `Agent`."""
        return 0 if self._expert is None else self._expert.num_retries

    def decide(self, world: World) -> Iterator[Step]:
        """See `Agent`."""
        behaviour = self._episode.behaviour
        self._expert, self._gave_up = Expert(world, behaviour), None
        noise = ActionNoise(world, sigma=behaviour.action_noise, rng=self._episode.rng("noise"), fps=world.fps)
        for step in self._steps(self._expert):
            yield replace(step, command=noise.command(step))

    def _steps(self, expert: Expert) -> Iterator[Step]:
        """The script; when the expert gives up, one step more, which carries the events that say why.

        It goes on only as long as the hand does what a real one could: a demonstration that crushes things is none.
        """
        try:
            for step in self._script(expert):
                yield step
                if name := expert.world.crushed():
                    expert.note("crush", f"pressed on {name} harder than a hand can", trouble=True)
                    raise GaveUp(*expert.trouble)
        except GaveUp as error:
            self._gave_up = error
            yield expert.step()

    def _script(self, expert: Expert) -> Iterator[Step]:
        if self._episode.interjection is not None:
            yield from mistake(expert, self._episode.interjection)
        yield from self._episode.task.script(expert)

    def failure(self, failed: Sequence[str]) -> tuple[str, str]:
        """See `Agent`."""
        if self._gave_up is not None:
            return self._gave_up.phase, self._gave_up.reason
        if not failed or self._expert is None:
            return "", ""
        return self._expert.trouble[0] or self._expert.phase, failed[0]
