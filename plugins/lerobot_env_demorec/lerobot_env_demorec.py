"""demorec's environments for LeRobot's own commands, which import every installed package named lerobot_env_*.

    lerobot-eval --env.type=demorec --env.task=pick_place --policy.path=... --eval.n_episodes=100

`lerobot-train` takes the same flags.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, field
from typing import Any

import gymnasium
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.envs.utils import freeze_after_episode_end
from lerobot.utils.constants import ACTION, OBS_IMAGES

from demorec.api import ENVIRONMENT_STATE, DemorecEnv, env_id

__all__ = ["DemorecEnvConfig"]


_AS_THEY_ARE = (
    "robot", "split", "object_split", "variation", "fps", "renderer", "privileged", "state", "action", "episode_length",
    "render_mode", "render_camera", "render_width", "render_height",
)  # fmt: skip
"""Flags that are passed to the environment as arguments of the same name."""


@EnvConfig.register_subclass("demorec")
@dataclass
class DemorecEnvConfig(EnvConfig):  # type: ignore[misc]
    """Flags `--env.NAME=...`; a seed has the same scenes as in `demorec evaluate`."""

    task: str | None = "pick_place"
    robot: str = "panda"
    split: str = "eval"
    scene_seed: int = 0
    variation: str = "mild"
    objects: list[str] = field(default_factory=list)
    object_split: str = "all"
    cameras: list[str] = field(default_factory=list)
    observation_width: int = 224
    observation_height: int = 224
    renderer: str | None = None
    privileged: bool | None = None
    sensed: list[str] = field(default_factory=list)
    state: str = "joint"
    action: str = "joint"
    episode_length: int | None = None
    render_mode: str = "rgb_array"
    render_camera: str = "front"
    render_width: int = 320
    render_height: int = 240

    def __post_init__(self) -> None:
        env = DemorecEnv(self.task or "pick_place", **self.gym_kwargs)
        for key, space in env.observation_space.spaces.items():
            if key == "pixels":
                for camera, pixels in space.spaces.items():
                    self._add(f"pixels/{camera}", f"{OBS_IMAGES}.{camera}", FeatureType.VISUAL, pixels.shape)
        for name, key in env.keys.items():
            kind = FeatureType.ENV if name == ENVIRONMENT_STATE else FeatureType.STATE
            self._add(key, name, kind, env.observation_space[key].shape)
        self._add(ACTION, ACTION, FeatureType.ACTION, env.action_space.shape)

    def _add(self, key: str, name: str, kind: FeatureType, shape: tuple[int, ...]) -> None:
        self.features[key] = PolicyFeature(type=kind, shape=shape)
        self.features_map[key] = name

    @property
    def gym_id(self) -> str:
        """Gymnasium's name of the task's environment."""
        return env_id(self.task or "pick_place")

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Arguments of `demorec.extensions.policies.gym_env.DemorecEnv` except the task."""
        return {name: getattr(self, name) for name in _AS_THEY_ARE} | {
            "seed": self.scene_seed,
            "cameras": tuple(self.cameras),
            "objects": tuple(self.objects),
            "sensed": tuple(self.sensed),
            "width": self.observation_width,
            "height": self.observation_height,
        }

    def create_envs(
        self, n_envs: int, use_async_envs: bool = False
    ) -> dict[str, dict[int, gymnasium.vector.VectorEnv]]:
        """Create LeRobot's nested vector of environments, which idle at no cost after their episode.

        LeRobot steps a whole batch until its last episode ends; by default it would simulate further episodes meanwhile
        and discard them.
        """
        make = freeze_after_episode_end(
            functools.partial(
                _make_one, self.task or "pick_place", disable_env_checker=self.disable_env_checker, **self.gym_kwargs
            )
        )
        mode = gymnasium.vector.AutoresetMode.NEXT_STEP
        vector: gymnasium.vector.VectorEnv
        if use_async_envs and n_envs > 1:
            vector = gymnasium.vector.AsyncVectorEnv([make] * n_envs, autoreset_mode=mode, context="forkserver")
        else:
            vector = gymnasium.vector.SyncVectorEnv([make] * n_envs, autoreset_mode=mode)
        return {self.type: {0: vector}}


def _make_one(task: str, **kwargs: Any) -> gymnasium.Env:
    """Make one environment; in a separate process, this import registers the task."""
    return gymnasium.make(env_id(task), **kwargs)
