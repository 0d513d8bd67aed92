"""`lerobot-train-fast`: lerobot-train with another reader."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from lerobot_datasets import SMALL_ACT, write_demonstrations

from lerobot_policy_act_keypoints.commands import lerobot_train_fast


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_demonstrations(tmp_path_factory.mktemp("train") / "d", 3)


def ends(*words: str) -> int:
    with pytest.raises(SystemExit) as ended:
        lerobot_train_fast(words)
    assert isinstance(ended.value.code, int)
    return ended.value.code


@pytest.fixture
def instead(monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[[], None]], None]:
    """Put a function in the place of lerobot-train's own."""
    from lerobot.scripts import lerobot_train

    return lambda function: monkeypatch.setattr(lerobot_train, "main", function)


@pytest.mark.slow
def test_flags_go_on_and_the_reader_is_replaced_meanwhile(
    dataset: Path, instead: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    from lerobot.datasets import LeRobotDataset, factory

    from lerobot_policy_act_keypoints import FastDataset

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
        "lerobot-train-fast: FastDataset reads in place of LeRobotDataset; all else is lerobot-train."
    ]


def test_an_error_of_lerobot_is_one_sentence(instead: Any, capsys: pytest.CaptureFixture[str]) -> None:
    from lerobot.datasets import LeRobotDataset, factory

    def lerobot_train() -> None:
        raise FileExistsError("Output directory outputs/x already exists.")

    instead(lerobot_train)
    assert ends("--output_dir=outputs/x") == 1
    assert capsys.readouterr().err == (
        "lerobot-train-fast: lerobot-train stopped (FileExistsError: Output directory outputs/x already exists.); run "
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
    assert "); --policy.path=outputs/eye is not a folder here, so the Hub was asked for it." in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.long
def test_the_losses_are_those_of_lerobot_train(dataset: Path, tmp_path: Path) -> None:
    """Check that twelve updates by each program, with workers, give the same log except times, and the same weights."""
    config = tmp_path / "images.json"
    config.write_text(json.dumps({"dataset": {"repo_id": "local/test", "video_backend": "pyav"}, "policy": SMALL_ACT}))
    results = []
    for program in ("lerobot-train", "lerobot-train-fast"):
        out = tmp_path / program
        done = subprocess.run(
            [Path(sys.executable).parent / program,
             f"--config_path={config}", f"--dataset.root={dataset}", f"--output_dir={out}",
             "--batch_size=4", "--steps=12", "--log_freq=1", "--num_workers=2"],
            check=False, capture_output=True, text=True, timeout=280,
        )  # fmt: skip
        text = done.stdout + done.stderr
        assert done.returncode == 0, text[-3000:]
        assert ("FastDataset reads in place" in text) is (program == "lerobot-train-fast")
        losses = re.findall(r"step:(\S+) .*?loss:(\S+) grdn:(\S+)", text)
        assert len(losses) == 12
        weights = out / "checkpoints" / "last" / "pretrained_model" / "model.safetensors"
        results.append((losses, weights.read_bytes()))
    assert results[0] == results[1]


@pytest.mark.parametrize("refused", [1, 2, "wrong"])
def test_what_its_parser_refuses_is_a_wrong_request(instead: Any, refused: object) -> None:
    def lerobot_train() -> None:
        raise SystemExit(refused)

    instead(lerobot_train)
    assert ends("--stepz=3") == 2


def test_missing_settings_are_a_wrong_request(capsys: pytest.CaptureFixture[str]) -> None:
    assert ends("--config_path=nothing.json") == 2
    assert "The settings file does not exist: nothing.json" in capsys.readouterr().err
