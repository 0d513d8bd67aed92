"""Recorded actions are replayed in the simulator."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.check import Spoilt, simulate, simulate_run
from support.commands import exit_code

from demorec.datasets.lerobot.export import export_lerobot
from demorec.datasets.lerobot.options import ExportOptions
from demorec.episode.episode import Event
from demorec.extensions.remake.demonstration import open_file
from demorec.extensions.remake.drive import ReplayReport, replay_all
from demorec.mcap import Recording


@pytest.fixture(scope="session")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return simulate(tmp_path_factory.mktemp("replay") / "recorded.mcap", seed=11)


def _replay(path: Path) -> ReplayReport:
    (report,) = replay_all([open_file(path)])
    return report


@pytest.mark.parametrize("fps", [pytest.param(10, marks=pytest.mark.slow), 60])
def test_other_rates_replay_to_the_bit(fps: int, tmp_path: Path) -> None:
    assert _replay(simulate(tmp_path / "e.mcap", fps=fps, seed=5)).is_identical


def test_a_state_that_was_changed_is_found(recorded: Path, tmp_path: Path) -> None:
    spoilt = Spoilt(recorded)
    poses = spoilt.columns.object_poses["red_cube"].copy()
    poses[30, 0] += 0.25
    spoilt.pose_of("red_cube", poses)
    report = _replay(spoilt.write(tmp_path / "s.mcap"))
    assert report.first_difference == (30, "the pose of red_cube")
    assert report.object_error == pytest.approx(0.25, abs=1e-6)


def test_another_final_state_is_found(recorded: Path, tmp_path: Path) -> None:
    spoilt = Spoilt(recorded)
    assert spoilt.outcome is not None
    spoilt.outcome = replace(spoilt.outcome, final_state_digest="0" * 64)
    report = _replay(spoilt.write(tmp_path / "s.mcap"))
    assert report.first_difference == (report.num_steps, "the final state")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "what"),
    [
        ("contact_force", "the contact force"),
        ("sensed", "the wrench"),
    ],
)
def test_a_sensed_value_that_was_changed_is_found(recorded: Path, tmp_path: Path, name: str, what: str) -> None:
    spoilt = Spoilt(recorded)
    table = spoilt.columns.sensed["wrench"] if name == "sensed" else getattr(spoilt.columns, name)
    changed = table.copy()
    changed[40:50] += 1e-6
    spoilt.set(**{name: {**spoilt.columns.sensed, "wrench": changed} if name == "sensed" else changed})
    report = _replay(spoilt.write(tmp_path / "s.mcap"))
    assert report.first_difference is not None
    assert report.first_difference[1] == what
    assert 40 <= report.first_difference[0] < 50


@pytest.mark.slow
def test_an_outcome_that_was_changed_is_found(
    recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    spoilt = Spoilt(recorded)
    outcome = spoilt.outcome
    assert outcome is not None
    spoilt.outcome = replace(outcome, success=False, failure_phase="lift", failure_reason="drop")
    assert exit_code("replay", spoilt.write(tmp_path / "relabelled.mcap")) == 1
    assert "identical, succeeds where the recording failed" in capsys.readouterr().out
    tilt = next(check for check in outcome.checks if check.name == "tilt")
    others = tuple(replace(check, limit=2 * check.limit) if check is tilt else check for check in outcome.checks)
    spoilt.outcome = replace(outcome, checks=others)
    report = _replay(spoilt.write(tmp_path / "limit.mcap"))
    assert report.first_difference == (report.num_steps, "the condition tilt")


@pytest.mark.slow
def test_an_expert_that_gave_up_is_a_failure_even_if_the_conditions_hold(recorded: Path, tmp_path: Path) -> None:
    """As with an object that was misplaced three times and comes to rest after that."""
    spoilt = Spoilt(recorded)
    assert spoilt.outcome is not None
    spoilt.outcome = replace(spoilt.outcome, success=False, failure_phase="verify", failure_reason="misplaced_speed")
    spoilt.events[spoilt.frames[-1]] = (Event(name="misplaced_speed", message="", level="warning"),)
    path = spoilt.write(tmp_path / "s.mcap")
    assert exit_code("replay", path) == 0


@pytest.mark.slow
def test_a_recording_of_the_replay(tmp_path: Path) -> None:
    source = simulate(tmp_path / "e.mcap", seed=11, cameras=("front",), width=64, height=64)
    assert exit_code("replay", source, "--out", tmp_path / "out") == 0
    with Recording(source) as a, Recording(tmp_path / "out" / "e.mcap") as b:
        assert b.info.origin == f"replay of {a.digest()[:16]}"
        x, y = a.trajectory(), b.trajectory()
        assert np.array_equal(x.joint_position, y.joint_position)
        assert np.array_equal(x.action_joint_target, y.action_joint_target)
        assert x.phase == y.phase
        assert [p.data for p in a.packets("front")] == [p.data for p in b.packets("front")]
        assert b.outcome == a.outcome
    # The same replay is kept; a different one replaces it only on request; nothing replaces the source.
    replayed = (tmp_path / "out" / "e.mcap").read_bytes()
    assert exit_code("replay", source, "--out", tmp_path / "out") == 0
    other = simulate(tmp_path / "other" / "e.mcap", seed=12)
    assert exit_code("replay", other, "--out", tmp_path / "out") == 2
    assert (tmp_path / "out" / "e.mcap").read_bytes() == replayed
    assert exit_code("replay", source, "--out", tmp_path / "out", "--overwrite") == 0
    assert exit_code("replay", source, "--out", tmp_path, "--overwrite") == 2


@pytest.mark.slow
def test_the_command(recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_code("replay", recorded) == 0
    assert "identical, succeeds" in capsys.readouterr().out
    assert exit_code("replay", recorded, "--json") == 0
    assert json.loads(capsys.readouterr().out)[0]["is_identical"] is True
    assert exit_code("replay", recorded, "--episodes", "5:9") == 2
    assert exit_code("replay", tmp_path / "nothing") == 2
    spoilt = Spoilt(recorded)
    targets = spoilt.columns.command_joint_target.copy()
    targets[70, 2] += 1e-12
    spoilt.set(command_joint_target=targets)
    path = spoilt.write(tmp_path / "s.mcap")
    assert exit_code("replay", path) == 1
    assert "differs from step 71" in capsys.readouterr().out  # state 71 is the first to show command 70
    assert exit_code("replay", path, "--tolerance", "0.001") == 0


@pytest.fixture(scope="module")
def quiet_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Without exploration noise, recorded actions are the executed ones, rounded to float32."""
    return simulate_run(tmp_path_factory.mktemp("quiet") / "run", 2, seed=3, variation="none")


