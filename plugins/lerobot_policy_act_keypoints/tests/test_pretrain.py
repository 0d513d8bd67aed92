"""act-keypoints-pretrain, and training of the policy by lerobot-train-fast and by LeRobot's own command."""

from __future__ import annotations

import fcntl
import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lerobot_datasets import SMALL_ACT, write_demonstrations

from lerobot_policy_act_keypoints.commands import act_keypoints_pretrain

pytestmark = pytest.mark.slow

POLICY: dict[str, Any] = {**SMALL_ACT, "type": "act_keypoints"}


@pytest.fixture(scope="module")
def settings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Settings of a training on three demonstrations with a small camera."""
    folder = tmp_path_factory.mktemp("pretrain")
    dataset = write_demonstrations(folder / "dataset", 3)
    plain = {
        "dataset": {"repo_id": "local/test", "root": str(dataset), "video_backend": "pyav"},
        "policy": POLICY,
        "batch_size": 4,
        "steps": 6,
        "save_freq": 3,
        "num_workers": 0,
        "log_freq": 1,
    }
    path = folder / "settings.json"
    path.write_text(json.dumps(plain))
    return path


def ends(*words: str) -> int:
    with pytest.raises(SystemExit) as ended:
        act_keypoints_pretrain(words)
    assert isinstance(ended.value.code, int)
    return ended.value.code


def pretrain(settings: Path, out: Path, *more: str) -> int:
    words = [f"--config_path={settings}", "--out", str(out), "--num-updates", "6", "--frames-per-update", "4"]
    return ends(*words, *more)


def weights(folder: Path) -> dict[str, np.ndarray[Any, Any]]:
    from safetensors.numpy import load_file

    return load_file(folder / "model.safetensors")


@pytest.fixture(scope="module")
def pretrained(settings: Path) -> Path:
    out = settings.parent / "pretrained"
    assert pretrain(settings, out) == 0
    return out


def test_the_reported_error_is_that_of_the_held_out_episode(
    settings: Path, pretrained: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Compute the baseline from the table itself; a second call only reports again."""
    import pyarrow.parquet as pq

    table = pq.read_table(next((settings.parent / "dataset" / "data").rglob("*.parquet")))
    episode, pose = table["episode_index"].to_numpy(), np.stack(table["observation.ee_pose"].to_numpy())[:, :3]
    is_open = np.stack(table["action"].to_numpy())[:, -1] > 0.04
    changes = [k for k in range(1, len(pose)) if episode[k] == episode[k - 1] and is_open[k] != is_open[k - 1]]
    offsets: dict[bool, list[np.ndarray[Any, Any]]] = {False: [], True: []}  # to the next closing, to the next opening
    first = []
    for i, number in enumerate(episode):
        ahead = [k for k in changes if k > i and episode[k] == number]
        if number == 2:
            first += [(bool(is_open[k]), pose[k] - pose[i]) for k in ahead[:1]]
        else:
            for opens, offset in offsets.items():
                offset += [pose[k] - pose[i] for k in ahead if is_open[k] == opens][:1]
    baseline = np.median([np.linalg.norm(offset - np.mean(offsets[opens], axis=0)) for opens, offset in first])
    found = json.loads((pretrained / "pretraining.json").read_text())["result"]
    assert found["baseline_m"] == pytest.approx(baseline, abs=2e-5)
    assert found["episodes"] == 1
    assert 0 < found["median_m"] <= found["most_m"] < 2
    before = {path: path.stat().st_mtime_ns for path in pretrained.glob("[!.]*")}
    assert pretrain(settings, pretrained) == 0
    assert f"next keyframe {1000 * found['median_m']:.1f} mm off" in capsys.readouterr().out
    assert {path: path.stat().st_mtime_ns for path in pretrained.glob("[!.]*")} == before
    assert "unfinished.pt" not in {path.name for path in before}


def test_lerobot_loads_the_policy_by_its_name_and_it_acts(pretrained: Path) -> None:
    """Check that the encoder's predictions reach ACT: other images, other actions."""
    import torch
    from lerobot.configs import PreTrainedConfig
    from lerobot.policies.factory import get_policy_class

    import lerobot_policy_act_keypoints  # noqa: F401  # as LeRobot's commands do

    config = PreTrainedConfig.from_pretrained(pretrained)
    policy = get_policy_class(config.type).from_pretrained(pretrained)
    generator = torch.Generator().manual_seed(0)
    batch: dict[str, Any] = {
        key: torch.randn(3, *feature.shape, generator=generator) for key, feature in config.input_features.items()
    }
    batch["task"] = ["bring red to green"] * 3
    actions = policy.predict_action_chunk(batch)
    assert actions.shape == (3, config.chunk_size, 7)
    changed = batch | {"observation.images.top": 5 * batch["observation.images.top"].flip(-1)}
    assert not torch.allclose(actions, policy.predict_action_chunk(changed), atol=1e-4)
    changed = batch | {"task": ["put the red square onto the green one"] * 3}
    assert {"put", "bring", "red", "green"} <= set(config.vocabulary)
    assert not torch.equal(actions, policy.predict_action_chunk(changed))


