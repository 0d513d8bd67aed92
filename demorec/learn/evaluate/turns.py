"""Who acts in a rollout, frame by frame: the policy, and where it is corrected the expert."""

from __future__ import annotations

from collections.abc import Generator, Iterator
from typing import Any

from demorec.episode.episode import HALT_PHASE, POLICY_PHASE, Action, Event, Frame
from demorec.gym_env import SUCCESS_FRAMES, DemorecEnv
from demorec.learn.evaluate.correction import begin_correction, correcting_behaviour
from demorec.learn.evaluate.moments import TakeOver
from demorec.learn.evaluate.policy import Policy
from demorec.learn.evaluate.watch import Watch
from demorec.loop.agents import ActionNoise, Decision
from demorec.sim.world import World
from demorec.tasks.recovery import TAKE_OVER
from demorec.tasks.script import Step
from demorec.tasks.skills import Expert, GaveUp

HAND_BACK_EVENT = "hand_back"
_RECOVERY = (HALT_PHASE, TAKE_OVER, "recover", "perceive")
"""Phases in which the expert is not yet back where demonstrations go."""


class Turns:
    """One rollout, from a reset environment to its end.

    Args:
        env: Just reset.
        policy: Acts first.
        observation: What the reset gave.
        seed: Of the policy, for each of its turns.
        rules: When the expert takes over; None: never, and the policy acts until its time is up.
        rehearsal_world: As of `Watch`.

    Attributes:
        success: Whether the task was done.
        gave_up: (phase, reason), once the expert has given up; else ("", "").
        num_retries: How often the expert tried something again.
    """

    def __init__(
        self,
        env: DemorecEnv,
        policy: Policy,
        observation: dict[str, Any],
        *,
        seed: int,
        rules: TakeOver | None = None,
        rehearsal_world: World | None = None,
    ) -> None:
        self.success = False
        self.gave_up = self._trouble = "", ""
        self.num_retries = 0
        self._env, self._policy, self._observation, self._seed = env, policy, observation, seed
        self._hands_back = rules is not None and rules.hand_back
        self._behaviour = correcting_behaviour(env.episode, noise=rules is not None and rules.noise)
        self._noise_rng = env.episode.rng("noise")
        self._watch = None
        if rules is not None:
            self._watch = Watch(rules, env.episode, max_frames=env.max_episode_steps, world=rehearsal_world)
        self._commands: list[Action] = []
        self._is_out_of_time = False

    def frames(self) -> Iterator[Frame]:
        """Each frame, once its command has been carried out."""
        reason = yield from self._policy_acts()
        while reason:
            handed_back = yield from self._expert_acts(reason)
            if not handed_back:
                return
            reason = yield from self._policy_acts(Event(name=HAND_BACK_EVENT, message="the policy acts again"))

    def _policy_acts(self, *events: Event) -> Generator[Frame, None, str]:
        """Returns why the expert takes over; "" at the end of the rollout."""
        env = self._env
        self._policy.reset(self._seed)
        if self._watch is not None:
            self._watch.begin(self._commands)
        while True:
            command = env.command_for(self._policy.act(self._observation, env.info.instruction))
            reason = "" if self._watch is None else self._watch.reason(env.situation, command)
            if reason:
                return reason
            yield self._step(Decision(action=command, command=command, phase=POLICY_PHASE, events=events))
            events = ()
            if self.success or (self._watch is None and self._is_out_of_time):
                return ""

    def _expert_acts(self, reason: str) -> Generator[Frame, None, bool]:
        """Returns whether the policy shall act again."""
        world, behaviour, retries = self._env.world, self._behaviour, self.num_retries
        expert = begin_correction(world, behaviour, reason)
        noise = ActionNoise(world, sigma=behaviour.action_noise, rng=self._noise_rng, fps=world.fps)
        for step in self._steps(expert):
            command = noise.command(step)
            is_back = step.phase not in _RECOVERY
            if self._hands_back and is_back and self._watch and not self._watch.is_over(self._env.situation):
                return True
            yield self._step(Decision(action=step.action, command=command, phase=step.phase, events=step.events))
            self.num_retries = retries + expert.num_retries
            if self.success:
                return False
        self.gave_up = self._trouble
        return False

    def _steps(self, expert: Expert) -> Iterator[Step]:
        """Until the task is done or given up; then a few that hold."""
        self._trouble = "", ""
        try:
            yield from self._env.episode.task.resume(expert)
        except GaveUp as error:
            self._trouble = error.phase, error.reason
            yield expert.step()  # which carries the events that say why
            return
        for _ in range(SUCCESS_FRAMES):
            yield expert.step()

    def _step(self, decision: Decision) -> Frame:
        self._observation, _, self.success, self._is_out_of_time, _ = self._env.act(decision)
        self._commands.append(decision.command)
        frame = self._env.situation.last_frame
        assert frame is not None  # since there was a step
        return frame
