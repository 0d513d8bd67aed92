"""The environment of every task: gymnasium's rules, and the exact numbers of the recordings."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv
from support.check import simulate
from support.docs import run_examples
from support.present import present
from support.sim import episode
from support.tasks import tasks_with_slow_ones

from demorec.core.errors import ConfigError, SceneError
from demorec.episode import features
from demorec.episode.episode import Trajectory
from demorec.episode.info import EpisodeInfo
from demorec.episode.simulated import on_request
from demorec.extensions.policies.gym_env import DemorecEnv, env_id
from demorec.loop import ScriptAgent, Session, SimulatorCache
from demorec.loop.actions import ACTION_KINDS
from demorec.mcap import Recording

ON_REQUEST = ("observation.effort", "observation.contact_force", "observation.wrench")

FRAMES = 45
VARYING = ("sort_by_color", "pick_from_clutter", "pick_shapes", "pick_anything")
"""Tasks whose scenes differ in the number of objects, so that no vector of fixed size can hold their poses."""
KEYS = {"observation.state": "agent_pos"}


def make(task: str = "pick_place", **options: Any) -> DemorecEnv:
    env = gymnasium.make(env_id(task), disable_env_checker=True, **options).unwrapped
    assert isinstance(env, DemorecEnv)
    return env


@pytest.mark.slow
def test_objects_are_drawn_from_the_named_shelves_and_their_split() -> None:
    """The environment draws the same objects as `generate` for these flags."""
    flags: dict[str, Any] = {"objects": ("blocks",), "object_split": "eval", "split": "all"}
    env = make("pick_anything", **flags)
    env.reset(seed=3)
    assert (
        env.episode.info.simulated.scene
        == episode(3, task="pick_anything", variation="mild", **flags).info.simulated.scene
    )
    env.close()


@pytest.mark.parametrize("task", ["pick_place", pytest.param("pick_anything", marks=pytest.mark.slow)])
@pytest.mark.filterwarnings("ignore:.*(action space|observation space|Box).*:UserWarning")
def test_gymnasium_accepts_the_environment(task: str) -> None:
    env = make(task)
    assert ("environment_state" in env.observation_space.spaces) == (task not in VARYING)
    check_env(env, skip_render_check=True)
    env.close()
    env.close()


@pytest.mark.parametrize("task", tasks_with_slow_ones())
def test_a_recordings_commands_give_its_observations_bit_exact(task: str, tmp_path: Path) -> None:
    """The features exported from a file equal those that a policy would observe."""
    with Recording(simulate(tmp_path / "e.mcap", episode_index=3, task=task)) as recording:
        info, trajectory = recording.info, recording.trajectory()
    sensed = tuple(feature for feature in on_request(info) if feature.name in ON_REQUEST)
    expected = features.observation_vectors(
        trajectory, info.simulated.robot, info.simulated.scene, privileged=True, sensed=sensed
    )
    # The first task runs to its end, the others until they touch an object.
    count = trajectory.num_frames if task == "pick_place" else min(trajectory.num_frames, 2 * FRAMES)

    env = make(task, split="all", sensed=ON_REQUEST)
    observation, _ = env.reset(seed=3)
    assert len(observation) == 4 + len(ON_REQUEST) - (task in VARYING)
    for t in range(count):
        for name, key in env.keys.items():
            assert key == KEYS.get(name, name.removeprefix("observation."))
            assert np.array_equal(observation[key], expected[name][t]), (name, t)
        command = np.append(trajectory.command_joint_target[t], trajectory.command_gripper[t])
        observation, _, terminated, _, told = env.step(command)
        assert np.array_equal(told["command"], command)
    assert terminated == (task == "pick_place")
    env.close()


@pytest.fixture(scope="module")
def expert(tmp_path_factory: pytest.TempPathFactory) -> tuple[EpisodeInfo, Trajectory]:
    """The expert's actions in an episode without noise, read from a file."""
    path = simulate(tmp_path_factory.mktemp("expert") / "e.mcap", episode_index=2, variation="none")
    with Recording(path) as recording:
        return recording.info, recording.trajectory()


@pytest.mark.slow
@pytest.mark.parametrize("kind", ACTION_KINDS)
def test_exported_actions_solve_the_task(expert: tuple[EpisodeInfo, Trajectory], kind: features.ActionKind) -> None:
    """float32 actions of each kind, executed in order, solve the task like the expert (without noise)."""
    info, trajectory = expert
    actions = features.action_vectors(trajectory, info.simulated.scene, kind)
    assert actions.dtype == np.float32
    env = make(split="all", variation="none", action=kind)
    env.reset(seed=2)
    assert env.info.simulated.scene == info.simulated.scene
    rewards = []
    for action in actions:
        assert env.action_space.contains(action)
        _, reward, terminated, truncated, told = env.step(action)
        assert told["is_success"] == terminated == (reward == 1.0)
        assert not truncated
        rewards.append(reward)
        if terminated:
            break
    assert sum(rewards) == rewards[-1] == 1.0
    env.close()


