"""An SO-101 dataset in motor units, compared with LeRobot's own driver of the arm."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest
from numpy.typing import NDArray
from support.check import checked, edit_column, simulate, simulate_run
from support.commands import exit_code
from support.export import data_table, info

from demorec.extensions.policies.policy import trained_action
from demorec.mcap import Recording, open_recording
from demorec.robots.motors import CALIBRATIONS, MotorUnits
from demorec.robots.so101 import SO101_FOLLOWER

pytestmark = pytest.mark.usefixtures("hf_datasets_cache")

JAW = (-0.174533, 1.74533)
"""Limits of the URDF, rad: LeRobot's 0 and 100."""
UNITS = ("degrees", "range_m100_100")
KINEMATIC = ("joint_limits", "action_lag")
OF_THE_URDF = CALIBRATIONS / "so101_urdf.json"
OWN = {
    "shoulder_pan": {"id": 1, "drive_mode": 0, "homing_offset": -81, "range_min": 721, "range_max": 3389},
    "shoulder_lift": {"id": 2, "drive_mode": 1, "homing_offset": 1201, "range_min": 801, "range_max": 3210},
    "elbow_flex": {"id": 3, "drive_mode": 0, "homing_offset": 990, "range_min": 899, "range_max": 3112},
    "wrist_flex": {"id": 4, "drive_mode": 0, "homing_offset": 13, "range_min": 880, "range_max": 3221},
    "wrist_roll": {"id": 5, "drive_mode": 0, "homing_offset": -1320, "range_min": 0, "range_max": 4095},
    "gripper": {"id": 6, "drive_mode": 1, "homing_offset": 400, "range_min": 1993, "range_max": 3471},
}
"""A calibration as LeRobot saves it: an arm with different stops, and two motors with inverted percentages."""


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return simulate_run(tmp_path_factory.mktemp("so101") / "run", 1, robot="so101", seed=11, cameras=("front",))


