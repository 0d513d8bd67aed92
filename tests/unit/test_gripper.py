"""What an opening means is told by the gripper alone: to and fro, in files, and by everybody who asks."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from mcap.reader import make_reader
from support.recording import PANDA

from demorec.core.plain import from_json, from_plain, to_json, to_plain
from demorec.core.tables import ROBOTS
from demorec.episode.info import EpisodeInfo
from demorec.robots.robot import RobotSpec

SAMPLES = Path(__file__).parents[2] / "recordings" / "sample"


@pytest.mark.parametrize("version", [1, 2])
def test_files_of_every_version_hold_the_gripper_among_the_robots_keys(version: int) -> None:
    """What another reader finds in the file is what is written today, byte for byte."""
    with (SAMPLES / f"format_{version}.mcap").open("rb") as file:
        text = next(m.metadata["info"] for m in make_reader(file).iter_metadata() if m.name == "demorec.episode")
    recorded = json.loads(text)["robot"]
    assert recorded["gripper_joints"] == ["panda_finger_joint1", "panda_finger_joint2"]
    info = from_json(text, EpisodeInfo)
    assert info.robot.gripper.max_width == recorded["gripper_max_width"] == 0.08
    assert info.robot.gripper.palm_clearance == recorded["palm_clearance"]
    assert json.loads(to_json(info.robot)) == recorded
    assert json.loads(text)["robot"].keys() == to_plain(ROBOTS.load("iiwa")).keys()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"gripper_force": "strong"}, "'strong' is no number"),
        ({"gripper_force": None}, "is no number"),
        ({"gripper": {}}, "extra fields found"),
        ({"max_width": 0.1}, "extra fields found"),
    ],
)
def test_a_gripper_that_makes_no_sense_is_refused(change: dict[str, object], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        from_plain(to_plain(PANDA) | change, RobotSpec)
    incomplete = to_plain(PANDA)
    del incomplete["finger_links"]
    with pytest.raises(ValueError, match="required field missing"):
        from_plain(incomplete, RobotSpec)
