"""The examples of docs/tasks.md work as printed, for somebody outside of this repository."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from support.check import checked, simulate

from demorec.core.own_versions import source_digest
from demorec.core.tables import ROBOTS
from demorec.mcap import Recording
from demorec.replay import ReplayOptions, open_file, replay_all

EXAMPLE = Path(__file__).parents[2] / "docs" / "tasks.md"


def test_the_documented_script_pushes_on_every_robot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = (EXAMPLE.parents[1] / "examples" / "own_script" / "my_tasks.py").read_text()
    (tmp_path / "my_pushing_tasks.py").write_text(source)
    monkeypatch.syspath_prepend(str(tmp_path))
    for robot in (name for name in ROBOTS.names() if ROBOTS.load(name).task_scale == 1.0):  # its lengths are fixed
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
        assert checked(path).level == "pass"


MODEL_TASK = """
from pathlib import Path
HERE = Path(__file__).parent
MUG = HERE / "models" / "mug.obj"
ARM = "models/arm.urdf"
NAME = "mug.obj"
"""


def test_files_that_a_module_names_are_part_of_its_source(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By name, also through what they name themselves; neighbours are not."""
    models = tmp_path / "models"
    models.mkdir()
    (tmp_path / "my_models.py").write_text(MODEL_TASK)
    (tmp_path / "mug.obj").write_text("mtllib mug.mtl\nv 0 0 0\n")
    (tmp_path / "mug.mtl").write_text("newmtl a\nmap_Kd mug.png\n")
    (models / "arm.urdf").write_text('<robot><mesh filename="link.stl"/></robot>')
    for named in ("mug.png", "models/link.stl", "notes.txt", "models/other.stl"):
        (tmp_path / named).write_text("1")
    monkeypatch.syspath_prepend(str(tmp_path))

    def digest() -> str:
        source_digest.cache_clear()
        return source_digest("my_models")

    before = digest()
    for name in ("notes.txt", "models/other.stl"):
        (tmp_path / name).write_text("2")
        assert digest() == before
    for name in ("my_models.py", "mug.obj", "mug.mtl", "mug.png", "models/arm.urdf", "models/link.stl"):
        path = tmp_path / name
        path.write_text(path.read_text() + "\n")
        assert digest() != before, name
        before = digest()
