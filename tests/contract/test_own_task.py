"""The example of docs/tasks.md works as printed, for somebody outside of this repository."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from demorec.config import EpisodePlan, GenerateConfig
from demorec.rollout import Rollout, make_world, prepare

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
        run = Rollout(world, episode)
        frames = list(run)
    assert run.outcome is not None
    assert run.outcome.success, run.outcome
    end = frames[-1].observation.object_poses[episode.info.scene.movable[0].name].position
    assert end[1] - start[1] == pytest.approx(0.15, abs=0.02)
    assert end[0] - start[0] == pytest.approx(0.0, abs=0.02)
