"""Actions of a real SO-101, given as numbers alone: the simulated arm replays them and reports its error."""

from __future__ import annotations

import json
import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from support.check import edit_column, simulate, simulate_run
from support.commands import exit_code
from support.export import data_table

from demorec.robots.motors import CALIBRATIONS
from demorec.robots.so101 import SO101

pytestmark = pytest.mark.usefixtures("hf_datasets_cache")

ARM = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")
CALIBRATION = CALIBRATIONS / "so101_urdf.json"
DEGREES = ("--robot", "so101", "--motor-units", "degrees")
HELD = 0.012
"""Metres by which a cube may have held the recorded fingers apart; the replay has no cube."""


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two episodes as LeRobot would record them from a real arm, with nothing but names and numbers."""
    folder = tmp_path_factory.mktemp("real")
    run = simulate_run(folder / "run", 2, robot="so101", seed=11, variation="none", cameras=())
    out = folder / "d"
    assert exit_code("export", "lerobot", run, "--motor-units", "degrees", "--no-verify", "--out", out) == 0
    shutil.rmtree(out / "demorec")
    return out


def replayed(capsys: pytest.CaptureFixture[str], path: Path, *flags: object) -> list[dict[str, tuple[float, float]]]:
    """For each episode, joint -> (median, largest) error, degrees; metres for the gripper."""
    capsys.readouterr()
    assert exit_code("replay", *flags, path, "--json") == 0
    found = [report["tracking"] for report in json.loads(capsys.readouterr().out)]
    for tracking in found:
        assert list(tracking) == [*ARM, "gripper"]
        tracking |= {joint: tuple(math.degrees(error) for error in tracking[joint]) for joint in ARM}
    return found


def changed(dataset: Path, out: Path, change: Any) -> Path:
    """A copy with changed states (T, 6); the first row of each episode is kept."""
    shutil.copytree(dataset, out)
    (path,) = (out / "data").glob("*/*.parquet")
    number = np.array(pq.read_table(path)["episode_index"].to_pylist())

    def of_each(state: Any) -> Any:
        for episode in set(number.tolist()):
            state[number == episode] = change(state[number == episode])
        return state

    edit_column(out, "observation.state", of_each)
    return out


def test_actions_of_the_simulator_are_tracked(dataset: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = replayed(capsys, dataset, *DEGREES)
    assert len(found) == 2
    for tracking in found:
        assert max(largest for joint, (_, largest) in tracking.items() if joint in ARM) < 0.1
        assert tracking["gripper"][1] < 2 * HELD
    (one,) = replayed(capsys, dataset, *DEGREES, "--episodes", "1")
    assert one == found[1]


@pytest.mark.slow
def test_an_imported_recording_states_its_units(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert exit_code("import", "lerobot", dataset, "--motor-units", "degrees", "--out", tmp_path / "run") == 0
    by_run = replayed(capsys, tmp_path / "run", "--robot", "so101")
    assert by_run == replayed(capsys, dataset, *DEGREES)
    assert exit_code("replay", *DEGREES, tmp_path / "run") == 2
    assert "recordings have units" in capsys.readouterr().err


@pytest.mark.slow
def test_an_offset_and_a_lag_show_in_their_joints(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def offset(state: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        state[1:, 2] += 3.0  # degrees
        return state

    def late(state: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        return np.concatenate([np.repeat(state[:1], 3, axis=0), state[:-3]])

    for tracking in replayed(capsys, changed(dataset, tmp_path / "offset", offset), *DEGREES):
        median, largest = tracking["elbow_flex"]
        assert median == pytest.approx(3.0, abs=0.05)
        assert largest == pytest.approx(3.0, abs=0.1)
        assert max(tracking[joint][1] for joint in ARM if joint != "elbow_flex") < 0.1
    lagging = changed(dataset, tmp_path / "late", late)
    assert all(tracking["shoulder_pan"][1] > 1.0 for tracking in replayed(capsys, lagging, *DEGREES))
    # More than a hundredth of a radian off: not as recorded, if a comparison was requested.
    assert exit_code("replay", *DEGREES, "--tolerance", 0.01, lagging) == 1


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (("--robot", "so101"), "or --motor-units is missing"),
        (("--robot", "panda", "--motor-units", "degrees"), "they belong to another robot"),
        (("--motor-units", "degrees"), "add --robot so101"),
        ((*DEGREES, "--view"), "leave out --out and --view"),
        ((), "--robot replays a real arm's actions"),
    ],
)
def test_unsuitable_datasets_are_refused_in_one_sentence(
    dataset: Path, capsys: pytest.CaptureFixture[str], flags: tuple[str, ...], said: str
) -> None:
    capsys.readouterr()
    assert exit_code("replay", *flags, dataset) == 2
    assert said in " ".join(capsys.readouterr().err.split())


@pytest.mark.slow
def test_other_robots_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    panda = simulate(tmp_path / "panda.mcap", seed=11)
    assert exit_code("replay", "--robot", "so101", panda) == 2
    assert "leave out --robot" in capsys.readouterr().err
    assert exit_code("export", "lerobot", panda, "--no-verify", "--out", tmp_path / "d") == 0
    for flags, told in ((DEGREES, "no state of the servos"), (["--robot", "so101"], "they belong to another robot")):
        assert exit_code("replay", *flags, tmp_path / "d") == 2
        assert told in " ".join(capsys.readouterr().err.split())


def test_the_jaw_turns_as_far_as_a_real_one(dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """LeRobot's 100 is the joint's stop, far beyond the range of the tasks."""
    shutil.copytree(dataset, tmp_path / "d")
    action = np.array(data_table(dataset)["action"].to_pylist())
    action[:, 5] = 100.0
    for name in ("action", "observation.state"):
        edit_column(tmp_path / "d", name, lambda _: action)
    for tracking in replayed(capsys, tmp_path / "d", *DEGREES):
        assert tracking["gripper"][0] < 1e-3
    assert SO101.gripper.width(np.array([1.74533])) > 2 * SO101.gripper.open_width
