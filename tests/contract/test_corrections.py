"""The expert takes over from a policy, which is a function of its observations in these tests."""

from __future__ import annotations

import functools
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.export import data_table, export, info

from demorec.check.report import CheckOptions, Subject, check_subject
from demorec.core.config import EpisodePlan, GenerateConfig
from demorec.core.errors import ConfigError
from demorec.core.geometry import Array
from demorec.core.plain import to_plain
from demorec.core.tables import EXPORTERS
from demorec.episode.episode import POLICY_PHASE, Frame
from demorec.episode.features import ActionKind
from demorec.extensions.policies import rollouts
from demorec.extensions.policies.evaluation import Evaluation, Settings
from demorec.extensions.policies.gym_env import DemorecEnv
from demorec.extensions.policies.rollouts import make_rollout
from demorec.extensions.policies.takeover import TakeOver
from demorec.extensions.policies.turns import Turns, read_takeover
from demorec.extensions.remake.drive import replay_all
from demorec.generate.options import RunOptions
from demorec.generate.run import generate
from demorec.loop import ScriptAgent, Session, make_world, prepare
from demorec.mcap import Recording
from demorec.runs.find import EVALUATION_NAME
from demorec.runs.run_file import Attempt

pytestmark = pytest.mark.slow

FPS = 30


class Lazy:
    """Lower the closed hand for half a second, then stay there."""

    def __init__(self, *_: Any, **__: Any) -> None:
        self.calls = 0

    def reset(self, seed: int) -> None:
        self.calls = 0

    def act(self, observation: dict[str, Any], instruction: str) -> Any:
        self.calls += 1
        target = np.array(observation["agent_pos"], dtype=np.float64)
        target[3] -= 0.03 if self.calls < FPS // 2 else 0.0
        target[-1] = 0.0
        return target


@pytest.fixture(scope="module")
def rollout(tmp_path_factory: pytest.TempPathFactory) -> tuple[Attempt, Path]:
    """One rollout of the lazy policy, which is stuck after half a second, and its recording."""
    rules = TakeOver(stuck_seconds=1.0, stray_metres=0.0, stray_radians=0.0, noise=False)
    return roll_out(tmp_path_factory.mktemp("corrections"), Lazy(), rules, action="joint")


def roll_out(folder: Path, policy: Any, rules: TakeOver, *, action: ActionKind) -> tuple[Attempt, Path]:
    """Roll out scene 3 as a worker of `demorec correct` does; return the result and its recording."""
    settings = Settings(
        policy="p",
        policy_type="lazy",
        policy_digest="0",
        config=GenerateConfig(cameras=(), split="train"),
        action=action,
        takeover=rules,
    )
    (folder / EVALUATION_NAME).write_text(json.dumps(to_plain(Evaluation(settings=settings))))
    for place in ("episodes", "failed"):
        (folder / place).mkdir()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rollouts, "Policy", lambda *args, **kwargs: policy)
        patch.setattr(rollouts, "find_checkpoint", lambda path: path)
        patch.setattr(rollouts, "_stage", functools.lru_cache(rollouts._stage.__wrapped__))
        attempt = make_rollout(EpisodePlan(config=settings.config, episode_index=3), folder)
    return attempt, folder / attempt.file


def test_a_stuck_policy_is_corrected_and_the_episode_replays(rollout: tuple[Attempt, Path]) -> None:
    attempt, path = rollout
    assert attempt.success
    with Recording(path) as recording:
        phases = recording.phases
        (report,) = replay_all([recording])
        assert recording.info.origin == "correction of lazy 0"
        assert recording.info.simulated.behaviour["action_noise"] == 0.0
        assert recording.outcome is not None
        assert recording.outcome.success
        (event,) = [event for _, event in recording.events() if event.name == "take_over"]
    handover = phases.index("halt")
    assert FPS < handover < 3 * FPS
    assert set(phases[:handover]) == {POLICY_PHASE}
    assert POLICY_PHASE not in phases[handover:]
    assert event.message == "the expert takes over: the policy is stuck"
    assert read_takeover(path) == "the policy is stuck"
    assert report.is_identical, report


def test_every_check_passes_on_a_correction(rollout: tuple[Attempt, Path]) -> None:
    report = check_subject(Subject(path=rollout[1], kind="recording"), CheckOptions())
    assert [result.check for result in report.results if result.verdict == "broken"] == []


def test_the_dataset_marks_the_experts_frames(rollout: tuple[Attempt, Path], tmp_path: Path) -> None:
    """As LeRobot's own DAgger does: a boolean column, true where the expert acted."""
    export(rollout[1], tmp_path / "plain")
    assert "intervention" not in info(tmp_path / "plain")["features"]
    export(rollout[1], tmp_path / "dataset", intervention=True)
    assert info(tmp_path / "dataset")["features"]["intervention"] == {"dtype": "bool", "shape": [1], "names": None}
    with Recording(rollout[1]) as recording:
        acted = [frame.phase not in ("policy", "halt") for frame in recording]
    column = data_table(tmp_path / "dataset").column("intervention").to_pylist()
    assert column == acted
    assert set(column) == {False, True}


