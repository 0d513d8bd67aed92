"""`--state joint_ee`: the TCP's pose after the joints in observation.state, for all users of such data or policies."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.check import checked, simulate_run, verdict_of
from support.export import data_table, info
from support.external import make_external, write_external

from demorec.core.config import GenerateConfig
from demorec.core.errors import ConfigError
from demorec.datasets.lerobot.export import export_lerobot
from demorec.datasets.lerobot.options import ExportOptions
from demorec.episode.features import Vectors
from demorec.extensions.policies.gym_env import DemorecEnv
from demorec.extensions.policies.policy import CONFIG_NAME
from demorec.extensions.policies.rollouts import settings_for
from demorec.mcap import Recording

STATE = "observation.state"
SMALL = ExportOptions(verify=False, action="ee_delta", state="joint_ee", features=(STATE,))


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two episodes without exploration noise, so that actions are the executed ones."""
    return simulate_run(tmp_path_factory.mktemp("states") / "run", 2, seed=3, variation="none")


@pytest.fixture(scope="module")
def dataset(run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("states") / "ds"
    export_lerobot([run], folder, ExportOptions(verify=False, state="joint_ee"))
    return folder


@pytest.fixture
def small(run: Path, tmp_path: Path) -> Path:
    """The state alone holds the TCP's pose."""
    export_lerobot([run], tmp_path / "small", SMALL)
    return tmp_path / "small"


def states(dataset: Path) -> Vectors:
    return np.array(data_table(dataset).column(STATE).to_pylist(), dtype=np.float32)


def test_the_state_is_joints_gripper_and_the_recorded_pose(run: Path, dataset: Path) -> None:
    first, *_ = sorted((run / "episodes").glob("*.mcap"))
    with Recording(first) as recording:
        trajectory = recording.trajectory()
    found = states(dataset)[: trajectory.num_frames]
    assert found.shape == (trajectory.num_frames, 15)
    assert info(dataset)["features"][STATE]["names"][6:10] == ["panda_joint7.pos", "gripper.width", "tcp.x", "tcp.y"]
    assert np.array_equal(found[:, :7], trajectory.joint_position[:, :7].astype(np.float32))
    assert np.array_equal(found[:, 7], trajectory.gripper_width.astype(np.float32))
    assert np.array_equal(found[:, 8:11], trajectory.base_from_tcp[:, :3].astype(np.float32))
    # A quaternion and its negative are one rotation.
    np.testing.assert_allclose(np.abs((found[:, 11:] * trajectory.base_from_tcp[:, 3:]).sum(axis=1)), 1.0, atol=1e-6)
    assert (found[:, 11] >= 0).all()


def test_such_a_dataset_passes_every_check(dataset: Path, small: Path) -> None:
    for path in (dataset, small):
        report = checked(path, "dataset", images=False)
        assert [r for r in report.results if r.verdict in ("look", "broken")] == []
    for check in ("pose_mismatch", "joint_limits"):
        assert verdict_of(small, check, "dataset") == "good"


@pytest.mark.slow
def test_the_environment_gives_the_dataset_to_the_bit(run: Path, tmp_path: Path) -> None:
    first, *_ = sorted((run / "episodes").glob("*.mcap"))
    export_lerobot([first], tmp_path / "one", SMALL)
    with Recording(first) as recording:
        trajectory = recording.trajectory()
    config = GenerateConfig(cameras=(), seed=3, variation="none")
    env = DemorecEnv(config=config, state="joint_ee", privileged=False)
    assert env.observation_space["agent_pos"].shape == (15,)
    observation, _ = env.reset(seed=0)
    for row, command in zip(states(tmp_path / "one"), trajectory.command_joint_target, strict=True):
        assert np.array_equal(observation["agent_pos"], row)
        frame = env.situation.frame_index
        observation, *_ = env.step(np.append(command, trajectory.command_gripper[frame]))
    env.close()


@pytest.mark.parametrize(("length", "kind"), [(8, "joint"), (15, "joint_ee")])
def test_a_policy_states_its_kind_of_state(length: int, kind: str, tmp_path: Path) -> None:
    plain = {"type": "act", "input_features": {STATE: {"type": "STATE", "shape": [length]}}}
    (tmp_path / CONFIG_NAME).write_text(json.dumps(plain))
    assert settings_for(tmp_path, GenerateConfig(cameras=()), action="ee_delta").state == kind


def test_lerobot_gets_the_kind_of_state() -> None:
    from lerobot_env_demorec import DemorecEnvConfig

    assert DemorecEnvConfig(state="joint_ee").features["agent_pos"].shape == (15,)
    plain = DemorecEnvConfig(sensed=["observation.wrench"])
    assert plain.features["agent_pos"].shape == (8,)
    assert plain.features["wrench"].shape == (6,)
    assert plain.features_map["wrench"] == "observation.wrench"
    with pytest.raises(ConfigError, match="Unknown state 'joint_e'"):
        DemorecEnvConfig(state="joint_e")


def test_states_of_two_kinds_do_not_go_into_one_dataset(run: Path, dataset: Path) -> None:
    before = states(dataset)
    with pytest.raises(ConfigError, match=STATE):
        export_lerobot([run], dataset, ExportOptions(verify=False, append=True))
    assert np.array_equal(states(dataset), before)


def test_the_state_of_an_external_episode_is_unchanged(tmp_path: Path) -> None:
    write_external(tmp_path / "e.mcap", make_external(cameras=()))
    with pytest.raises(ConfigError, match="state joint_ee needs the scene"):
        export_lerobot([tmp_path / "e.mcap"], tmp_path / "ds", replace(SMALL, action="joint"))
    assert not (tmp_path / "ds").exists()
