"""The tasks as gymnasium environments, for policies that were trained on exported recordings.

    import demorec.extensions.policies.gym_env
    env = gymnasium.make("demorec/PickPlace-v0", cameras=("front", "wrist"), split="eval")

World, cameras, renderer and feature vectors are the same as in the recordings: stepping a recording's commands through
the environment returns the recorded observations, bit-exact. Importing this module registers every task of
`demorec list tasks`; `env_id` registers a custom one.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from demorec.core.config import EpisodePlan, GenerateConfig
from demorec.core.errors import ConfigError, SceneError
from demorec.core.registry import check_choice
from demorec.core.tables import CAMERAS, TASKS, environment_name
from demorec.episode import features
from demorec.episode.episode import POLICY_PHASE, Action, CameraImages, Frame, Observation, Observations, SuccessCheck
from demorec.episode.features import STATE_KINDS, ActionKind, StateKind
from demorec.episode.info import EpisodeInfo
from demorec.episode.simulated import on_request
from demorec.loop import PreparedEpisode, Session, SimulatorCache, Step, prepare
from demorec.loop.actions import ACTION_KINDS, ActionDecoder, action_bounds
from demorec.render.painter import Painter, WarmRenderer
from demorec.sim.world import World

SUCCESS_FRAMES = 5
"""Consecutive frames for which every check of the task must hold."""
SECONDS_PER_GOAL = 15.0
"""Time limit per object to be moved, about twice the expert's time."""
PROBED_SCENES = 16
"""Number of scenes examined to decide whether the number of objects varies."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Situation:
    """State of the simulation after a reset or a step, unrounded, for recorders and analyses.

    Attributes:
        frame_index: Control steps since the reset.
        observation: Current observation.
        images: Camera name -> current images.
        last_frame: Frame of the preceding step, with its command; None after a reset.
        checks: The task's success conditions with their current values.
        is_success: Whether all conditions have held for `SUCCESS_FRAMES` frames.
    """

    frame_index: int
    observation: Observation
    images: Mapping[str, CameraImages]
    last_frame: Frame | None
    checks: tuple[SuccessCheck, ...]
    is_success: bool


class DemorecEnv(gymnasium.Env):  # type: ignore[misc]
    """One task: the robot acts until the task's strict conditions have held for 5 frames, or time runs out.

    Observation (a dict): `agent_pos` (observation.state), `velocity`, `ee_pose`; with `privileged`,
    `environment_state`; with `sensed`, the named features without their prefix `observation.`; with cameras, `pixels`
    (camera name -> (H, W, 3) uint8). See `demorec.episode.features`.
    Action: float32 of one of the kinds of `demorec.episode.features.action_vectors`; float64 is accepted without
    rounding. Targets are clamped to the joint limits in position and velocity; an unreachable pose keeps the last
    target.
    Reward: 1 at the step that completes a success, else 0, as `next.reward` of the datasets.
    `info["is_success"]` reports whether the conditions have held for 5 frames (the datasets' `next.success` is the
    outcome of an episode). `info["episode_index"]` names the scene. After a step, `info["command"]` is the command sent
    to the motors, which the datasets store as `command` of the frame before.

    `reset(seed=N)` returns the scene of episode N of the split, independent of earlier calls; without a seed, a random
    one.

    Args:
        task: A name of `demorec list tasks`, or package.module:Name.
        privileged: Whether to return `environment_state`. None: only without cameras, and only if all scenes of the
            task have an equally long vector, since a space has a fixed length.
        sensed: Optional features that datasets contain only on request (`export --features`), such as
            "observation.wrench".
        state: Content of `agent_pos`.
        action: Meaning of an action.
        episode_length: Time limit in frames; None: 15 s per object to be moved.
        render_mode: None or "rgb_array".
        render_camera: Camera for `render`.
        render_width, render_height: Size of these images, pixels.
        config: Full configuration of scenes and images; replaces `task` and `options`.
        options: Fields of `GenerateConfig`, as in `generate-dataset`; None counts as not given. By default there are no
            cameras, and `split` is "eval": scenes and seeds that `generate-dataset --split train` leaves out.

    Raises:
        ConfigError: Unknown name or invalid value.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 30}  # noqa: RUF012  (each instance has its own)
    _viewer: Painter | None = None
    _session: Session | None = None
    _situation: Situation | None = None

    def __init__(
        self,
        task: str = "pick_place",
        *,
        privileged: bool | None = None,
        sensed: Collection[str] = (),
        state: StateKind = "joint",
        action: ActionKind = "joint",
        episode_length: int | None = None,
        render_mode: str | None = None,
        render_camera: str = "front",
        render_width: int = 320,
        render_height: int = 240,
        config: GenerateConfig | None = None,
        **options: Any,
    ) -> None:
        if config is None:
            given = {name: value for name, value in options.items() if value is not None}
            given |= {name: tuple(given.get(name, ())) for name in ("cameras", "objects")}
            config = GenerateConfig(**{"task": task, "split": "eval", **given})
        config.validate()
        self._action_kind = check_choice("action", action, ACTION_KINDS)
        self._state_kind = check_choice("state", state, STATE_KINDS)
        self.render_mode = None if render_mode is None else check_choice("render_mode", render_mode, ("rgb_array",))
        self.config, self.task = config, config.task
        self.metadata = {**type(self).metadata, "render_fps": config.fps}
        self._render_camera, self._render_size = render_camera, (render_width, render_height)
        self.episode = prepare(EpisodePlan(config=config, episode_index=0))
        info = self.episode.info
        known = {feature.name: feature for feature in on_request(info)}
        self._sensed = tuple(known[check_choice("sensed", name, tuple(known))] for name in sensed)
        num_goals = max(1, len(info.simulated.scene.goals))
        self._max_episode_steps = episode_length or round(SECONDS_PER_GOAL * config.fps * num_goals)
        self.privileged = self._is_privileged() if privileged is None else privileged
        self._vector_lengths = self._lengths(info)
        self.observation_space = _observation_space(info, self._vector_lengths)
        self.action_space = spaces.Box(*action_bounds(info.simulated.robot, action, fps=config.fps))
        self._simulators, self._viewers = SimulatorCache(), WarmRenderer()

    @property
    def keys(self) -> dict[str, str]:
        """Dataset feature -> key of the observation, images aside."""
        return {name: _key(name) for name in self._vector_lengths}

    @property
    def info(self) -> EpisodeInfo:
        """Description of the current episode."""
        return self.episode.info

    @property
    def world(self) -> World:
        """The simulated world, after a reset."""
        return _after_reset(self._session).world

    @property
    def situation(self) -> Situation:
        """State of the simulation after a reset or a step."""
        return _after_reset(self._situation)

    @property
    def max_episode_steps(self) -> int:
        """Time limit, frames."""
        return self._max_episode_steps

    @property
    def task_description(self) -> str:
        """Instruction of the current episode, LeRobot's task text."""
        return self.info.instruction

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Begin an episode; the class describes `seed`, and there are no options.

        Raises:
            SceneError: No layout was found, or its features do not match the observation space.
        """
        super().reset(seed=seed)
        index = int(self.np_random.integers(2**31)) if seed is None else seed
        self.episode = self._prepare(index)
        info = self.info
        if self._lengths(info) != self._vector_lengths:
            raise SceneError(
                f"Episode {index} of {self.config.task!r} has different objects from episode 0, but an environment has "
                "one observation space: leave privileged out and use cameras."
            )
        world, renderer = self._simulators.acquire(info)
        session = Session.of_episode(world, self.episode, renderer, only_color=True)
        session.reset()
        self._session = session
        self._viewer, self._held = None, 0
        self._decoder = ActionDecoder(world, self._action_kind)
        self._situation = self._look(session, None)
        return self._observation(self._situation), {"is_success": False, "episode_index": index}

    def step(self, action: NDArray[np.floating]) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Advance by one control step; ValueError if the action has a wrong shape or a value that is not finite."""
        return self.act(Step(action=self.command_for(action), phase=POLICY_PHASE))

    def command_for(self, action: NDArray[np.floating]) -> Action:
        """Compute the command that `step` would send now. Deltas are relative to it unless `act` sends another
        command.
        """
        _after_reset(self._session)
        values = np.asarray(action, dtype=np.float64)
        if values.shape != self.action_space.shape or not np.isfinite(values).all():
            raise ValueError(f"An action has shape {self.action_space.shape} and finite values, found {values!r}.")
        return self._decoder.command(values)

    def act(self, step: Step) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Advance by one control step as `step` does, but send the given step's command unchanged."""
        session = _after_reset(self._session)
        frame = session.frame(step)
        self._decoder.follow(frame.command)
        session.step(frame.command)
        self._situation = self._look(session, frame)
        success = self._situation.is_success
        truncated = not success and session.frame_index >= self._max_episode_steps
        information = {
            "is_success": success,
            "episode_index": self.episode.plan.episode_index,
            "command": np.append(frame.command.joint_target, frame.command.gripper_target),
        }
        return self._observation(self._situation), float(success), success, truncated, information

    def render(self) -> NDArray[np.uint8] | None:
        """(H, W, 3) uint8 image of the present state from `render_camera`; None without a render mode."""
        if self.render_mode is None:
            return None
        _after_reset(self._situation)
        if self._viewer is None:
            name, (width, height) = self._render_camera, self._render_size
            camera = CAMERAS.load(name).camera(name, self.info.simulated.robot, width=width, height=height)
            self._viewer = Painter(self._viewers.of(self.config.renderer), (camera,), antialias=self.config.antialias)
            self._viewer.setup(self.world)
        return self._viewer.images()[self._render_camera].color

    def close(self) -> None:
        """Free the simulator and the renderers; idempotent."""
        try:
            self._simulators.close()
        finally:
            self._viewers.close()
        self._viewer = self._session = self._situation = None

    def _prepare(self, index: int) -> PreparedEpisode:
        """Prepare the first attempt at this episode that has a layout, as in generation."""
        last = self.config.max_attempts - 1
        for attempt in range(last):
            with suppress(SceneError):
                return prepare(EpisodePlan(config=self.config, episode_index=index, attempt=attempt))
        return prepare(EpisodePlan(config=self.config, episode_index=index, attempt=last))

    def _is_privileged(self) -> bool:
        """Default of `privileged`: True without cameras and with equally many objects in each of the first scenes."""
        if self.config.cameras:
            return False
        lengths = set()
        for index in range(PROBED_SCENES):
            simulated = self._prepare(index).info.simulated
            names = features.observation_names(simulated.robot, simulated.scene, privileged=True)
            lengths.add(len(names[features.ENVIRONMENT_STATE]))  # a round object has no yaw: its vector is shorter
        return len(lengths) == 1

    def _lengths(self, info: EpisodeInfo) -> dict[str, int]:
        """Map each dataset feature to its number of elements."""
        names = features.observation_names(
            info.simulated.robot,
            info.simulated.scene,
            privileged=self.privileged,
            state=self._state_kind,
            sensed=self._sensed,
        )
        return {name: len(components) for name, components in names.items()}

    def _look(self, session: Session, last_frame: Frame | None) -> Situation:
        checks = session.checks()
        self._held = self._held + 1 if all(check.passed for check in checks) else 0
        return Situation(
            frame_index=session.frame_index,
            observation=session.observation,
            images=session.images,
            last_frame=last_frame,
            checks=checks,
            is_success=self._held >= SUCCESS_FRAMES,
        )

    def _observation(self, situation: Situation) -> dict[str, Any]:
        simulated = self.info.simulated
        vectors = features.observation_vectors(
            Observations.of(situation.observation),
            simulated.robot,
            simulated.scene,
            privileged=self.privileged,
            state=self._state_kind,
            sensed=self._sensed,
        )
        observation: dict[str, Any] = {_key(name): rows[0] for name, rows in vectors.items()}
        if situation.images:
            observation["pixels"] = {name: images.color for name, images in situation.images.items()}
        return observation


