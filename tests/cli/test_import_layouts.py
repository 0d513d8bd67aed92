"""What `demorec import --suggest` makes of other people's robots, and what an import by it has, unedited."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from support import bags
from support.commands import exit_code
from support.layout_topics import Layout, Part
from support.layouts import LAYOUTS, UR

from demorec.mcap import Recording


def _expected(notes: bags.Notes, parts: Sequence[Part], time_ns: int, layout: Layout) -> list[float]:
    """The last numbers of each part at or before a time, by headers where a topic has them."""
    row: list[float] = []
    for part in parts:
        known = [
            (note.header_ns or note.log_ns - layout.clock_ns, numbers)
            for note in notes
            if note.topic == part.topic and (numbers := part.numbers(note.body)) is not None
        ]
        row += [
            float(number) for number in max((pair for pair in known if pair[0] <= time_ns), key=lambda pair: pair[0])[1]
        ]
    return row


@pytest.mark.parametrize("name", sorted(LAYOUTS))
def test_a_suggestion_is_right_unedited_or_refused(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    layout = LAYOUTS[name]
    notes = layout.notes()
    bag = layout.write(notes, tmp_path)
    assert exit_code("import", "--suggest", bag) == 0
    text, warned = capsys.readouterr()
    mapping = tmp_path / "robot.toml"
    mapping.write_text(text)
    code = exit_code("import", bag, "--mapping", mapping, "--out", tmp_path / "run")
    if layout.unsure:
        assert "The arm is left out" in warned
        assert "# ATTENTION: The arm is left out" in text
        assert code != 0
        assert "observation.state" in capsys.readouterr().err
        mapping.write_text(_uncommented(text, layout.unsure))
        assert exit_code("import", bag, "--mapping", mapping, "--out", tmp_path / "run") == 0
        return
    assert (code, warned) == (0, ""), capsys.readouterr().err
    with Recording(tmp_path / "run/episodes/episode_000000.mcap") as recording:
        columns = recording.columns()
        features = {feature.name: feature.names for feature in recording.info.features}
        assert list(features["observation.state"]) == [label for part in layout.state for label in part.names]
        action = layout.action or layout.state
        assert list(features["action"]) == [label for part in action for label in part.names]
        times = columns.time_ns.tolist()
        assert len(times) >= 30
        for row, time_ns in enumerate(times):
            state = columns.features["observation.state"]
            assert state[row].tolist() == _expected(notes, layout.state, time_ns, layout)
            if layout.action:
                assert columns.features["action"][row].tolist() == _expected(notes, layout.action, time_ns, layout)
            elif row:
                assert np.array_equal(columns.features["action"][row - 1], state[row])
        assert len(recording.info.cameras) == layout.cameras
        for camera in recording.info.cameras:
            topic = camera.source.partition(",")[0]
            stamps = {note.header_ns for note in notes if note.topic == topic and note.header_ns <= times[-1]}
            assert set(columns.image_stamps[camera.name].tolist()) == stamps


def _uncommented(text: str, field: str) -> str:
    """The mapping with the comment signs of the source that has a field removed."""
    blocks = text.split("\n\n")
    (block,) = [block for block in blocks if f'field = "{field}"' in block]
    plain = block.replace("# [[", "[[").replace("\n# ", "\n")
    return text.replace(block, plain)


def test_the_fault_of_a_gripper_alone_is_loud(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A bag whose arm nobody recorded: its gripper is no state of an arm."""
    notes = [note for note in LAYOUTS["Franka"].notes() if "robot_state" not in note.topic]
    bag = bags.write_mcap(notes, tmp_path / "bag.mcap")
    assert exit_code("import", "--suggest", bag) == 0
    text, warned = capsys.readouterr()
    assert "The arm is left out: the only joints that are known to be measured are a gripper's (fr3_finger" in warned
    assert "observation.state" not in tomllib.loads(text).get("features", {})
    mapping = tmp_path / "robot.toml"
    mapping.write_text(text)
    assert exit_code("import", bag, "--mapping", mapping, "--out", tmp_path / "run") != 0


@pytest.mark.parametrize("way", ["its publisher ends", "messages name fewer"])
def test_a_joint_that_stops_coming_is_a_finding(way: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    notes = LAYOUTS["two publishers"].notes()
    late = bags.EPOCH_NS + bags.NS
    arm, grip = UR[-1], "robotiq_85_left_knuckle_joint"
    lost = grip if way == "its publisher ends" else arm

    def without(note: bags.Note) -> bags.Note | None:
        if note.topic != "/joint_states" or note.header_ns < late or lost not in note.body["name"]:
            return note
        left = [k for k, name in enumerate(note.body["name"]) if name != lost]
        names, position = note.body["name"], note.body["position"]
        return bags.with_body(note, name=[names[k] for k in left], position=position[left]) if left else None

    bag = bags.write_mcap([left for note in notes if (left := without(note)) is not None], tmp_path / "bag.mcap")
    assert exit_code("import", "--suggest", bag) == 0
    mapping = tmp_path / "robot.toml"
    mapping.write_text(capsys.readouterr().out)
    assert exit_code("import", bag, "--mapping", mapping, "--out", tmp_path / "run") == 0
    told = capsys.readouterr().out
    assert f"early_end: observation.state ({lost}): /joint_states: '{lost}' stop" in told
    assert "Nothing odd was found." not in told