@pytest.mark.slow
def test_images_are_those_of_the_rollout() -> None:
    options: dict[str, Any] = {"cameras": ("front", "wrist"), "width": 64, "height": 48}
    prepared = episode(5, **options)
    env = make(split="all", **options)
    assert "environment_state" not in env.observation_space.spaces
    observation, _ = env.reset(seed=5)
    with SimulatorCache() as simulators:
        world, renderer = simulators.acquire(prepared.info)
        for frame in Session.of_episode(world, prepared, renderer).run(ScriptAgent(prepared)):
            for camera, images in frame.images.items():
                assert np.array_equal(observation["pixels"][camera], images.color)
            observation = env.step(np.append(frame.command.joint_target, frame.command.gripper_target))[0]
            if frame.frame_index == 10:
                break
    env.close()


def test_a_varying_number_of_objects_is_refused_where_a_vector_must_hold_them() -> None:
    env = make("sort_by_color", privileged=True)

    def look_at_several() -> None:
        for seed in range(8):
            env.reset(seed=seed)

    with pytest.raises(SceneError, match="different objects"):
        look_at_several()
    env.close()


def test_time_is_limited_and_invalid_actions_are_refused() -> None:
    env = make(episode_length=3)
    with pytest.raises(RuntimeError, match="reset"):
        env.step(env.action_space.sample())
    env.reset(seed=0)
    hold = np.append(env.info.simulated.scene.robot.joint_position, 0.08)
    ends = [env.step(hold)[2:4] for _ in range(3)]
    assert ends == [(False, False), (False, False), (False, True)]
    with pytest.raises(ValueError, match="finite"):
        env.step(np.full(8, np.nan))
    with pytest.raises(ValueError, match="shape"):
        env.step(np.zeros(7))
    env.close()
    with pytest.raises(ConfigError, match="Did you mean 'joint_increment'"):
        make(action="joint_increments")
    with pytest.raises(ConfigError, match=r"Did you mean 'observation\.wrench'"):
        make(sensed=("observation.wrenc",))
    with pytest.raises(ConfigError, match="render_mode"):
        DemorecEnv(render_mode="human")
    with pytest.raises(ConfigError, match="Did you mean 'stack'"):
        env_id("stck")


def test_commands_keep_to_the_limits() -> None:
    env = make()
    env.reset(seed=0)
    robot = env.info.simulated.robot
    before = np.array(env.info.simulated.scene.robot.joint_position)
    for target in (np.full(7, 100.0), np.full(7, -100.0)):
        env.step(np.append(target, 5.0))
        frame = env.situation.last_frame
        assert frame is not None
        command = frame.command
        step = np.abs(command.joint_target - before)
        assert np.all(step <= np.array(robot.velocity_limit) / 30 + 1e-12)
        assert command.gripper_target == robot.gripper.max_width
        before = command.joint_target
    env.close()


def test_render_shows_the_world() -> None:
    env = make(render_mode="rgb_array", render_width=64, render_height=48)
    env.reset(seed=0)
    image = env.render()
    assert image is not None
    assert image.shape == (48, 64, 3)
    assert image.std() > 10
    for _ in range(8):
        env.step(np.append(np.array(env.info.simulated.scene.robot.joint_position) + 0.4, 0.08))
    assert not np.array_equal(image, present(env.render()))
    env.close()


@pytest.mark.parametrize("vector", [SyncVectorEnv, pytest.param(AsyncVectorEnv, marks=pytest.mark.slow)])
def test_vectors_of_environments_give_what_single_ones_give(vector: type) -> None:
    fns = [
        functools.partial(gymnasium.make, "demorec.extensions.policies.gym_env:demorec/PickPlace-v0", split="all")
    ] * 2
    options = {} if vector is SyncVectorEnv else {"context": "spawn"}
    envs = vector(fns, **options)
    single = make(split="all")
    actions = np.stack([envs.single_action_space.sample() for _ in range(2)])
    observations, _ = envs.reset(seed=[8, 9])
    after, *_ = envs.step(actions)
    for i, seed in enumerate((8, 9)):
        expected, _ = single.reset(seed=seed)
        for key, value in expected.items():
            assert np.array_equal(observations[key][i], value)
        for key, value in single.step(actions[i])[0].items():
            assert np.array_equal(after[key][i], value)
    envs.close()
    single.close()


@pytest.mark.slow
def test_the_example_of_the_docs_runs(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_examples("docs/training.md", "gymnasium.make", {}) == 1
    assert "(224, 224, 3) False" in capsys.readouterr().out