def test_a_policy_that_reads_can_be_saved_from_a_gpu(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On a GPU, weights of a torch.nn.GRU become parts of one buffer, which safetensors refuses to save."""
    import torch
    from lerobot.configs import FeatureType, PolicyFeature
    from safetensors.torch import save_model

    from lerobot_policy_act_keypoints import ActKeypointsConfig
    from lerobot_policy_act_keypoints.modeling_act_keypoints import ActKeypointsPolicy

    def as_on_a_gpu(module: torch.nn.RNNBase) -> None:
        weights = [weight for weight in module._flat_weights if weight is not None]
        parts = torch.cat([weight.detach().reshape(-1) for weight in weights]).split([w.numel() for w in weights])
        for weight, part in zip(weights, parts, strict=True):
            weight.data = part.view_as(weight)

    monkeypatch.setattr(torch.nn.RNNBase, "flatten_parameters", as_on_a_gpu)
    images = PolicyFeature(type=FeatureType.VISUAL, shape=(3, 24, 32))
    state = PolicyFeature(type=FeatureType.STATE, shape=(8,))
    config = ActKeypointsConfig(
        input_features={"observation.images.front": images, "observation.state": state},
        output_features={"action": PolicyFeature(type=FeatureType.ACTION, shape=(8,))},
        vocabulary=("blue", "red"),
        device="cpu",
    )
    with pytest.raises(RuntimeError, match="save"):
        save_model(torch.nn.ModuleList([torch.nn.GRU(4, 4)]), str(tmp_path / "plain.safetensors"))
    ActKeypointsPolicy(config).to("cpu").save_pretrained(tmp_path / "policy")
    assert (tmp_path / "policy/model.safetensors").exists()


@pytest.mark.long
def test_changed_images_are_the_same_after_a_stop(
    settings: Path, pretrained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from lerobot_policy_act_keypoints import pretrain as pretraining
    from lerobot_policy_act_keypoints.training import training_config

    def stop(text: str) -> None:
        if text.startswith("update 2 "):
            raise KeyboardInterrupt

    changing = "--dataset.image_transforms.enable=true"
    assert pretrain(settings, tmp_path / "whole", changing) == 0
    plan = pretraining.PretrainConfig(updates=6, batch_size=4, seed=1000)
    config = training_config([f"--config_path={settings}", changing])
    with pytest.raises(KeyboardInterrupt):
        pretraining.pretrain(
            config, plan, tmp_path / "stopped", frame_cache_bytes=1 << 28, on_progress=stop, save_every=2
        )
    assert pretrain(settings, tmp_path / "stopped") == 2
    assert "another image_transforms" in capsys.readouterr().err
    assert pretrain(settings, tmp_path / "stopped", changing) == 0
    whole, stopped, plain = (weights(folder) for folder in (tmp_path / "whole", tmp_path / "stopped", pretrained))
    for name in whole:
        np.testing.assert_array_equal(whole[name], stopped[name], err_msg=name)
    assert any((whole[name] != plain[name]).any() for name in whole)


def test_another_pretraining_in_the_folder_is_refused(
    settings: Path, pretrained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert pretrain(settings, pretrained, "--learning-rate", "0.01") == 2
    assert "Another encoder is pretrained in this folder (another learning_rate), choose another --out" in (
        capsys.readouterr().err
    )
    (tmp_path / "mine.txt").write_text("keep")
    assert pretrain(settings, tmp_path) == 2
    assert "holds something else (mine.txt)" in capsys.readouterr().err
    assert {path.name for path in tmp_path.iterdir()} == {"mine.txt", ".lock"}


def test_damage_is_reported(
    settings: Path, tmp_path: Path, pretrained: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plain = json.loads((pretrained / "pretraining.json").read_text())
    out = tmp_path / "out"
    out.mkdir()
    (out / "pretraining.json").write_text(json.dumps({"settings": plain["settings"]}))
    (out / "unfinished.pt").write_bytes(b"PK\x03\x04 nothing of torch")
    assert pretrain(settings, out) == 1
    assert "is damaged, delete it to start again" in capsys.readouterr().err
    (out / "pretraining.json").write_text('{"settings": 3}')
    assert pretrain(settings, out) == 1
    assert "pretraining.json is damaged" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--policy.type=diffusion"], "Only the encoder of one type of policy can be pretrained"),
        (["--num-updates=0"], "argument --num-updates: 0 is not within 1 to"),
        (["--config_path=nothing.json"], "The settings file does not exist: nothing.json"),
        (["--steps=60"], "--steps=60 is a flag of lerobot-train-fast: give --num-updates for the encoder."),
    ],
)
def test_wrong_requests(
    settings: Path, tmp_path: Path, words: list[str], sentence: str, capsys: pytest.CaptureFixture[str]
) -> None:
    given = [f"--config_path={settings}"] if not any("config_path" in word for word in words) else []
    if "--policy.type=diffusion" in words:
        plain = json.loads(settings.read_text())
        plain["policy"] = {"type": "diffusion", "device": "cpu", "push_to_hub": False}
        given, words = [f"--config_path={tmp_path / 'other.json'}"], []
        (tmp_path / "other.json").write_text(json.dumps(plain))
    assert ends(*given, "--out", str(tmp_path / "out"), *words) == 2
    assert sentence in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_one_episode_is_too_few(settings: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert pretrain(settings, tmp_path / "out", "--dataset.episodes=[0]") == 2
    assert "commanded to close or to open in 1 of the dataset's episodes: at least 2" in capsys.readouterr().err


def test_a_dataset_without_tcp_poses_is_refused(
    settings: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    dataset = write_demonstrations(tmp_path / "unnamed", 2, names_tcp=False)
    assert pretrain(settings, tmp_path / "out", f"--dataset.root={dataset}") == 2
    assert "lacks tcp.x to tcp.qw in observation.ee_pose or observation.state, so where the hand will grasp is" in (
        capsys.readouterr().err
    )


def test_a_folder_in_the_dataset_or_in_use_is_refused(
    settings: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    dataset = settings.parent / "dataset"
    assert pretrain(settings, dataset / "eye") == 2
    assert "is inside the dataset" in capsys.readouterr().err
    assert not (dataset / "eye").exists()
    with (tmp_path / ".lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        assert pretrain(settings, tmp_path) == 2
    assert "Another process is training in this folder" in capsys.readouterr().err
    assert pretrain(settings, Path("/proc/eye")) == 2
    assert "cannot be written to" in capsys.readouterr().err


@pytest.mark.long
def test_it_learns_to_see_where_a_hand_will_grasp(settings: Path, tmp_path: Path) -> None:
    """Check an error of one centimetre, which is a pixel; the mean of all has an error of a decimetre."""
    dataset = write_demonstrations(tmp_path / "dataset", 120)
    words = [f"--config_path={settings}", f"--dataset.root={dataset}", "--policy.num_keypoints=8"]
    words += ["--policy.encoder_channels=8", "--num-updates", "600", "--frames-per-update", "32"]
    assert ends(*words, "--learning-rate", "0.005", "--out", str(tmp_path / "eye")) == 0
    found = json.loads((tmp_path / "eye" / "pretraining.json").read_text())["result"]
    assert found["baseline_m"] > 0.1
    assert found["median_m"] < 0.01
    assert found["most_m"] < 0.02


def train(program: str, settings: Path, out: Path, *more: str) -> tuple[list[float], Path]:
    """Train in a separate process; returns the losses and the last checkpoint."""
    command = [str(Path(sys.executable).parent / program), f"--config_path={settings}", f"--output_dir={out}"]
    done = subprocess.run([*command, *more], capture_output=True, text=True, check=False)
    text = done.stdout + done.stderr
    assert done.returncode == 0, text[-3000:]
    return [float(loss) for loss in re.findall(r"step:\S+ .*?loss:(\S+)", text)], (
        out / "checkpoints" / "last" / "pretrained_model"
    )


@pytest.mark.long
def test_the_encoder_stays_as_it_was_pretrained(settings: Path, pretrained: Path, tmp_path: Path) -> None:
    """Check that each frame is encoded once, with the losses of LeRobot's own command, which encodes repeatedly."""
    path = f"--policy.path={pretrained}"
    kept, one = train("lerobot-train-fast", settings, tmp_path / "kept", path)
    afresh, _ = train("lerobot-train", settings, tmp_path / "afresh", path)
    assert len(kept) >= 6
    assert kept == pytest.approx(afresh, abs=2e-3)
    before, after = weights(pretrained), weights(one)
    assert before.keys() == after.keys()
    encoder = [name for name in before if name.startswith("encoder.")]
    assert len(encoder) > 50
    for name in encoder:
        np.testing.assert_array_equal(before[name], after[name], err_msg=name)
    assert not np.array_equal(before["model.action_head.weight"], after["model.action_head.weight"])
    np.testing.assert_array_equal(encoded(settings, pretrained), encoded(settings, one))


def encoded(settings: Path, folder: Path) -> np.ndarray[Any, Any]:
    """Encode a frame of the dataset as prepared by LeRobot's processing steps."""
    from lerobot.configs import PreTrainedConfig
    from lerobot.datasets.lerobot_dataset import LeRobotDataset
    from lerobot.policies.factory import get_policy_class, make_pre_post_processors
    from torch.utils.data import default_collate

    config = PreTrainedConfig.from_pretrained(folder)
    before, _ = make_pre_post_processors(config, pretrained_path=str(folder))
    dataset = LeRobotDataset("local/test", root=settings.parent / "dataset", video_backend="pyav")
    policy = get_policy_class(config.type).from_pretrained(folder).eval()
    return np.asarray(policy.encode(before(default_collate([dataset[7]]))).numpy())


@pytest.mark.long
def test_the_encoder_must_have_been_pretrained(settings: Path, tmp_path: Path) -> None:
    command = [str(Path(sys.executable).parent / "lerobot-train-fast"), f"--config_path={settings}"]
    done = subprocess.run([*command, f"--output_dir={tmp_path / 'out'}"], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "is trained before the policy: act-keypoints-pretrain, then --policy.path with its --out." in done.stderr
