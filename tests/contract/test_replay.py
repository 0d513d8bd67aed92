"""Recorded commands are replayed in the simulator."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from support.check import Spoilt, simulate
from support.commands import exit_code

from demorec.episode.episode import Event
from demorec.extensions.remake.drive import ReplayReport, replay_all
from demorec.mcap import Recording


@pytest.fixture(scope="session")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return simulate(tmp_path_factory.mktemp("replay") / "recorded.mcap", seed=11)


def _replay(path: Path) -> ReplayReport:
    with Recording(path) as recording:
        (report,) = replay_all([recording])
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
def test_the_command(recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_code("replay", recorded) == 0
    episode, total = capsys.readouterr().out.splitlines()
    assert episode.endswith("identical, succeeds")
    assert total.endswith("largest difference 0 rad, gripper 0 mm, objects 0 mm.")
    assert exit_code("replay", recorded, "--episodes", "5:9") == 2
    assert exit_code("replay", tmp_path / "nothing") == 2
    spoilt = Spoilt(recorded)
    targets = spoilt.columns.command_joint_target.copy()
    targets[70, 2] += 1e-12
    spoilt.set(command_joint_target=targets)
    path = spoilt.write(tmp_path / "s.mcap")
    assert exit_code("replay", path) == 1
    assert "differs from step 71" in capsys.readouterr().out  # state 71 is the first to show command 70
