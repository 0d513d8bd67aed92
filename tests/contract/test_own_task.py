"""The examples of docs/tasks.md work as printed, outside of this repository."""

from __future__ import annotations

import inspect
import math
from pathlib import Path

import pytest
from support.check import checked, simulate

from demorec.core.tables import ROBOTS
from demorec.extensions.remake.drive import replay_all
from demorec.mcap import Recording
from demorec.tasks.success import at_least, at_most, gripper_open_check, placement_checks
from demorec.testing import TaskContract

EXAMPLE = Path(__file__).parents[2] / "docs" / "tasks.md"


def test_the_page_names_every_argument_of_the_contract_and_of_checks() -> None:
    page = EXAMPLE.read_text()
    assert all(f"`{name}`" in page for name in TaskContract.__annotations__ if name != "task")
    for function in (at_most, at_least, placement_checks, gripper_open_check):
        assert f"`{function.__name__}({', '.join(inspect.signature(function).parameters)})`" in page
    assert all(f"`{name}(" in page for name in ("touches_robot", "touches", "grip_force", "finger_forces"))


@pytest.mark.slow
def test_the_documented_script_pushes_on_every_robot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = (EXAMPLE.parents[1] / "examples" / "own_script" / "my_tasks.py").read_text()
    (tmp_path / "my_pushing_tasks.py").write_text(source)
    monkeypatch.syspath_prepend(str(tmp_path))
    for robot in (name for name in ROBOTS.names() if ROBOTS.load(name).task_scale == 1.0):  # its lengths are fixed
        path = simulate(tmp_path / f"{robot}.mcap", task="my_pushing_tasks:PushToMark", robot=robot, seed=3)
        with Recording(path) as recording:
            trajectory, outcome, scene = recording.trajectory(), recording.outcome, recording.info.simulated.scene
            (report,) = replay_all([recording], ("my_pushing_tasks",))
        assert outcome is not None
        assert outcome.success, outcome
        assert list(dict.fromkeys(trajectory.phase)) == ["open", "approach", "descend", "push", "retreat"]
        start, end = trajectory.object_poses["red_cube"][0], trajectory.object_poses["red_cube"][-1]
        assert 0.09 < math.dist(start[:2], end[:2]) < 0.16
        assert trajectory.object_poses["red_cube"][:, 2].max() < start[2] + 0.005  # pushed, not carried
        assert math.dist(end[:2], scene.goals[0].onto_from_goal.position[:2]) < 0.02
        assert report.is_identical
        assert checked(path).verdict == "good"