def _key(feature: str) -> str:
    """Key of a dataset feature in the observation; LeRobot's `preprocess_observation` maps it back."""
    return "agent_pos" if feature == features.STATE else feature.removeprefix("observation.")


def _observation_space(info: EpisodeInfo, vector_lengths: Mapping[str, int]) -> spaces.Dict:
    found: dict[str, spaces.Space[Any]] = {
        _key(name): spaces.Box(-np.inf, np.inf, shape=(length,), dtype=np.float32)
        for name, length in vector_lengths.items()
    }
    if info.simulated.scene.cameras:
        sizes = {camera.name: (camera.height, camera.width, 3) for camera in info.simulated.scene.cameras}
        images = {name: spaces.Box(0, 255, shape=size, dtype=np.uint8) for name, size in sizes.items()}
        found["pixels"] = spaces.Dict(images)
    return spaces.Dict(found)


def _after_reset[T](value: T | None) -> T:
    if value is None:
        raise RuntimeError("the environment has no episode yet: call reset first")
    return value


def env_id(task: str) -> str:
    """Return Gymnasium's name of a task's environment ("demorec/PickPlace-v0"), registering it first if necessary.

    Raises:
        ConfigError: Unknown task.
    """
    TASKS.check_name(task)
    full = environment_name(task)
    if full not in gymnasium.registry:
        gymnasium.register(full, entry_point="demorec.extensions.policies.gym_env:DemorecEnv", kwargs={"task": task})
    elif gymnasium.registry[full].kwargs["task"] != task:
        raise ConfigError(
            f"Two tasks have the name {full!r}: {gymnasium.registry[full].kwargs['task']} and {task}; rename one class."
        )
    return full


for _task in TASKS.names():
    env_id(_task)
