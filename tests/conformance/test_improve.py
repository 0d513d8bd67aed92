"""demorec improve: rounds of training and corrections, killed and carried on, with LeRobot's own training."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from support.check import edit_json
from support.commands import exit_code
from support.export import data_table, info
from support.training import SMALL_ACT

from demorec.cli import generate_dataset_main, main
from demorec.learn.evaluate import improvement

pytestmark = pytest.mark.usefixtures("without_lerobot")  # which would verify each dataset, for seconds

SETTINGS: dict[str, Any] = {
    "policy": SMALL_ACT,
    "batch_size": 4,
    "steps": 6,
    "save_freq": 2,
    "num_workers": 0,
}


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with two demonstrations and the settings of a training that takes no time."""
    folder = tmp_path_factory.mktemp("improve")
    words = ["--num-episodes", "2", "--split", "train", "--cameras", "none", "--no-export", "--workers", "1"]
    assert exit_code(*words, "--out", folder / "run", program=generate_dataset_main) == 0
    (folder / "settings.json").write_text(json.dumps(SETTINGS))
    return folder


def words_for(place: Path, out: Path, *more: str) -> list[str]:
    words = ["improve", str(place / "run"), "--config-path", str(place / "settings.json"), "--out", str(out)]
    words += ["--privileged", "--features", "observation.environment_state", "--num-rounds", "1"]
    return [*words, "--num-episodes", "2", "--num-scenes", "1", "--workers", "1", "--after-seconds", "0.5", *more]


def ends(words: list[str]) -> int:
    with pytest.raises(SystemExit) as ended:
        main(words)
    assert isinstance(ended.value.code, int)
    return ended.value.code


class Failing:
    """In the place of `start_program`: a training that makes what is told, says something and fails."""

    def __init__(self, *makes: Path) -> None:
        self.commands: list[list[str]] = []
        self._makes = makes

    def __call__(self, command: list[str], **options: Any) -> subprocess.Popen[bytes]:
        self.commands.append(command)
        for path in self._makes:
            path.parent.mkdir(parents=True)
            path.write_text("{}")
        return subprocess.Popen([sys.executable, "-c", "print('no such field'); raise SystemExit(1)"], **options)


def test_a_training_that_fails_is_told_and_begun_anew(
    place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    train = out / "round_00" / "train"
    failing = Failing(train / "logs" / "a.txt")
    monkeypatch.setattr(improvement, "start_program", failing)
    assert ends(words_for(place, out)) == 1
    assert "The training failed (no such field), its output is in" in capsys.readouterr().err
    assert len(data_table(out / "round_00" / "dataset")) == info(out / "round_00" / "dataset")["total_frames"]
    assert f"--config_path={place / 'settings.json'}" in failing.commands[0]

    checkpoint = train / "checkpoints" / "last" / "pretrained_model" / "train_config.json"
    failing = Failing(checkpoint)
    monkeypatch.setattr(improvement, "start_program", failing)
    assert ends(words_for(place, out)) == 1
    assert (out / "round_00" / "train.unfinished" / "logs" / "a.txt").is_file()  # moved aside, not deleted
    assert not any("--resume" in word for word in failing.commands[0])

    failing = Failing()
    monkeypatch.setattr(improvement, "start_program", failing)
    assert ends(words_for(place, out)) == 1
    assert {f"--config_path={checkpoint}", "--resume=true"} <= set(failing.commands[0])


def test_the_kind_of_state_decides_the_datasets_and_older_rounds_had_one(
    place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(improvement, "start_program", Failing())
    assert ends(words_for(place, tmp_path / "ee", "--state", "joint_ee")) == 1
    assert info(tmp_path / "ee" / "round_00" / "dataset")["features"]["observation.state"]["shape"] == [15]
    assert ends(words_for(place, tmp_path / "old")) == 1
    assert info(tmp_path / "old" / "round_00" / "dataset")["features"]["observation.state"]["shape"] == [8]
    capsys.readouterr()

    edit_json(tmp_path / "old" / "improve.json", lambda data: data.pop("state"))
    assert ends(words_for(place, tmp_path / "old")) == 1
    assert "The training failed" in capsys.readouterr().err  # it went on
    assert ends(words_for(place, tmp_path / "old", "--state", "joint_ee")) != 0
    assert "state is joint there and joint_ee here" in capsys.readouterr().err


def test_what_is_not_its_own_is_refused(
    place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(improvement, "start_program", Failing())
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("precious")
    assert ends(words_for(place, tmp_path / "mine")) == 2
    assert "The folder holds something else (thesis.txt)" in capsys.readouterr().err
    out = tmp_path / "out"
    assert ends(words_for(place, out)) == 1
    assert ends(words_for(place, out, "--seed", "7", "--stray-metres", "0.1")) == 2
    told = capsys.readouterr().err
    assert "seed is 1 there and 7 here" in told
    assert "takeover stray_metres is 0.05 there and 0.1 here" in told
    words = words_for(place, out)
    words[words.index("--config-path") + 1] = str(tmp_path / "none.json")
    assert ends(words) == 2
    assert "The settings of the training cannot be read" in capsys.readouterr().err


def killed_when(words: list[str], path: Path, *, signal_number: int) -> None:
    """Run the command until something is at a path, and kill it; nothing of it goes on then."""
    process = subprocess.Popen(
        [sys.executable, "-m", "demorec", *words],
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    while not path.exists():
        assert process.poll() is None, f"it ended before {path} was there"
        time.sleep(0.02)
    process.send_signal(signal_number)
    assert process.wait(60) == (130 if signal_number == signal.SIGINT else -signal_number)


def told_rounds(told: str) -> list[str]:
    """The rows of the table without the times."""
    return [re.sub(r" +\d+  (\d+/\d+)", r" \1", line) for line in told.splitlines() if re.match(r" +\d", line)]


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.timeout(1800)
def test_it_goes_from_demonstrations_to_a_corrected_policy(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = place / "whole"
    assert ends(words_for(place, out)) == 0
    rounds = told_rounds(capsys.readouterr().out)
    assert [row.split()[:3] for row in rounds] == [["0", "2", "0"], ["1", "2", "2"]]
    # The same command again has nothing left to do, and another policy in its place is noticed.
    assert ends(words_for(place, out)) == 0
    assert told_rounds(capsys.readouterr().out) == rounds
    config = out / "round_00" / "train" / "checkpoints" / "last" / "pretrained_model" / "config.json"
    was = config.read_text()
    config.write_text(was + "\n")
    assert ends(words_for(place, out)) == 1
    assert "The policy is not the one that was trained here" in capsys.readouterr().err
    config.write_text(was)


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.timeout(1800)
def test_killed_anywhere_it_goes_on_to_the_end(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert ends(words_for(place, place / "whole")) == 0
    rounds = told_rounds(capsys.readouterr().out)
    out = place / "killed"
    moments = {
        out / "round_00" / "train": signal.SIGKILL,
        out / "round_01" / "corrections" / "episodes" / "episode_000000.mcap": signal.SIGKILL,
        out / "round_01" / "train": signal.SIGINT,
    }
    for path, signal_number in moments.items():
        killed_when(words_for(place, out), path, signal_number=signal_number)
    assert ends(words_for(place, out)) == 0
    assert told_rounds(capsys.readouterr().out) == rounds
    first, again = (data_table(root / "round_00" / "dataset") for root in (place / "whole", out))
    assert first.equals(again)
    for number in ("00", "01"):
        parts = (f"round_{number}", "train", "checkpoints", "last", "pretrained_model", "model.safetensors")
        assert place.joinpath("whole", *parts).read_bytes() == out.joinpath(*parts).read_bytes()