@pytest.fixture(scope="module")
def dataset(run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("motor-units") / "d"
    assert exit_code("export", "lerobot", run, "--motor-units", "degrees", "--no-verify", "--out", out) == 0
    return out


def columns(dataset: Path) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    table = data_table(dataset)
    return np.array(table["observation.state"].to_pylist()), np.array(table["action"].to_pylist())


@pytest.fixture(params=["urdf", "own"])
def calibration(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """A calibration file in LeRobot's form: demorec's own, or that of another arm."""
    if request.param == "urdf":
        return OF_THE_URDF
    (tmp_path / "arm.json").write_text(json.dumps(OWN))
    return tmp_path / "arm.json"


@pytest.fixture
def driver(monkeypatch: pytest.MonkeyPatch) -> Callable[[Path, MotorUnits], Any]:
    """LeRobot's driver of the arm with a calibration; the library of the bus is a stub."""
    from lerobot.motors import motors_bus
    from lerobot.motors.feetech import feetech
    from lerobot.robots.so_follower import SO101Follower, SO101FollowerConfig

    for module in (motors_bus, feetech):
        monkeypatch.setattr(module, "require_package", lambda *args, **more: None)
    monkeypatch.setattr(feetech, "scs", MagicMock())

    def made(file: Path, units: MotorUnits) -> Any:
        named: Any = {"port": "none", "id": file.stem, "calibration_dir": file.parent}
        return SO101Follower(SO101FollowerConfig(**named, use_degrees=units == "degrees"))

    return made


def test_features_are_those_that_lerobot_records(dataset: Path, driver: Callable[[Path, MotorUnits], Any]) -> None:
    from lerobot.utils.feature_utils import hw_to_dataset_features

    follower = driver(OF_THE_URDF, "degrees")
    found = info(dataset)
    assert found["robot_type"] == follower.name
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


def test_actions_are_the_radians_of_the_recording(run: Path, dataset: Path) -> None:
    """A count is 0.088 degrees."""
    with Recording(next((run / "episodes").iterdir())) as recording:
        trajectory = recording.trajectory()
        jaw = recording.info.simulated.robot.gripper.joint_position(trajectory.action_gripper)[:, 0]
    _, action = columns(dataset)
    assert np.abs(action[:, :5] - np.degrees(trajectory.action_joint_target)).max() < 0.1
    assert np.abs(action[:, 5] - 100 * (jaw - JAW[0]) / (JAW[1] - JAW[0])).max() < 0.1
    assert np.ptp(action[:, 5]) > 5


def radians(run: Path) -> np.ndarray[Any, Any]:
    """(T, 6) of the recording, the jaw last."""
    with Recording(next((run / "episodes").iterdir())) as recording:
        return recording.trajectory().joint_position


@pytest.mark.parametrize("units", UNITS)
def test_lerobot_converts_servo_counts_to_the_same_values(
    run: Path, tmp_path: Path, calibration: Path, units: MotorUnits, driver: Callable[[Path, MotorUnits], Any]
) -> None:
    out = tmp_path / "d"
    flags = ("--motor-units", units, "--calibration", calibration, "--no-verify")
    assert exit_code("export", "lerobot", run, *flags, "--out", out) == 0
    state, _ = columns(out)
    follower = driver(calibration, units)
    assert len(follower.calibration) == 6
    # LeRobot's range covers the stops, and the URDF's zeros are between them; the jaw's 0 is not at its centre.
    middles = [(motor.range_min + motor.range_max) / 2 for motor in follower.calibration.values()]
    counts = np.array(middles) + (radians(run) - [0, 0, 0, 0, 0, sum(JAW) / 2]) * 4096 / math.tau
    ranges = [motor.range_max - motor.range_min for motor in follower.calibration.values()]
    a_count = np.array([360 / 4095 if units == "degrees" else 200 / size for size in ranges])
    a_count[5] = 100 / ranges[5]
    for t in range(0, len(state), 10):
        said = follower.bus._normalize(dict(zip(range(1, 7), np.rint(counts[t]).astype(int).tolist(), strict=True)))
        # LeRobot rounds to whole counts, and the centre of a range may be half a count off.
        assert (np.abs(state[t] - np.array(list(said.values()))) < 1.02 * a_count).all()
        sent = follower.bus._unnormalize(dict(zip(range(1, 7), state[t].tolist(), strict=True)))
        assert np.abs(np.array(list(sent.values())) - counts[t]).max() < 1.6  # it truncates


@pytest.mark.parametrize("units", UNITS)
def test_a_dataset_of_lerobot_is_read_as_radians(
    run: Path, tmp_path: Path, calibration: Path, units: MotorUnits
) -> None:
    """As with a real arm, the dataset has nothing but names and numbers."""
    named = ("--motor-units", units, "--calibration", calibration)
    assert exit_code("export", "lerobot", run, *named, "--no-verify", "--out", tmp_path / "d") == 0
    shutil.rmtree(tmp_path / "d" / "demorec")
    assert exit_code("import", "lerobot", tmp_path / "d", *named, "--out", tmp_path / "again") == 0
    with open_recording(next((tmp_path / "again" / "episodes").iterdir())) as recording:
        feature = next(found for found in recording.info.features if found.name == "observation.state")
        read = feature.in_si(recording.table().features["observation.state"])
        assert 'name="so101' in recording.info.urdf
    assert feature.joints == tuple(OWN)
    expected = radians(run)
    expected[:, 5] = expected[:, 5].clip(*JAW)
    assert np.abs(read - expected).max() < 2e-6  # float32
    plain, understood = (
        {
            result.check: result.verdict
            for result in checked(tmp_path / "d", "dataset", only=KINEMATIC, motors=motors).results
        }
        for motors in (None, SO101_FOLLOWER.motors(units, calibration))
    )
    assert (plain["joint_limits"], understood["joint_limits"]) == ("not measured", "good")
    assert {"look", "broken"}.isdisjoint(understood.values())


def test_a_real_arm_beyond_its_limits_is_found(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(dataset, tmp_path / "d")
    shutil.rmtree(tmp_path / "d" / "demorec")

    def bent(state: NDArray[Any]) -> NDArray[Any]:
        state[5, 3] = 107.0  # degrees; the wrist ends at 95
        return state

    edit_column(tmp_path / "d", "observation.state", bent)
    chosen = ("--only", "joint_limits")
    assert exit_code("check", tmp_path / "d", *chosen) == 0
    capsys.readouterr()
    assert exit_code("check", tmp_path / "d", "--motor-units", "degrees", "--strict", *chosen) == 1
    assert "wrist_flex.pos" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"gripper": None}, "expected are shoulder_pan"),
        ({"elbow_flex": {**OWN["elbow_flex"], "range_min": 3112}}, "the range of elbow_flex is 3112 to 3112"),
        ({"elbow_flex": {**OWN["elbow_flex"], "drive_mode": 2}}, "the drive_mode of elbow_flex is 2"),
        ({"elbow_flex": {"id": 3}}, "drive_mode"),
    ],
)
def test_an_invalid_calibration_is_refused(
    run: Path, tmp_path: Path, change: dict[str, Any], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    wrong = {name: entry for name, entry in {**OWN, **change}.items() if entry is not None}
    (tmp_path / "arm.json").write_text(json.dumps(wrong))
    flags = ("--motor-units", "degrees", "--calibration", tmp_path / "arm.json")
    assert exit_code("export", "lerobot", run, *flags, "--out", tmp_path / "d") == 2
    assert said in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "d").exists()


@pytest.mark.usefixtures("without_lerobot")  # the tests above read it this way
def test_check_is_clean_and_knows_degrees(dataset: Path) -> None:
    results = {result.check: result.verdict for result in checked(dataset, "dataset").results}
    assert {"look", "broken"}.isdisjoint(results.values())
    assert results["joint_limits"] == "good"


def test_other_robots_are_refused_in_motor_units(
    run: Path, dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    panda = simulate(tmp_path / "panda.mcap", seed=11)
    assert exit_code("export", "lerobot", panda, "--motor-units", "degrees", "--out", tmp_path / "a") != 0
    assert "not for those of panda: leave out --motor-units" in " ".join(capsys.readouterr().err.split())
    wrong = ("--motor-units", "degrees", "--action", "ee")
    assert exit_code("export", "lerobot", run, *wrong, "--out", tmp_path / "b") != 0
    assert not (tmp_path / "a").exists()
    assert not (tmp_path / "b").exists()
    (tmp_path / "train_config.json").write_text(json.dumps({"dataset": {"root": str(dataset)}}))
    assert trained_action(tmp_path) is None  # of a policy trained on it
