"""Control of a rollout, frame by frame: the policy acts, and the expert corrects it.

A policy that errs reaches states that no demonstration has. The expert's actions from there are the data that the
policy lacks (DAgger, Ross et al. 2011, https://arxiv.org/abs/1011.0686). The policy's frames have the phase "policy",
all others are the expert's.
"""

from __future__ import annotations

import math
from collections.abc import Generator, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from demorec.episode.episode import HALT_PHASE, POLICY_PHASE, Action, Event, Frame
from demorec.episode.scene import Goal
from demorec.extensions.policies import TakeOver
from demorec.extensions.policies.gym_env import SUCCESS_FRAMES, DemorecEnv
from demorec.extensions.policies.policy import Policy
from demorec.extensions.policies.watch import Watch, correcting_behaviour
from demorec.loop.session import ActionNoise
from demorec.mcap import open_simulated
from demorec.sim.world import World
from demorec.tasks.recovery import TAKE_OVER
from demorec.tasks.script import ExpertFailure, Step
from demorec.tasks.skills import Expert
from demorec.tasks.success import goal_pose

TAKE_OVER_EVENT, HAND_BACK_EVENT, _MESSAGE = "take_over", "hand_back", "the expert takes over: "
_RECOVERY = (HALT_PHASE, TAKE_OVER, "recover", "perceive")
"""Phases before the expert has returned to states that demonstrations have."""
PHASES = ("reach", "lift", "transport", "place")
"""reach: nothing was grasped; lift: grasped, but not lifted; transport: lifted, but not near its goal; place: near its
goal, but the conditions did not hold at the end.
"""

GRASP_FORCE = 0.5
LIFTED = 0.03
NEAR_GOAL = 0.05


class Turns:
    """One rollout, from a reset environment to its end.

    Args:
        env: Environment after a reset.
        policy: Policy, which acts first.
        observation: Observation of the reset.
        seed: Seed of the policy for each of its turns.
        rules: Conditions of a takeover; None: never, so that the policy acts until its time is over.
        rehearsal_world: World of `Watch`.

    Attributes:
        success: Whether the task was done.
        num_retries: Number of the expert's retries.
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
        self._gave_up = self._trouble = "", ""
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
        self._stages = [0] * len(env.info.simulated.scene.goals)

    def frames(self) -> Iterator[Frame]:
        """Yield each frame after its command was executed."""
        reason = yield from self._policy_acts()
        while reason:
            handed_back = yield from self._expert_acts(reason)
            if not handed_back:
                return
            reason = yield from self._policy_acts(Event(name=HAND_BACK_EVENT, message="the policy acts again"))

    def _policy_acts(self, *events: Event) -> Generator[Frame, None, str]:
        """Return the reason for a takeover; "" at the end of the rollout."""
        env = self._env
        self._policy.reset(self._seed)
        if self._watch is not None:
            self._watch.begin(self._commands)
        while True:
            command = env.command_for(self._policy.act(self._observation, env.info.instruction))
            reason = "" if self._watch is None else self._watch.reason(env.situation, command)
            if reason:
                return reason
            yield self._step(Step(action=command, phase=POLICY_PHASE, events=events))
            events = ()
            if self.success or (self._watch is None and self._is_out_of_time):
                return ""

    def _expert_acts(self, reason: str) -> Generator[Frame, None, bool]:
        """Return whether the policy acts again."""
        world, behaviour, retries = self._env.world, self._behaviour, self.num_retries
        expert = Expert(world, behaviour)
        expert.note(TAKE_OVER_EVENT, f"{_MESSAGE}{reason}")
        noise = ActionNoise(world, sigma=behaviour.action_noise, rng=self._noise_rng, fps=world.fps)
        for step in self._steps(expert):
            command = noise.command(step)
            is_back = step.phase not in _RECOVERY
            if self._hands_back and is_back and self._watch and not self._watch.is_over(self._env.situation):
                return True
            yield self._step(replace(step, command=command, is_deliberate_miss=False))
            self.num_retries = retries + expert.num_retries
            if self.success:
                return False
        self._gave_up = self._trouble
        return False

    def _steps(self, expert: Expert) -> Iterator[Step]:
        """Yield steps until the task is done or given up, then a few that hold."""
        self._trouble = "", ""
        try:
            yield from self._env.episode.task.resume(expert)
        except ExpertFailure as error:
            self._trouble = error.phase, error.reason
            yield expert.step()  # which carries the events with the reasons
            return
        for _ in range(SUCCESS_FRAMES):
            yield expert.step()

    def _step(self, step: Step) -> Frame:
        self._observation, _, self.success, self._is_out_of_time, _ = self._env.act(step)
        goals = self._env.info.simulated.scene.goals
        self._stages = [max(stage, self._reached(goal, stage)) for goal, stage in zip(goals, self._stages, strict=True)]
        frame = self._env.situation.last_frame
        assert frame is not None  # because there was a step
        self._commands.append(frame.command)
        return frame

    def _reached(self, goal: Goal, stage: int) -> int:
        """Number of `PHASES` that an object has passed, at most one more than before."""
        world = self._env.world
        held = world.grip_force(goal.object) > GRASP_FORCE
        position = world.pose(goal.object).position
        if stage == 0:
            return 1 if held else 0
        start = self._env.info.simulated.scene.body(goal.object).world_from_body.position
        if stage == 1:
            return 2 if held and position[2] - start[2] > LIFTED else 1
        return 3 if math.dist(position[:2], goal_pose(world, goal).position[:2]) < NEAR_GOAL else 2

    def failure(self) -> tuple[str, str]:
        """(phase, reason) of a failed rollout, ("", "") otherwise: the expert's reason for giving up; otherwise the
        phase of the object with the least progress, and the first condition that does not hold, or "time_limit".
        """
        if self.success or self._gave_up[1]:
            return ("", "") if self.success else self._gave_up
        reason = next((check.name for check in self._env.situation.checks if not check.passed), "time_limit")
        return PHASES[min(self._stages, default=0)], reason


class TakenOver(NamedTuple):
    """Corrections in a recording: the reason of each takeover, and the number of the expert's frames."""

    reasons: tuple[str, ...]
    num_frames: int


def read_takeover(path: Path) -> TakenOver | None:
    """Read the corrections of a rollout's recording; None if the policy acted to the end.

    Raises:
        RecordingError: It cannot be read.
    """
    with open_simulated(path) as recording:
        messages = [event.message for _, event in recording.events() if event.name == TAKE_OVER_EVENT]
        if not messages:
            return None
        phases = recording.phases
    return TakenOver(
        reasons=tuple(message.removeprefix(_MESSAGE) for message in messages),
        num_frames=sum(phase != POLICY_PHASE for phase in phases),
    )
