"""One episode in a simulated world, step by step: an agent decides, a session executes.

The agent of demonstrations follows a task's script, with exploration noise on its commands.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Protocol, Self

import numpy as np

from demorec.core.geometry import Array
from demorec.episode.episode import (
    TIME_LIMIT,
    Action,
    CameraImages,
    Frame,
    Observation,
    Outcome,
    SuccessCheck,
    frame_time_ns,
)
from demorec.episode.features import NOISE_DECAY
from demorec.episode.scene import Scene
from demorec.loop.prepare import PreparedEpisode
from demorec.render import Renderer
from demorec.render.painter import Painter
from demorec.sim.world import World
from demorec.tasks.base import Task
from demorec.tasks.script import ExpertFailure, Step
from demorec.tasks.skills import Expert


class Agent(Protocol):
    """Source of decisions in a run of a session."""

    @property
    def num_retries(self) -> int:
        """Number of repeated attempts at a step."""

    def decide(self, world: World) -> Iterator[Step]:
        """Yield decisions step by step from a reset world; the world has advanced when the iterator resumes."""

    def failure(self, failed: Sequence[str]) -> tuple[str, str]:
        """Return phase and reason of a failure; ("", "") for a success.

        Args:
            failed: Names of the task's conditions that do not hold at the end.
        """


class Session:
    """The only component that resets a world, steps it and observes it.

    `run` lets an agent act until it is done. A caller that acts from outside, such as gymnasium, calls `reset`, then
    alternates `frame` and `step`.

    Args:
        world: World with the scene's robot; not closed by the session.
        scene: Scene that each reset builds.
        task: Task that provides the success conditions, or None.
        painter: Source of the images, or None.
        max_frames: Time limit of `run`; None: until the agent is done.

    Attributes:
        world: As given.
        frame_index: Control steps since the reset.
    """

    def __init__(
        self,
        world: World,
        scene: Scene,
        task: Task | None,
        *,
        painter: Painter | None = None,
        max_frames: int | None = None,
    ) -> None:
        self.world = world
        self.frame_index = 0
        self._scene, self._task, self._painter, self._max_frames = scene, task, painter, max_frames
        self._observation: Observation | None = None
        self._images: Mapping[str, CameraImages] | None = None
        self._outcome: Outcome | None = None

    @classmethod
    def of_episode(
        cls, world: World, episode: PreparedEpisode, renderer: Renderer | None = None, *, only_color: bool = False
    ) -> Self:
        """Create a session of a prepared episode with its cameras and time limit; images need a renderer.

        `only_color` omits the depth and segmentation images that the config requests.
        """
        config = episode.plan.config
        painter = None
        if renderer is not None:
            painter = Painter(
                renderer,
                episode.cameras,
                true_from_recorded=episode.true_from_recorded,
                depth=config.depth and not only_color,
                segmentation=config.segmentation and not only_color,
                antialias=config.antialias,
            )
        max_frames = math.floor(config.max_episode_seconds * episode.info.fps)
        return cls(world, episode.info.simulated.scene, episode.task, painter=painter, max_frames=max_frames)

    @property
    def observation(self) -> Observation:
        """Current observation."""
        if self._observation is None:
            self._observation = self.world.observe()
        return self._observation

    @property
    def images(self) -> Mapping[str, CameraImages]:
        """Camera name -> current images; RenderError if a camera or body cannot be drawn."""
        if self._images is None:
            self._images = {} if self._painter is None else self._painter.images()
        return self._images

    @property
    def outcome(self) -> Outcome:
        """Outcome of the last run; RuntimeError before its end."""
        if self._outcome is None:
            raise RuntimeError("the episode has not ended: take all frames of the run first")
        return self._outcome

    def checks(self) -> tuple[SuccessCheck, ...]:
        """The task's conditions with their current values."""
        return () if self._task is None else self._task.evaluate(self.world)

    def run(self, agent: Agent) -> Iterator[Frame]:
        """Reset the world and let the agent act; yields each frame before its command is sent.

        Raises:
            SceneError, RenderError: The scene cannot be built or drawn.
        """
        self.reset()
        stopped = ("", "")
        for step in agent.decide(self.world):
            if self.frame_index == self._max_frames:
                stopped = (step.phase, TIME_LIMIT)
                break
            frame = self.frame(step)
            yield frame
            self.step(frame.command)
        checks = self.checks()
        phase, reason = stopped if stopped[1] else agent.failure([check.name for check in checks if not check.passed])
        self._outcome = Outcome(
            success=not reason,
            checks=checks,
            failure_phase=phase,
            failure_reason=reason,
            num_frames=self.frame_index,
            num_retries=agent.num_retries,
            final_state_digest=self.world.state_digest(),
        )

    def reset(self) -> None:
        """Rebuild the scene; raises as `run`."""
        self.world.reset(self._scene)
        if self._painter is not None:
            self._painter.setup(self.world)
        self._outcome = None
        self._arrive(0)

    def frame(self, step: Step) -> Frame:
        """Return the current frame: the observation, and the agent's decision."""
        return Frame(
            frame_index=self.frame_index,
            time_ns=frame_time_ns(self.frame_index, self.world.fps),
            observation=self.observation,
            action=step.action,
            command=step.action if step.command is None else step.command,
            phase=step.phase,
            events=step.events,
            images=self.images,
            joint_samples=self.world.joint_samples,
            is_deliberate_miss=step.is_deliberate_miss,
        )

    def step(self, command: Action) -> None:
        """Send a command and advance by one control step."""
        self.world.apply(command)
        self._arrive(self.frame_index + 1)

    def _arrive(self, frame_index: int) -> None:
        self.frame_index = frame_index
        self._observation = self._images = None