@pytest.mark.parametrize(
    "action", ["joint", *(pytest.param(kind, marks=pytest.mark.slow) for kind in ("joint_increment", "ee", "ee_delta"))]
)
def test_datasets_of_every_kind_of_action(action: str, quiet_run: Path, tmp_path: Path) -> None:
    export_lerobot([quiet_run], tmp_path / "ds", ExportOptions(verify=False, action=action))  # type: ignore[arg-type]
    from demorec.extensions.remake.replay_command import demonstrations

    found = list(replay_all(demonstrations([tmp_path / "ds"], (), episodes="")))
    assert [report.success for report in found] == [True, True]
    assert all(report.unreachable == 0 for report in found)
    # Inverse kinematics may bend the elbow differently; the joints themselves match except for rounding and drift.
    limit = 2e-3 if action.startswith("joint") else 0.5
    assert max(report.joint_error for report in found) < limit
    assert exit_code("replay", tmp_path / "ds", "--episodes", "1") == 0


@pytest.mark.slow
def test_the_total_counts_the_differences_of_a_dataset(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = simulate_run(tmp_path / "run", 1, seed=5)
    export_lerobot([run], tmp_path / "d", ExportOptions(verify=False, fps=10))
    assert exit_code("replay", tmp_path / "d") == 0
    episode, total = capsys.readouterr().out.splitlines()
    (gripper,) = re.findall(r"gripper (\S+) mm", episode)
    assert float(gripper) > 0
    assert total.endswith(f"gripper {gripper} mm.")  # but not for objects, whose poses a dataset does not have
    assert exit_code("replay", run) == 0
    assert "gripper 0 mm, objects 0 mm.\n" in capsys.readouterr().out


def test_nan_is_not_sent(recorded: Path) -> None:
    """An action of a damaged dataset: the arm stays in place, and the step is counted."""
    whole = open_file(recorded)
    sent = [frame.command for frame in whole.recorded]
    actions = np.array([[*command.joint_target, command.gripper_target] for command in sent])
    actions[3, 2] = np.nan
    damaged = replace(whole, actions=actions, action_kind="joint", recorded=())
    (report,) = replay_all([damaged])
    assert report.unreachable == 1
    assert np.isfinite(report.joint_error)
