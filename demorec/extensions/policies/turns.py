"""Control of a rollout, frame by frame: the policy acts, and the expert corrects it.

A policy that errs reaches states that no demonstration has. The expert's actions from there are the data that the
policy lacks (DAgger, Ross et al. 2011, https://arxiv.org/abs/1011.0686). The policy's frames have the phase "policy",
all others are the expert's.

The expert has a script but no action for every state. Its trajectory is therefore simulated beforehand in a separate
world, and the policy's commands are compared with the part of that trajectory that it has reached.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Generator, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from demorec.core.geometry import Array, angle_between
from demorec.episode.episode import POLICY_PHASE, Action, Frame, Observation
from demorec.episode.scene import Goal
from demorec.extensions.policies.gym_env import SUCCESS_FRAMES, DemorecEnv, Situation
from demorec.extensions.policies.policy import Policy
from demorec.extensions.policies.takeover import TakeOver
from demorec.loop import PreparedEpisode, Session
from demorec.loop.session import ActionNoise
from demorec.mcap import open_simulated
from demorec.sim.world import World
from demorec.tasks.script import Behaviour, ExpertFailure, Step
from demorec.tasks.skills import Expert
from demorec.tasks.success import goal_pose

TAKE_OVER_EVENT, _MESSAGE = "take_over", "the expert takes over: "
PHASES = ("reach", "lift", "transport", "place")
"""reach: nothing was grasped; lift: grasped, but not lifted; transport: lifted, but not near its goal; place: near its
goal, but the conditions did not hold at the end.
"""

GRASP_FORCE = 0.5
LIFTED = 0.03
NEAR_GOAL = 0.05
_AHEAD_SECONDS = 1.0
"""Maximum progress along the expert's trajectory from one frame to the next, s."""
_SAME_PLACE = 0.001
"""Maximum distance, metres, between two places that count as the same; the later one is used, because the expert also
waits.
"""
_STRAY_SECONDS = 0.2
"""How long the commanded TCP must stay off the expert's path."""
_STILL_METRES = 0.005
"""Maximum range of a stuck hand's TCP along each axis, metres."""
_STILL_WIDTH = 0.002
"""Maximum range of a stuck hand's opening, metres."""


def correcting_behaviour(episode: PreparedEpisode, *, noise: bool) -> Behaviour:
    """The expert's behaviour when it takes over an episode: no deliberate misses, with or without `noise`."""
    behaviour = replace(episode.behaviour, miss_x=0.0, miss_y=0.0)
    return behaviour if noise else replace(behaviour, action_noise=0.0)