class ActionNoise:
    """Ornstein-Uhlenbeck noise on the executed joint targets, added in free motion only.

    The label stays clean, so that a policy learns how to come back (DART, Laskey et al. 2017,
    https://arxiv.org/abs/1703.09327). The noise decays at the same rate whether more is added or not
    (`demorec.episode.features.NOISE_DECAY`): the return from it is unique, which increments of the command can express.
    Every command stays within the joint limits in position and velocity.
    """

    def __init__(self, world: World, *, sigma: float, rng: np.random.Generator) -> None:
        self._arm = world.arm
        self._sigma, self._rng = sigma, rng
        self._decay = (1.0 - NOISE_DECAY) ** (30 / world.fps)
        self._max_step = np.array(world.robot.velocity_limit) / world.fps
        self._noise: Array = np.zeros(len(self._max_step))
        self._last: Array = world.arm.target.copy()

    def command(self, step: Step) -> Action:
        """Return the command sent to the motors for a step: its clean action plus the noise."""
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


class ScriptAgent:
    """The expert, which follows the task's script; exploration noise is on the commands, never on the labels."""

    def __init__(self, episode: PreparedEpisode) -> None:
        self._episode = episode
        self._expert: Expert | None = None
        self._gave_up: ExpertFailure | None = None

    @property
    def num_retries(self) -> int:
        """See `Agent`."""
        return 0 if self._expert is None else self._expert.num_retries

    def decide(self, world: World) -> Iterator[Step]:
        """See `Agent`."""
        behaviour = self._episode.behaviour
        self._expert, self._gave_up = Expert(world, behaviour), None
        noise = ActionNoise(world, sigma=behaviour.action_noise, rng=self._episode.rng("noise"))
        for step in self._steps(self._expert):
            yield replace(step, command=noise.command(step))

    def _steps(self, expert: Expert) -> Iterator[Step]:
        """Yield the script's steps; when the expert gives up, one more step with the events that explain why.

        Stops when the hand presses harder than a real one could: a demonstration that crushes objects is invalid.
        """
        try:
            for step in self._episode.task.script(expert):
                yield step
                if name := expert.world.crushed():
                    expert.note("crush", f"pressed on {name} harder than a hand can", trouble=True)
                    raise ExpertFailure(*expert.trouble)
        except ExpertFailure as error:
            self._gave_up = error
            yield expert.step()

    def failure(self, failed: Sequence[str]) -> tuple[str, str]:
        """See `Agent`."""
        if self._gave_up is not None:
            return self._gave_up.phase, self._gave_up.reason
        if not failed or self._expert is None:
            return "", ""
        return self._expert.trouble[0] or self._expert.phase, failed[0]
