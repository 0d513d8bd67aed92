"""The examples of docs/tasks.md work as printed, for somebody outside of this repository."""

from __future__ import annotations

import math
import re
from pathlib import Path

import pytest
from support.check import checked, simulate

from demorec.config import EpisodePlan, GenerateConfig
from demorec.loop import ScriptAgent, Session, make_world, prepare
from demorec.recording import Recording
from demorec.replay import ReplayOptions, open_file, replay_all
from demorec.tables import ROBOTS

EXAMPLE = Path(__file__).parents[2] / "docs" / "tasks.md"


def test_the_documented_task_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = re.search(r"```python\n(.*?)```", EXAMPLE.read_text(), re.DOTALL)
    assert source is not None
    assert source[1].count("\n") <= 80
    (tmp_path / "my_tasks.py").write_text(source[1])
    monkeypatch.syspath_prepend(str(tmp_path))
    config = GenerateConfig(task="my_tasks:ToTheLeft", cameras=(), seed=3)
    config.validate()
    episode = prepare(EpisodePlan(config=config, episode_index=0))
    start = episode.info.scene.movable[0].world_from_body.position
    with make_world(episode.info) as world:
        session = Session.of_episode(world, episode)
        frames = list(session.run(ScriptAgent(episode)))
    assert session.outcome.success, session.outcome
    end = frames[-1].observation.object_poses[episode.info.scene.movable[0].name].position
    assert end[1] - start[1] == pytest.approx(0.15, abs=0.02)
    assert end[0] - start[0] == pytest.approx(0.0, abs=0.02)


def test_the_documented_script_pushes_on_every_robot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = re.findall(r"```python\n(.*?)```", EXAMPLE.read_text(), re.DOTALL)[1]
    assert source == (EXAMPLE.parents[1] / "examples" / "own_script" / "my_tasks.py").read_text()
    (tmp_path / "my_pushing_tasks.py").write_text(source)
    monkeypatch.syspath_prepend(str(tmp_path))
    for robot in ROBOTS.names():
        path = simulate(tmp_path / f"{robot}.mcap", task="my_pushing_tasks:PushToMark", robot=robot, seed=3)
        with Recording(path) as recording:
            columns, outcome, scene = recording.columns(), recording.outcome, recording.info.scene
        assert outcome is not None
        assert outcome.success, outcome
        assert list(dict.fromkeys(columns.phase)) == ["open", "approach", "descend", "push", "retreat"]
        start, end = columns.object_poses["red_cube"][0], columns.object_poses["red_cube"][-1]
        assert 0.09 < math.dist(start[:2], end[:2]) < 0.16
        assert columns.object_poses["red_cube"][:, 2].max() < start[2] + 0.005  # pushed, not carried
        assert math.dist(end[:2], scene.goals[0].onto_from_goal.position[:2]) < 0.02
        options = ReplayOptions(allowed=("my_pushing_tasks",))
        ((report, _),) = replay_all([open_file(path, options)], options)
        assert report.is_identical
        assert checked(path).level != "fail"