@pytest.mark.parametrize("exporter", EXPORTERS.names())
def test_episodes_without_corrections_can_be_left_out(
    rollout: tuple[Attempt, Path], expert_poses: Array, tmp_path: Path, exporter: str
) -> None:
    alone, uncorrected = roll_out(
        tmp_path, Wanderer(expert_poses, astray_from=10_000, drift=0.0), TakeOver(stray_metres=0.0), action="ee"
    )
    assert alone.success
    options = RunOptions(out=tmp_path / "run", num_episodes=1, workers=1, export=False)
    generate(GenerateConfig(cameras=(), split="train"), options)
    (demonstration,) = (tmp_path / "run" / "episodes").glob("*.mcap")
    sources = [demonstration, uncorrected, rollout[1]]
    everything = export(sources, tmp_path / "all.hdf5", exporter)
    assert (everything.num_episodes, everything.skipped_unwanted) == (3, 0)
    report = export(sources, tmp_path / "corrected.hdf5", exporter, corrected_only=True)
    assert (report.num_episodes, report.skipped_unwanted) == (2, 1)
    with Recording(demonstration) as plain, Recording(rollout[1]) as corrected:
        assert report.num_frames == plain.num_frames + corrected.num_frames
    with pytest.raises(ConfigError, match="or were not corrected"):
        export(uncorrected, tmp_path / "none.hdf5", exporter, corrected_only=True)


class Wanderer:
    """Act like the expert in a scene, but move sideways for half a second from a given frame on."""

    def __init__(self, actions: Array, *, astray_from: int, drift: float) -> None:
        self._actions, self._from, self._drift = actions, astray_from, drift
        self._frame = -1

    def reset(self, seed: int) -> None:
        """Return to the first frame, the only state."""

    def act(self, observation: dict[str, Any], instruction: str) -> Array:
        self._frame += 1
        action: Array = self._actions[min(self._frame, len(self._actions) - 1)].copy()
        if self._from <= self._frame < self._from + FPS // 2:
            action[1] += self._drift * (self._frame - self._from)  # metres
        return action


@pytest.fixture(scope="module")
def expert_poses() -> Array:
    """(T, 8) noise-free commands of the expert in scene 3, in the form of --action ee."""
    config = GenerateConfig(cameras=(), split="train")
    episode = prepare(EpisodePlan(config=config, episode_index=3))
    episode = replace(episode, behaviour=replace(episode.behaviour, action_noise=0.0))
    with make_world(episode.info) as world:
        frames = list(Session.of_episode(world, episode).run(ScriptAgent(episode)))
    return np.array([[*f.action.base_from_tcp_target.vector(), f.action.gripper_target] for f in frames])


def act_in_turns(policy: Any, rules: TakeOver) -> tuple[Turns, list[Frame]]:
    env = DemorecEnv(config=GenerateConfig(cameras=(), split="train"), action="ee")
    observation, _ = env.reset(seed=3)
    with make_world(env.info) as world:
        turns = Turns(env, policy, observation, seed=3, rules=rules, rehearsal_world=world)
        frames = list(turns.frames())
    env.close()
    return turns, frames


def test_a_policy_that_acts_like_the_expert_is_left_alone(expert_poses: Array) -> None:
    turns, frames = act_in_turns(Wanderer(expert_poses, astray_from=10_000, drift=0.0), TakeOver(stray_metres=0.02))
    assert turns.success
    assert {frame.phase for frame in frames} == {POLICY_PHASE}


def test_a_deviating_policy_is_corrected_and_the_episode_replays(expert_poses: Array, tmp_path: Path) -> None:
    """It leaves the expert's path at frame 20 by 1 cm a frame: beyond 5 cm from frame 26, for 6 frames at frame 31.

    With noise on the expert's commands: labels and commands differ in the expert's frames only.
    """
    attempt, path = roll_out(tmp_path, Wanderer(expert_poses, astray_from=20, drift=0.01), TakeOver(), action="ee")
    assert attempt.success
    with Recording(path) as recording:
        trajectory = recording.trajectory()
        assert recording.info.simulated.behaviour["action_noise"] > 0.0
        (report,) = replay_all([recording])
    handover = trajectory.phase.index("halt")
    assert handover in range(29, 34)
    assert set(trajectory.phase[:handover]) == {POLICY_PHASE}
    assert POLICY_PHASE not in trajectory.phase[handover:]
    assert read_takeover(path) == "the policy strays"
    differs = (trajectory.action_joint_target != trajectory.command_joint_target).any(axis=1)
    assert not differs[:handover].any()
    assert differs[handover:].any()
    assert report.is_identical, report
