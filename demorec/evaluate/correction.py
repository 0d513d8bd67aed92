"""The expert takes over from a policy and finishes the episode: corrections without a person.

Where a policy goes wrong it is in states that no demonstration has. What the expert does from there is what the policy
lacks (DAgger, Ross et al. 2011, https://arxiv.org/abs/1011.0686). Frames in which the policy acted have the phase
"policy", all others are the expert's.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from demorec.gym_env import SUCCESS_FRAMES, DemorecEnv
from demorec.loop import Episode
from demorec.loop.agents import Decision
from demorec.loop.noise import ActionNoise
from demorec.recording import Recording
from demorec.scene.episode import HALT_PHASE, POLICY_PHASE, interventions
from demorec.tasks.recovery import TAKE_OVER
from demorec.tasks.script import Behaviour, Step
from demorec.tasks.skills import Expert, GaveUp

TAKE_OVER_EVENT, _MESSAGE = "take_over", "the expert takes over: "
HAND_BACK_EVENT = "hand_back"
_RECOVERY = (HALT_PHASE, TAKE_OVER, "recover", "perceive")
"""Phases in which the expert is not yet back where demonstrations go."""


def correcting_behaviour(episode: Episode, *, noise: bool) -> Behaviour:
    """How the expert does it in an episode that it takes over: without a miss on purpose, with `noise` or without."""
    behaviour = replace(episode.behaviour, miss_x=0.0, miss_y=0.0)
    return behaviour if noise else replace(behaviour, action_noise=0.0)


@dataclass
class Correction:
    """The expert at work in an environment that a policy has left.

    Args:
        env: As the policy left it.
        reason: Why the expert takes over.
        behaviour: How it does it.
        rng: Of the noise on what it sends.

    Attributes:
        gave_up: (phase, reason), once the expert has given up; else ("", "").
        num_retries: How often it tried something again.
    """

    env: DemorecEnv
    reason: str
    behaviour: Behaviour
    rng: np.random.Generator
    gave_up: tuple[str, str] = ("", "")
    num_retries: int = 0

    def decisions(self) -> Iterator[Decision]:
        """One a control step, the labels without noise, until the task is done or given up; then a few that hold."""
        world = self.env.world
        expert = Expert(world, self.behaviour)
        noise = ActionNoise(world, sigma=self.behaviour.action_noise, rng=self.rng, fps=world.fps)
        expert.note(TAKE_OVER_EVENT, f"{_MESSAGE}{self.reason}")
        for step in self._steps(expert):
            self.num_retries = expert.num_retries
            yield Decision(action=step.action, command=noise.command(step), phase=step.phase, events=step.events)

    def _steps(self, expert: Expert) -> Iterator[Step]:
        try:
            yield from self.env.episode.task.resume(expert)
        except GaveUp as error:
            self.gave_up = error.phase, error.reason
            yield expert.step()  # which carries the events that say why
            return
        for _ in range(SUCCESS_FRAMES):
            yield expert.step()


def is_back(decision: Decision) -> bool:
    """Whether the expert, who wants this next, has brought the arm to where demonstrations go."""
    return decision.phase not in _RECOVERY


@dataclass(frozen=True, kw_only=True)
class TakenOver:
    """What a recording tells of its corrections.

    Attributes:
        reasons: Why the expert took over, each time.
        num_frames: How many the expert acted in.
        has_interventions: Whether it did more than stop the arm (`interventions`).
    """

    reasons: tuple[str, ...]
    num_frames: int
    has_interventions: bool


def read_takeover(path: Path) -> TakenOver | None:
    """Of the recording of a rollout; None where the policy acted to the end.

    Raises:
        RecordingError: It cannot be read.
    """
    with Recording(path) as recording:
        messages = [event.message for _, event in recording.events() if event.name == TAKE_OVER_EVENT]
        if not messages:
            return None
        phases = recording.columns().phase
    return TakenOver(
        reasons=tuple(message.removeprefix(_MESSAGE) for message in messages),
        num_frames=sum(phase != POLICY_PHASE for phase in phases),
        has_interventions=bool(interventions(phases).any()),
    )