class Turns:
    """One rollout, from a reset environment to its end.

    Args:
        env: Environment after a reset.
        policy: Policy, which acts first.
        observation: Observation of the reset.
        seed: Seed of the policy.
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
        self.success, self.num_retries = False, 0
        self._trouble = "", ""
        self._env, self._policy, self._observation = env, policy, observation
        self._behaviour = correcting_behaviour(env.episode, noise=rules is not None and rules.noise)
        self._watch = None
        if rules is not None:
            self._watch = Watch(rules, env.episode, max_frames=env.max_episode_steps, world=rehearsal_world)
        self._is_out_of_time = False
        self._stages = [0] * len(env.info.simulated.scene.goals)
        policy.reset(seed)

    def frames(self) -> Iterator[Frame]:
        """Yield each frame after its command was executed."""
        reason = yield from self._policy_acts()
        if reason:
            yield from self._expert_acts(reason)

    def _policy_acts(self) -> Generator[Frame, None, str]:
        """Return the reason for a takeover; "" at the end of the rollout."""
        env = self._env
        while not self.success and (self._watch is not None or not self._is_out_of_time):
            command = env.command_for(self._policy.act(self._observation, env.info.instruction))
            reason = "" if self._watch is None else self._watch.reason(env.situation, command)
            if reason:
                return reason
            yield self._step(Step(action=command, phase=POLICY_PHASE))
        return ""

    def _expert_acts(self, reason: str) -> Iterator[Frame]:
        world, rng = self._env.world, self._env.episode.rng("noise")
        expert = Expert(world, self._behaviour)
        expert.note(TAKE_OVER_EVENT, f"{_MESSAGE}{reason}")
        noise = ActionNoise(world, sigma=self._behaviour.action_noise, rng=rng)
        for step in self._steps(expert):
            yield self._step(replace(step, command=noise.command(step), is_deliberate_miss=False))
            self.num_retries = expert.num_retries
            if self.success:
                return

    def _steps(self, expert: Expert) -> Iterator[Step]:
        """Yield steps until the task is done or given up, then a few that hold."""
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
        if self.success or self._trouble[1]:
            return ("", "") if self.success else self._trouble
        reason = next((check.name for check in self._env.situation.checks if not check.passed), "time_limit")
        return PHASES[min(self._stages, default=0)], reason


class Watch:
    """Monitor of a policy in one episode that decides when and why the expert takes over.

    Args:
        rules: Conditions of a takeover.
        episode: The episode.
        max_frames: Time limit of the policy.
        world: World in which the expert's trajectory is simulated; needed only for the straying conditions.
    """

    def __init__(
        self, rules: TakeOver, episode: PreparedEpisode, *, max_frames: int, world: World | None = None
    ) -> None:
        fps = episode.info.fps
        self._rules, self._limit = rules, max_frames
        self._past: deque[Array] = deque(maxlen=max(2, round(rules.stuck_seconds * fps)))
        self._max_astray = max(1, round(_STRAY_SECONDS * fps))
        self._astray = 0
        self._rehearsal = None
        if world is not None and (rules.stray_metres or rules.stray_radians):
            self._rehearsal = _Rehearsal(world, episode)

    def reason(self, situation: Situation, command: Action) -> str:
        """Reason why the expert takes over instead of this command; "" while the policy continues. Call once
        per frame.
        """
        self._past.append(_place(situation.observation))
        if situation.frame_index >= self._limit:
            return "the policy has had its time"
        if self._rules.stuck_seconds > 0 and len(self._past) == self._past.maxlen:
            spread = np.ptp(np.array(self._past), axis=0)
            if (spread[:3] < _STILL_METRES).all() and spread[3] < _STILL_WIDTH:
                return "the policy is stuck"
        if self._rehearsal is None:
            return ""
        limits = self._rules
        tcp, angle, objects = self._rehearsal.distance(situation.observation, command)
        if 0.0 < limits.stray_metres < objects:
            return "an object is astray"
        is_astray = 0.0 < limits.stray_metres < tcp or 0.0 < limits.stray_radians < angle
        self._astray = self._astray + 1 if is_astray else 0
        return "the policy strays" if self._astray >= self._max_astray else ""


class _Rehearsal:
    """The expert's trajectory, simulated in a world of the episode's robot."""

    def __init__(self, world: World, episode: PreparedEpisode) -> None:
        session = Session(world, episode.info.simulated.scene, episode.task)
        session.reset()
        seen, actions = [session.observation], [world.hold()]
        expert = Expert(world, correcting_behaviour(episode, noise=False))
        try:
            for step in episode.task.script(expert):
                seen.append(session.observation)
                actions.append(step.action)
                session.step(step.action)
        except ExpertFailure:
            pass  # the trajectory ends here
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


def _place(observation: Observation) -> Array:
    """(4,) TCP position and opening, metres: a place on a trajectory."""
    return np.array([*observation.base_from_tcp.position, observation.gripper_width])


def read_takeover(path: Path) -> str:
    """Read the reason of the takeover in a rollout's recording; "" if the policy acted to the end.

    Raises:
        RecordingError: It cannot be read.
    """
    with open_simulated(path) as recording:
        messages = (event.message for _, event in recording.events() if event.name == TAKE_OVER_EVENT)
        return next(messages, "").removeprefix(_MESSAGE)
