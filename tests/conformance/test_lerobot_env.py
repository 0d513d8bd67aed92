"""LeRobot's own commands find the environment, train for it and run in it; demorec evaluates the policies that they
save.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from support.commands import exit_code
from support.lerobot_tools import Command, run_commands
from support.sim import episode

from demorec.core.config import GenerateConfig
from demorec.core.errors import ConfigError
from demorec.datasets.lerobot.export import export_lerobot
from demorec.datasets.lerobot.options import ExportOptions
from demorec.extensions.policies.evaluation import load_evaluation
from demorec.extensions.policies.policy import find_checkpoint, trained_action
from demorec.extensions.policies.rollouts import evaluate, settings_for
from demorec.loop import ScriptAgent, Session, make_world
from demorec.mcap import EpisodeWriter, Recording

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]

PLUGIN = ["--env.type=demorec", "--env.task=pick_place", "--env.action=joint_increment"]
ACT = [
    *("--policy.type=act", "--policy.device=cpu", "--policy.push_to_hub=false", "--policy.dim_model=16"),
    *("--policy.n_heads=2", "--policy.dim_feedforward=32", "--policy.n_encoder_layers=1", "--policy.use_vae=false"),
    *("--policy.chunk_size=8", "--policy.n_action_steps=4", "--policy.pretrained_backbone_weights=null"),
]


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small policy that lerobot-train trained for two steps on an exported dataset; then lerobot-eval."""
    folder = tmp_path_factory.mktemp("trained")
    recordings = folder / "recordings"
    recordings.mkdir()
    prepared = episode(0)
    with (
        make_world(prepared.info) as world,
        EpisodeWriter(recordings / "episode_000000.mcap", prepared.info) as writer,
    ):
        session = Session.of_episode(world, prepared)
        for frame in session.run(ScriptAgent(prepared)):
            writer.write(frame)
        writer.finish(session.outcome)
    options = ExportOptions(repo_id="local/cubes", action="joint_increment", privileged=True, verify=False)
    export_lerobot((recordings,), folder / "dataset", options)
    train = ["--dataset.repo_id=local/cubes", f"--dataset.root={folder / 'dataset'}", *ACT, *PLUGIN]
    train += ["--env.episode_length=12", "--steps=2", "--save_freq=2", "--env_eval_freq=2", "--eval.n_episodes=1"]
    train += ["--eval.batch_size=1", "--batch_size=4", "--num_workers=0", "--wandb.enable=false"]
    policy = folder / "train" / "checkpoints" / "last" / "pretrained_model"
    test = [f"--policy.path={policy}", *PLUGIN, "--env.episode_length=10", "--env.render_width=64"]
    test += ["--env.render_height=48", "--eval.n_episodes=4", "--eval.batch_size=2"]
    run_commands(
        [
            Command(command="lerobot_train", args=[*train, f"--output_dir={folder / 'train'}"]),
            Command(command="lerobot_eval", args=[*test, f"--output_dir={folder / 'eval'}"]),
        ],
        folder,
    )
    assert find_checkpoint(folder / "train") == policy
    return folder


def test_lerobot_eval_runs_the_environment_and_writes_videos(trained: Path) -> None:
    result = json.loads((trained / "eval" / "eval_info.json").read_text())
    assert result["overall"]["n_episodes"] == 4
    assert result["overall"]["pc_success"] == 0.0
    videos = sorted((trained / "eval" / "videos").rglob("*.mp4"))
    assert len(videos) == 4
    assert all(video.stat().st_size > 1000 for video in videos)


