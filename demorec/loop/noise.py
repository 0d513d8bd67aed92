"""Exploration noise on what the expert sends."""

from __future__ import annotations

import math

import numpy as np

from demorec.core.geometry import Array
from demorec.episode.episode import Action
from demorec.episode.features import NOISE_DECAY
from demorec.sim.world import World
from demorec.tasks.script import Step


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
