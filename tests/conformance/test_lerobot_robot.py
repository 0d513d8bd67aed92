"""LeRobot's commands drive the simulated SO-101; exported datasets drive the real arm, whose bus is a stub."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.check import checked, simulate_run
from support.commands import exit_code
from support.export import data_table, info
from support.lerobot_tools import Command, plugin_names, run_commands

from demorec.core.errors import ConfigError
from demorec.core.geometry import Array
from demorec.mcap import Recording
from demorec.robots.motors import CALIBRATIONS
from lerobot_robot_demorec import DemorecPanda, DemorecPandaConfig, DemorecSO101, DemorecSO101Config

SEED = 11
NAMES = tuple(
    f"{joint}.pos" for joint in ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
)
CALIBRATION = CALIBRATIONS / "so101_urdf.json"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("expert") / "run"
    return simulate_run(folder, 1, robot="so101", seed=SEED, split="train", variation="none", cameras=("front",))


@pytest.fixture(scope="module")
def dataset(run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("ours") / "d"
    assert exit_code("export", "lerobot", run, "--motor-units", "degrees", "--no-verify", "--out", out) == 0
    return out


def actions(dataset: Path) -> Array:
    return np.array(data_table(dataset)["action"].to_pylist())


@pytest.mark.slow
def test_the_experts_actions_succeed_through_lerobots_interface(run: Path, dataset: Path, tmp_path: Path) -> None:
    home: dict[str, Any] = {
        "calibration_dir": tmp_path / "calibration",
        "cameras": ["front"],
        "width": 64,
        "height": 48,
    }
    config = DemorecSO101Config(**home, seed=SEED, variation="none", record=tmp_path / "recorded")
    robot = DemorecSO101(config)
    robot.connect()
    seen = []
    for row in actions(dataset):
        observation = robot.get_observation()
        seen.append([observation[name] for name in NAMES])
        sent = robot.send_action(dict(zip(NAMES, row, strict=True)))
        assert np.abs(np.array([sent[name] for name in NAMES]) - row).max() < 1e-3
    assert observation.keys() == robot.observation_features.keys()
    assert observation["front"].shape == robot.observation_features["front"] == (48, 64, 3)
    robot.disconnect()
    state = np.array(data_table(dataset)["observation.state"].to_pylist())
    assert np.abs(np.array(seen) - state).max() < 0.1  # degrees, percent; the dataset has float32
    recording = tmp_path / "recorded" / "episode_000000.mcap"
    with Recording(recording) as recorded:
        assert recorded.success
        assert recorded.num_frames == len(state)
        assert recorded.info.origin == "teleoperation by LeRobot"
    assert {"broken", "look"}.isdisjoint(result.verdict for result in checked(recording).results)
    assert exit_code("replay", recording) == 0


def test_a_custom_calibration_and_other_units(dataset: Path, tmp_path: Path) -> None:
    own = json.loads(CALIBRATION.read_text())
    own["elbow_flex"] |= {"range_min": 1047, "range_max": 3047}
    (tmp_path / "mine.json").write_text(json.dumps(own))
    home: dict[str, Any] = {"calibration_dir": tmp_path, "cameras": []}
    robot = DemorecSO101(DemorecSO101Config(**home, id="mine", use_degrees=False))
    robot.connect()
    robot.send_action({"elbow_flex.pos": 1.0})
    for _ in range(60):
        sent = robot.send_action({"elbow_flex.pos": 1.0})
    assert sent["elbow_flex.pos"] == pytest.approx(1.0)
    place = robot.spec.arm_joints.index("elbow_flex")
    angle = robot._env.situation.observation.joint_position[place]
    assert angle == pytest.approx(10 * math.tau / 4096, abs=0.01)  # a hundredth of half the range of 2000 counts
    with pytest.raises(ConfigError, match="the arm takes shoulder_pan"):
        robot.send_action({"joint_1.pos": 0.0})
    robot.disconnect()


def test_panda_has_the_elements_of_exported_datasets(tmp_path: Path) -> None:
    robot = DemorecPanda(DemorecPandaConfig(calibration_dir=tmp_path, cameras=[]))
    robot.connect()
    before = robot.get_observation()
    assert list(before) == [*(f"panda_joint{i}.pos" for i in range(1, 8)), "gripper.width"]
    for _ in range(40):
        robot.send_action({"panda_joint1.pos": before["panda_joint1.pos"] + 0.2, "gripper.width": 0.02})
    after = robot.get_observation()
    assert after["panda_joint1.pos"] - before["panda_joint1.pos"] == pytest.approx(0.2, abs=0.01)
    assert after["gripper.width"] == pytest.approx(0.02, abs=1e-3)
    assert after["panda_joint4.pos"] == pytest.approx(before["panda_joint4.pos"], abs=0.01)
    robot.disconnect()


@pytest.fixture(scope="module")
def ran(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Run LeRobot's commands one after the other."""
    folder = tmp_path_factory.mktemp("lerobot")
    script = folder / "script.json"
    script.write_text(json.dumps({"names": NAMES, "rows": actions(dataset).tolist()}))
    arm = ["--robot.type=demorec_so101", f"--robot.seed={SEED}", "--robot.variation=none"]
    small = ["--robot.width=96", "--robot.height=96", "--robot.cameras=[front]"]
    real = ["--robot.type=so101_follower", "--robot.port=none", "--robot.id=so101_urdf"]
    real += [f"--robot.calibration_dir={CALIBRATIONS}"]
    camera = "--robot.cameras={front: {type: still, width: 96, height: 96, fps: 30}}"
    teleop = ["--teleop.type=scripted", f"--teleop.script={script}"]
    ours = ["--dataset.repo_id=local/ours", f"--dataset.root={dataset}", "--dataset.episode=0", "--play_sounds=false"]

    def recording(name: str) -> list[str]:
        flags = ["num_episodes=1", "episode_time_s=2", "fps=30", "single_task=Put it there.", "push_to_hub=false"]
        named = [f"repo_id=local/{name}", f"root={folder / name}", "no_stamp=true", "rgb_encoder.vcodec=h264"]
        return [*(f"--dataset.{flag}" for flag in [*named, *flags]), "--play_sounds=false"]

    again = ["--dataset.repo_id=local/simulated", f"--dataset.root={folder / 'simulated'}", "--dataset.episode=0"]
    pair = f"['{dataset}', '{folder / 'real'}']"
    merge = ["--operation.type=merge", "--operation.repo_ids=['local/ours', 'local/real']", f"--operation.roots={pair}"]
    # LeRobot's own H.264 has B-frames, ours has none; LeRobot cannot append one to the other in one file.
    merge += ["--operation.concatenate_videos=false"]
    merged = ["--dataset.repo_id=local/both", f"--dataset.root={folder / 'both'}", "--dataset.episode=1"]
    merged += ["--play_sounds=false"]
    stub = {"STUB_CALIBRATION": str(CALIBRATION)}
    run_commands(
        [
            Command(command="lerobot_replay", args=[*arm, *small, f"--robot.record={folder / 'replayed'}", *ours]),
            Command(
                command="lerobot_teleoperate",
                args=[*arm, *small, f"--robot.record={folder / 'driven'}", *teleop, "--fps=30", "--teleop_time_s=1"],
            ),
            Command(
                command="lerobot_record",
                args=[*arm, *small, f"--robot.record={folder / 'beside'}", *teleop, *recording("simulated")],
            ),
            Command(command="lerobot_replay", args=[*arm, "--robot.cameras=[]", *again, "--play_sounds=false"]),
            Command(command="lerobot_record", args=[*real, camera, *teleop, *recording("real")], env=stub),
            Command(
                command="lerobot_edit_dataset",
                args=[*merge, "--new_repo_id=local/both", f"--new_root={folder / 'both'}"],
            ),
            Command(command="lerobot_replay", args=[*real, *merged], env=stub),
            Command(command="lerobot_replay", args=[*real, *ours], env={**stub, "STUB_LOG": str(folder / "goals.txt")}),
        ],
        folder,
    )
    return folder


