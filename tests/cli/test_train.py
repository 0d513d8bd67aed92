"""`demorec train`: lerobot-train with another reader, and the configs of examples/."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from support.docs import ROOT
from support.export import export, make_run
from support.training import SMALL_ACT

from demorec.cli import main

pytestmark = pytest.mark.usefixtures("hf_datasets_cache")

CONFIGS = sorted((ROOT / "examples").glob("*.json"))


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("train")
    export(make_run(folder / "run", (20, 24), width=64, height=64), folder / "d", privileged=True)
    return folder / "d"


def ends(*words: str) -> int:
    with pytest.raises(SystemExit) as ended:
        main(["train", *words])
    assert isinstance(ended.value.code, int)
    return ended.value.code


@pytest.fixture
def instead(monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[[], None]], None]:
    """Puts a function in the place of lerobot-train's own."""
    from lerobot.scripts import lerobot_train

    return lambda function: monkeypatch.setattr(lerobot_train, "main", function)


@pytest.mark.slow
def test_flags_go_on_and_the_reader_is_replaced_meanwhile(
    dataset: Path, instead: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    from lerobot.datasets import LeRobotDataset, factory

    from demorec.learn.training import FastDataset

    seen: dict[str, Any] = {}

    def lerobot_train() -> None:
        seen["argv"] = sys.argv
        opened = [factory.LeRobotDataset("local/test", root=dataset, video_backend="pyav") for _ in range(2)]
        seen["types"] = [type(each) for each in opened]
        seen["limit"] = opened[0]._frame_cache_bytes

    instead(lerobot_train)
    words = ["--config_path=a_b.yaml", "--policy.type", "act", '--rename_map={"a": "b"}', "--batch_size=2"]
    before = sys.argv
    assert ends(*words[:1], "--frame-cache-mb=3", *words[1:]) == 0
    assert seen == {"argv": ["lerobot-train", *words], "types": [FastDataset] * 2, "limit": 3 << 20}
    assert (sys.argv, factory.LeRobotDataset) == (before, LeRobotDataset)
    captured = capsys.readouterr()
    assert captured.err.splitlines() == [
        "demorec train: FastDataset reads in place of LeRobotDataset; all else is lerobot-train."
    ]


def test_an_error_of_lerobot_is_one_sentence(instead: Any, capsys: pytest.CaptureFixture[str]) -> None:
    from lerobot.datasets import LeRobotDataset, factory

    def lerobot_train() -> None:
        raise FileExistsError("Output directory outputs/x already exists.")

    instead(lerobot_train)
    assert ends("--output_dir=outputs/x") == 1
    assert capsys.readouterr().err == (
        "demorec train: lerobot-train stopped (FileExistsError: Output directory outputs/x already exists.); run "
        "lerobot-train with the same flags to see where.\n"
    )
    assert factory.LeRobotDataset is LeRobotDataset
    assert ends("--output_dir=outputs/x", "--policy.path=lerobot/act") == 1
    assert "); run lerobot-train with" in capsys.readouterr().err


def test_a_policy_that_is_nowhere_is_named(instead: Any, capsys: pytest.CaptureFixture[str]) -> None:
    from huggingface_hub.errors import LocalEntryNotFoundError

    def lerobot_train() -> None:
        raise LocalEntryNotFoundError("the Hub was not reached.")

    instead(lerobot_train)
    assert ends("--policy.path=outputs/eye") == 1
    assert "); --policy.path=outputs/eye names no folder here, so the Hub was asked for it." in capsys.readouterr().err


def parsed(*words: str) -> Any:
    import draccus
    from lerobot.configs.train import TrainPipelineConfig
    from lerobot.policies import factory  # noqa: F401  # which registers the policies' types

    return draccus.parse(TrainPipelineConfig, args=list(words))


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: str(path.stem))
def test_lerobots_parser_takes_the_configs(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["lerobot-train", f"--config_path={path}"])
    config = parsed(f"--config_path={path}")
    config.output_dir = None
    config.validate()
    assert config.policy.type.split("_")[0] == path.stem.split("_")[0]
    assert config.batch_size == json.loads(path.read_text())["batch_size"]
    assert config.policy.push_to_hub is False


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize("name", ["act_numbers", "images"])
def test_the_losses_are_those_of_lerobot_train(name: str, dataset: Path, tmp_path: Path) -> None:
    """Twelve updates by each program, with worker processes for the images: the same log but for its times."""
    workers, config = 0, ROOT / "examples" / f"{name}.json"
    if name == "images":
        workers, config = 2, tmp_path / "images.json"
        config.write_text(
            json.dumps({"dataset": {"repo_id": "local/test", "video_backend": "pyav"}, "policy": SMALL_ACT})
        )
    told = []
    for program in (["lerobot-train"], ["demorec", "train"]):
        out = tmp_path / program[-1]
        done = subprocess.run(
            [Path(sys.executable).parent / program[0], *program[1:],
             f"--config_path={config}", f"--dataset.root={dataset}", f"--output_dir={out}",
             "--policy.device=cpu", "--batch_size=4", "--steps=12", "--log_freq=1", f"--num_workers={workers}"],
            check=False, capture_output=True, text=True, timeout=280,
        )  # fmt: skip
        text = done.stdout + done.stderr
        assert done.returncode == 0, text[-3000:]
        assert ("FastDataset reads in place" in text) is (program[0] == "demorec")
        told.append(re.findall(r"step:(\S+) .*?loss:(\S+) grdn:(\S+)", text))
        weights = out / "checkpoints" / "last" / "pretrained_model" / "model.safetensors"
        told[-1].append(weights.read_bytes())
    assert len(told[0]) == 13
    assert told[0] == told[1]


@pytest.mark.parametrize("refused", [1, 2, "wrong"])
def test_what_its_parser_refuses_is_a_wrong_request(instead: Any, refused: object) -> None:
    def lerobot_train() -> None:
        raise SystemExit(refused)

    instead(lerobot_train)
    assert ends("--stepz=3") == 2


def test_missing_settings_are_a_wrong_request(capsys: pytest.CaptureFixture[str]) -> None:
    assert ends("--config_path=nothing.json") == 2
    assert "There is no such file of settings: nothing.json" in capsys.readouterr().err


def test_steps_are_no_flag_of_pretrain(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["pretrain", "--out", str(tmp_path / "eye"), "--steps=60"])
    assert ended.value.code == 2
    told = "demorec pretrain: --steps=60 is for demorec train: --num-updates says how long the encoder learns."
    assert capsys.readouterr().err.splitlines() == [told]
