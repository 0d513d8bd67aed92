"""The gripper alone defines the meaning of an opening: in both directions, in files, and for all callers."""

from __future__ import annotations

import json

import pytest
from support.recording import PANDA

from demorec.core.plain import from_json, from_plain, to_json, to_plain
from demorec.core.tables import ROBOTS
from demorec.robots.robot import RobotSpec


@pytest.mark.parametrize(("name", "has"), [("panda", {"max_width": 0.08}), ("so101", {"open_width": 0.034})])
def test_each_kind_of_gripper_is_read_as_it_was_written(name: str, has: dict[str, float]) -> None:
    robot = ROBOTS.load(name)
    plain = json.loads(to_json(robot))["gripper"]
    assert {key: plain[key] for key in has} == has
    assert from_json(to_json(robot), RobotSpec) == robot


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"force": "strong"}, "'strong' is not a number"),
        ({"force": None}, "is not a number"),
        ({"max_widht": 0.1}, "extra fields found"),
    ],
)
def test_an_inconsistent_gripper_is_refused(change: dict[str, object], words: str) -> None:
    plain = to_plain(PANDA)
    with pytest.raises(ValueError, match=words):
        from_plain(plain | {"gripper": plain["gripper"] | change}, RobotSpec)
    del plain["gripper"]["finger_links"]
    with pytest.raises(ValueError, match="required field missing"):
        from_plain(plain, RobotSpec)