slow = pytest.mark.slow


@slow
@pytest.mark.long  # in real time
def test_lerobot_replay_plays_an_exported_dataset_in_the_simulator(ran: Path, dataset: Path) -> None:
    with Recording(ran / "replayed" / "episode_000000.mcap") as recording:
        assert recording.success
        assert recording.num_frames == len(actions(dataset))


@slow
def test_lerobot_teleoperate_drives_the_simulated_arm(ran: Path, run: Path) -> None:
    with (
        Recording(ran / "driven" / "episode_000000.mcap") as driven,
        Recording(next((run / "episodes").iterdir())) as expert,
    ):
        found, wanted = driven.trajectory().command_joint_target, expert.trajectory().action_joint_target
    assert len(found)
    assert np.abs(found - wanted[: len(found)]).max() < 1e-5


@slow
def test_lerobot_record_writes_the_data_of_the_recording(ran: Path) -> None:
    table = data_table(ran / "simulated")
    found = info(ran / "simulated")
    assert (found["robot_type"], found["fps"]) == ("demorec_so101", 30)
    assert tuple(found["features"]["observation.state"]["names"]) == NAMES
    state = np.array(table["observation.state"].to_pylist())
    with Recording(ran / "beside" / "episode_000000.mcap") as recording:
        radians = recording.trajectory().joint_position
    assert len(state) == len(radians) > 1
    assert np.abs(state[:, :5] - np.degrees(radians[:, :5])).max() < 0.1


@slow
def test_simulated_and_real_datasets_merge_unedited(ran: Path, dataset: Path) -> None:
    both, real = info(ran / "both"), info(ran / "real")
    assert real["robot_type"] == both["robot_type"] == info(dataset)["robot_type"]
    assert both["total_episodes"] == 2
    assert both["total_frames"] == len(actions(dataset)) + real["total_frames"]


@slow
def test_a_real_arm_can_execute_exported_actions(ran: Path, dataset: Path) -> None:
    """Check every goal sent to the servos: within their range, and no faster than they turn."""
    goals = np.array([line.split() for line in (ran / "goals.txt").read_text().splitlines()], dtype=int)
    counts = np.stack([goals[goals[:, 0] == servo, 1] for servo in range(1, 7)], axis=1)
    assert len(counts) == len(actions(dataset))
    ranges = np.array([[m["range_min"], m["range_max"]] for m in json.loads(CALIBRATION.read_text()).values()])
    assert (counts >= ranges[:, 0]).all()
    assert (counts <= ranges[:, 1]).all()
    speed = np.abs(np.diff(counts[:, :5], axis=0)).max() * 30 * math.tau / 4096
    assert 0.1 < speed < 52 / 60 * math.tau  # rad/s: the data sheet specifies 52 rpm


def test_the_plugins_are_called_as_lerobot_looks_for_them() -> None:
    assert plugin_names() == ["lerobot_env_demorec", "lerobot_policy_act_keypoints", "lerobot_robot_demorec"]
