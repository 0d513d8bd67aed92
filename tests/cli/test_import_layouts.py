"""Mappings that `demorec import --suggest` writes for third-party robots, and episodes imported with them unedited."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from support import bags
from support.commands import exit_code
from support.layouts import LAYOUTS, Part

from demorec.mcap import Recording


def _expected(notes: bags.Notes, parts: Sequence[Part], time_ns: int) -> list[float]:
    """Return the latest values of each part at each time, by header time where a topic has one."""
    row: list[float] = []
    for part in parts:
        known = [
            (note.header_ns or note.log_ns, numbers)
            for note in notes
            if note.topic == part.topic and (numbers := part.numbers(note.body)) is not None
        ]
        row += [
            float(number) for number in max((pair for pair in known if pair[0] <= time_ns), key=lambda pair: pair[0])[1]
        ]
    return row


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(LAYOUTS))
def test_a_suggested_mapping_works_unedited(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    layout = LAYOUTS[name]
    notes = layout.notes()
    bag = layout.write(notes, tmp_path)
    assert exit_code("import", "--suggest", bag) == 0
    text, warned = capsys.readouterr()
    mapping = tmp_path / "robot.toml"
    mapping.write_text(text)
    code = exit_code("import", bag, "--mapping", mapping, "--out", tmp_path / "run")
    assert (code, warned) == (0, ""), capsys.readouterr().err
    with Recording(tmp_path / "run/episodes/episode_000000.mcap") as recording:
        table = recording.table()
        features = {feature.name: feature.names for feature in recording.info.features}
        assert list(features["observation.state"]) == [label for part in layout.state for label in part.names]
        action = layout.action or layout.state
        assert list(features["action"]) == [label for part in action for label in part.names]
        times = table.time_ns.tolist()
        assert len(times) >= 30
        for row, time_ns in enumerate(times):
            state = table.features["observation.state"]
            assert state[row].tolist() == _expected(notes, layout.state, time_ns)
            if layout.action:
                assert table.features["action"][row].tolist() == _expected(notes, layout.action, time_ns)
            elif row:
                assert np.array_equal(table.features["action"][row - 1], state[row])
        assert len(recording.info.cameras) == layout.cameras
        for camera in recording.info.cameras:
            stamps = {note.header_ns for note in notes if note.topic == camera.source and note.header_ns <= times[-1]}
            assert set(table.image_stamps[camera.name].tolist()) == stamps


def test_an_unrecognised_arm_is_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A gripper alone is not the state of an arm. Unrecognised topics are listed with their types."""
    moments = bags.times(50, 1.0)
    notes = bags.joints("/franka_gripper/joint_states", bags.FRANKA_FINGERS, moments)
    notes += [
        bags.Note(topic="/tf", type="tf2_msgs/msg/TFMessage", log_ns=moment, header_ns=moment,
                  body={"transforms": [{"child_frame_id": "tool0"}]})
        for moment in moments
    ]  # fmt: skip
    bag = bags.write_mcap(bags.in_order(notes), tmp_path / "bag.mcap")
    assert exit_code("import", "--suggest", bag) == 0
    text, warned = capsys.readouterr()
    assert warned.startswith("No topic was recognised as the state of an arm")
    assert f"# ATTENTION: {warned}" in text
    assert "#   /tf  tf2_msgs/msg/TFMessage, 50.0 Hz, 50 messages" in text
    assert "#   /franka_gripper/joint_states  sensor_msgs/msg/JointState, 50.0 Hz, 50 messages" in text
    assert "observation.state" not in tomllib.loads(text)["features"]
    mapping = tmp_path / "robot.toml"
    mapping.write_text(text)
    assert exit_code("import", bag, "--mapping", mapping, "--out", tmp_path / "run") == 2
    assert "missing feature 'observation.state'" in capsys.readouterr().err


def test_joints_that_stop_sending_are_a_finding(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    late, lost = bags.EPOCH_NS + 7 * bags.NS // 10, "robotiq_85_left_knuckle_joint"
    notes = [
        note
        for note in LAYOUTS["Foxglove's own messages"].notes()
        if note.topic != "/joint_states" or note.header_ns < late or lost not in note.body["name"]
    ]
    bag = bags.write_mcap(notes, tmp_path / "bag.mcap")
    assert exit_code("import", "--suggest", bag) == 0
    mapping = tmp_path / "robot.toml"
    mapping.write_text(capsys.readouterr().out)
    assert exit_code("import", bag, "--mapping", mapping, "--out", tmp_path / "run") == 0
    told = capsys.readouterr().out
    assert f"early_end: observation.state ({lost}): /joint_states: ends " in told
    assert "No findings." not in told
