"""A gymnasium wrapper that records every episode: python examples/recorder/gym_wrapper.py runs/pendulum.

The wrapper records frame t as the observation at t and the action chosen from it, as policies learn it.
"""

from __future__ import annotations

import sys
from typing import Any

import gymnasium
import numpy as np

from demorec import Recorder
from demorec.api import RecordedEpisode


class RecordEpisodes(gymnasium.Wrapper):  # type: ignore[misc]
    """Records the vectors of an environment; its rendered images become the camera "view".

    Args:
        env: Environment; with `render_mode="rgb_array"` its images are recorded, too.
        folder: Folder of the run.
        task: Instruction in words.
        fps: Steps per second.
    """

    def __init__(self, env: gymnasium.Env[Any, Any], folder: str, *, task: str, fps: int) -> None:
        super().__init__(env)
        env.reset()
        shape = np.shape(env.render()) if env.render_mode == "rgb_array" else ()
        name = env.spec.id if env.spec is not None else type(env.unwrapped).__name__
        self._fps = fps
        self._cameras = {"view": (shape[0], shape[1])} if shape else {}
        self._recorder = Recorder(folder, robot=name, cameras=self._cameras, fps=fps, task=task, when_full="wait")
        self._episode: RecordedEpisode | None = None
        self._observation: Any = None
        self._images: dict[str, Any] = {}

    def _see(self, observation: Any) -> None:
        self._observation = np.array(observation)
        self._images = {name: np.asarray(self.env.render()) for name in self._cameras}

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        """Begin an episode; an unfinished one is recorded without an outcome."""
        if self._episode is not None:
            self._episode.finish()
        observation, info = self.env.reset(**kwargs)
        self._episode = self._recorder.episode()
        self._see(observation)
        return observation, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Record the frame that the action ends."""
        assert self._episode is not None, "reset comes before step"
        time_ns = self._episode.num_frames * 1_000_000_000 // self._fps
        self._episode.write(self._observation, np.atleast_1d(action), self._images, time_ns=time_ns)
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._see(observation)
        if terminated or truncated:
            self._episode.finish(info.get("is_success"))
            self._episode = None
        return observation, reward, terminated, truncated, info

    def close(self) -> None:
        """End the run and the environment."""
        self._recorder.close()
        self.env.close()


def main(folder: str, num_episodes: int = 3) -> None:
    """Record a pendulum under random actions."""
    env = gymnasium.make("Pendulum-v1", max_episode_steps=40)
    recording = RecordEpisodes(env, folder, task="swing up", fps=20)
    try:
        for episode in range(num_episodes):
            recording.reset(seed=episode)
            is_over = False
            while not is_over:
                _, _, terminated, truncated, _ = recording.step(recording.action_space.sample())
                is_over = terminated or truncated
    finally:
        recording.close()
    print(f"recorded in {folder}")


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "runs/gym_wrapper")
