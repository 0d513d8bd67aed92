"""The contracts of `demorec.testing` find each fault, and the documented ways to use them work."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from demorec.core.tables import ROBOTS
from demorec.robots.robot import RobotSpec
from demorec.testing import RobotContract, TaskContract

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs" / "tasks.md"
WORDS = TaskContract.test_scenes_and_words_follow_from_the_plan_alone
DESCRIPTION = TaskContract.test_scenes_come_back_from_their_description


@pytest.mark.parametrize(
    ("task", "test", "words"),
    [
        ("NeverTheSame", WORDS, "drawn again"),
        ("AlwaysTheSame", WORDS, "the same scene"),
        ("Wordless", DESCRIPTION, "no instruction"),
        ("Aimless", DESCRIPTION, "no goal"),
        ("Crowded", TaskContract.test_objects_stand_apart, "red_cube and another_cube"),
        ("OutOfReach", TaskContract.test_objects_and_goals_are_within_reach, "the goal of red_cube"),
        ("DoneAlready", TaskContract.test_doing_nothing_is_a_failure, "done before anything has moved"),
        ("Idle", TaskContract.test_the_expert_succeeds, "0% of 1 episodes succeed; 0: distance_to_goal"),
        ("Moody", TaskContract.test_an_episode_repeats_to_the_bit, "run again"),
        ("Hasty", TaskContract.test_commands_stay_within_the_limits_of_the_robot, "panda_joint1 is sent too fast"),
    ],
)
def test_each_fault_is_found(task: str, test: Callable[[TaskContract], None], words: str) -> None:
    class Contract(TaskContract):
        num_episodes = 1
        num_layouts = 2

    Contract.task = f"support.odd_tasks:{task}"
    with pytest.raises(AssertionError, match=words):
        test(Contract())


@pytest.mark.slow
def test_the_documented_three_lines_test_the_documented_task(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    blocks = re.findall(r"```python\n(.*?)```", DOCS.read_text(), re.DOTALL)
    (tmp_path / "my_tested_tasks.py").write_text(blocks[0])
    monkeypatch.syspath_prepend(str(tmp_path))
    found: dict[str, type[TaskContract]] = {}
    exec(compile(blocks[-1].replace("left_tasks:", "my_tested_tasks:"), "test_left_tasks.py", "exec"), found)
    contract = found["TestToTheLeft"]
    contract.num_episodes = 2
    tests = [name for name in dir(contract) if name.startswith("test_")]
    assert len(tests) == 9
    for name in tests:
        test = getattr(contract(), name)
        test(tmp_path) if "recording" in name else test()


SPEC = RobotContract.test_the_spec_names_what_the_urdf_has
REACH = RobotContract.test_the_workspace_is_within_reach
HOME = RobotContract.test_home_points_the_hand_down_with_the_fingers_across


@pytest.mark.parametrize(
    ("change", "test", "words"),
    [
        ({"position_upper": (9.0,) * 7}, SPEC, "the limits of panda_joint1 are -2.8973 to 9 rad"),
        ({"home_q": (0.0, 0.0, 0.0, -1.0, 0.0, 1.0, 0.0)}, HOME, "at home_q is turned"),
        ({"home_q": (0.5, -0.785, 0.0, -2.356, 0.0, 1.571, 1.285)}, HOME, "to the side"),
        ({"position_upper": (2.8, -0.5, 2.8, -0.1, 2.8, 3.7, 2.8)}, REACH, "out of reach"),
    ],
)
def test_each_fault_of_a_robot_is_found(
    change: dict[str, Any], test: Callable[[RobotContract], None], words: str
) -> None:
    class Contract(RobotContract):
        def _spec(self) -> RobotSpec:
            return replace(ROBOTS.load("panda"), **change)

    with pytest.raises(AssertionError, match=words):
        test(Contract())


def test_a_robot_has_as_many_numbers_as_joints_and_limits_above_zero() -> None:
    panda: RobotSpec = ROBOTS.load("panda")
    with pytest.raises(ValueError, match="velocity_limit has 2 numbers for 7 arm joints"):
        replace(panda, velocity_limit=(1.0, 2.0))
    with pytest.raises(ValueError, match="torque_limit has numbers that are not above 0"):
        replace(panda, torque_limit=(0.0,) * 7)
    with pytest.raises(ValueError, match="velocity_limit has numbers that are not above 0"):
        replace(panda, velocity_limit=(float("nan"),) * 7)
