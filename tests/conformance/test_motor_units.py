"""A dataset of the SO-101 in motor units, against LeRobot's own driver of the arm."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest
from support.check import checked, simulate, simulate_run
from support.commands import exit_code
from support.export import data_table, info

from demorec.learn.evaluate.policy import trained_action
from demorec.mcap import Recording
from demorec.robots.so101 import SO101_FOLLOWER

pytestmark = pytest.mark.usefixtures("hf_datasets_cache")

JAW = (-0.174533, 1.74533)
"""Limits of the URDF, rad: LeRobot's 0 and 100."""


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return simulate_run(tmp_path_factory.mktemp("so101") / "run", 1, robot="so101", seed=11, cameras=("front",))


@pytest.fixture(scope="module")
def dataset(run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("motor-units") / "d"
    assert exit_code("export", "lerobot", run, "--motor-units", "--no-verify", "--out", out) == 0
    return out


def columns(dataset: Path) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    table = data_table(dataset)
    return np.array(table["observation.state"].to_pylist()), np.array(table["action"].to_pylist())


@pytest.fixture
def follower(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Any:
    """LeRobot's driver, with our calibration in a file of its form; the library of the bus is a stub."""
    from lerobot.motors import motors_bus
    from lerobot.motors.feetech import feetech
    from lerobot.robots.so_follower import SO101Follower, SO101FollowerConfig

    for module in (motors_bus, feetech):
        monkeypatch.setattr(module, "require_package", lambda *args, **more: None)
    monkeypatch.setattr(feetech, "scs", MagicMock())
    calibration = {
        motor.joint: {
            "id": number,
            "drive_mode": 0,
            "homing_offset": 0,
            "range_min": motor.range_min,
            "range_max": motor.range_max,
        }
        for number, motor in enumerate(SO101_FOLLOWER.motors, start=1)
    }
    (tmp_path / "arm.json").write_text(json.dumps(calibration))
    return SO101Follower(SO101FollowerConfig(port="none", id="arm", calibration_dir=tmp_path))


def test_features_are_those_that_lerobot_records(dataset: Path, follower: Any) -> None:
    from lerobot.robots import RobotConfig
    from lerobot.utils.feature_utils import hw_to_dataset_features

    found = info(dataset)
    assert found["robot_type"] in RobotConfig.get_known_choices()
    recorded = {
        **hw_to_dataset_features(follower.observation_features, "observation"),
        **hw_to_dataset_features(follower.action_features, "action"),
    }
    assert set(recorded) == {"observation.state", "action"}
    for name, feature in recorded.items():
        ours = found["features"][name]
        assert (ours["names"], ours["dtype"], tuple(ours["shape"])) == (feature["names"], "float32", feature["shape"])
    others = set(found["features"]) - {"timestamp", "frame_index", "episode_index", "index", "task_index"}
    assert others == {"observation.state", "action", "observation.images.front"}


def test_values_are_the_radians_of_the_recording(run: Path, dataset: Path) -> None:
    with Recording(next((run / "episodes").iterdir())) as recording:
        c = recording.columns()
        jaw = recording.info.robot.gripper.joint_position(c.action_gripper)
    state, action = columns(dataset)
    for found, radians in ((state, c.joint_position), (action, np.column_stack([c.action_joint_target, jaw]))):
        # A count is 0.088 degrees: LeRobot's whole turn lacks one, and the roll's middle lies half a count off.
        assert np.abs(found[:, :5] - np.degrees(radians[:, :5])).max() < 0.1
        assert np.abs(found[:, 5] - 100 * (radians[:, 5] - JAW[0]) / (JAW[1] - JAW[0])).max() < 0.1
    assert np.ptp(state[:, 1]) > 10
    assert np.ptp(state[:, 5]) > 5


def test_lerobot_makes_the_same_of_what_the_servos_count(run: Path, dataset: Path, follower: Any) -> None:
    with Recording(next((run / "episodes").iterdir())) as recording:
        radians = recording.columns().joint_position
    zeros = np.array([2047] * 5 + [2047 - round(sum(JAW) / 2 * 4096 / math.tau)])
    counts = np.rint(zeros + radians * 4096 / math.tau).astype(int)
    state, _ = columns(dataset)
    for t in range(0, len(state), 10):
        said = follower.bus._normalize(dict(zip(range(1, 7), counts[t].tolist(), strict=True)))
        assert np.abs(state[t] - np.array(list(said.values()))).max() < 0.06  # half a count, which LeRobot rounds to


@pytest.mark.usefixtures("without_lerobot")  # which read it in the tests above
def test_check_is_clean_and_knows_degrees(dataset: Path) -> None:
    results = {result.check: result.level for result in checked(dataset, "dataset").results}
    assert {"warn", "fail"}.isdisjoint(results.values())
    assert results["joint_limits"] == "pass"


def test_what_cannot_be_in_motor_units_is_refused(
    run: Path, dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    panda = simulate(tmp_path / "panda.mcap", seed=11)
    assert exit_code("export", "lerobot", panda, "--motor-units", "--out", tmp_path / "a") != 0
    assert "not those of panda: leave --motor-units out" in " ".join(capsys.readouterr().err.split())
    assert exit_code("export", "lerobot", run, "--motor-units", "--action", "ee", "--out", tmp_path / "b") != 0
    assert not (tmp_path / "a").exists()
    assert not (tmp_path / "b").exists()
    (tmp_path / "train_config.json").write_text(json.dumps({"dataset": {"root": str(dataset)}}))
    assert trained_action(tmp_path) is None  # of a policy that learnt from it