def test_the_plugin_maps_features_as_the_dataset_names_them(trained: Path) -> None:
    from lerobot.envs.utils import env_to_policy_features

    from lerobot_env_demorec import DemorecEnvConfig

    info = json.loads((trained / "dataset" / "meta" / "info.json").read_text())["features"]
    found = env_to_policy_features(DemorecEnvConfig(action="joint_increment"))
    names = [name for name in info if name.startswith("observation.") or name == "action"]
    assert {name: list(found[name].shape) for name in names} == {name: info[name]["shape"] for name in names}
    cameras = DemorecEnvConfig(cameras=["front"], observation_width=64, observation_height=48)
    images = env_to_policy_features(cameras)["observation.images.front"]
    assert images.shape == (3, 48, 64)
    assert "environment_state" not in cameras.features
    kwargs = DemorecEnvConfig(task="pick_anything", objects=["blocks"], object_split="eval").gym_kwargs
    assert (kwargs["objects"], kwargs["object_split"]) == (("blocks",), "eval")


@pytest.mark.long
def test_evaluate_records_every_rollout_continues_and_refuses_another(trained: Path) -> None:
    policy = trained / "train"
    assert trained_action(find_checkpoint(policy)) == "joint_increment"
    settings = settings_for(policy, GenerateConfig(split="eval", cameras=()), episode_length=9)
    assert settings.privileged
    first = evaluate(settings, trained / "a", num_episodes=2, workers=1)
    more = evaluate(settings, trained / "a", num_episodes=3, workers=2)
    assert more.rollouts[:2] == first.rollouts
    whole = evaluate(settings, trained / "b", num_episodes=3, workers=1)
    assert [r.digest for r in whole.rollouts] == [r.digest for r in more.rollouts]
    assert len({r.digest for r in whole.rollouts}) == 3
    for rollout in whole.rollouts:
        assert rollout.phase == "reach"
        with Recording(trained / "b" / rollout.file) as recording:
            assert recording.num_frames == 9
            assert recording.info.origin == f"rollout of act {settings.policy_digest}"
            trajectory = recording.trajectory()
            assert np.array_equal(trajectory.command_joint_target, trajectory.action_joint_target)
            # The commands led from each state to the next: the arm moved towards them.
            assert np.abs(trajectory.joint_position[5, :7] - trajectory.command_joint_target[3]).max() < 0.05
            assert recording.outcome is not None
            assert not recording.outcome.success
    assert load_evaluation(trained / "b").rate.trials == 3

    other = settings_for(policy, GenerateConfig(split="eval", cameras=(), seed=5), episode_length=9)
    with pytest.raises(ConfigError, match="config seed is 0 there and 5 here"):
        evaluate(other, trained / "b", num_episodes=1, workers=1)
    assert len(list((trained / "b" / "failed").iterdir())) == 3
    replaced = evaluate(other, trained / "b", num_episodes=1, workers=1, overwrite=True)
    assert replaced.settings.config.seed == 5
    assert len(list((trained / "b" / "failed").iterdir())) == 1


@pytest.mark.long
def test_correct_finishes_a_policys_attempt(trained: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["correct", "--policy", str(trained / "train"), "--episode-length", "9", "--workers", "1", "--seed", "3"]
    words += ["--stray-metres", "0", "--stray-radians", "0"]  # it deviates from its first action on
    for count in ("1", "2"):  # the second command resumes
        assert exit_code(*words, "--num-episodes", count, "--out", trained / "corrections") == 0
    told = capsys.readouterr().out
    assert "taken over       2  the policy has had its time" in told
    assert "success       2/2 = 100.0 %" in told
    for path in sorted((trained / "corrections" / "episodes").iterdir()):
        with Recording(path) as recording:
            phases = recording.phases
        assert set(phases[:9]) == {"policy"}
        assert "policy" not in phases[9:]
    assert exit_code(*words, "--num-episodes", "2", "--stuck-seconds", "1", "--out", trained / "corrections") == 2
    assert "takeover stuck_seconds is 2.0 there and 1.0 here" in capsys.readouterr().err


def test_other_folders_are_refused_as_policies(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="Not a policy saved by LeRobot"):
        find_checkpoint(tmp_path)
    (tmp_path / "config.json").write_text('{"type": "act", "input_features": {}}')
    with pytest.raises(ConfigError, match="--action"):
        settings_for(tmp_path, GenerateConfig(cameras=()))
