"""One dataset that contains all tasks."""

from __future__ import annotations

import importlib
from pathlib import Path

import numpy as np
import pytest
from support.check import checked, simulate_run
from support.commands import exit_code

from demorec.core.tables import TASKS
from demorec.mcap import Recording


@pytest.mark.slow
@pytest.mark.long
def test_all_tasks_go_into_one_dataset(tmp_path: Path) -> None:
    runs = [
        simulate_run(tmp_path / task, 1, task=task, seed=31, cameras=("front",), width=128, height=128)
        for task in TASKS.names()
    ]
    out = tmp_path / "all"
    assert exit_code("export", "lerobot", *runs, "--out", out, "--no-verify") == 0

    lerobot = importlib.import_module("lerobot.datasets.lerobot_dataset")
    dataset = lerobot.LeRobotDataset("local/all", root=out)
    assert dataset.num_episodes == len(runs) == len(TASKS.names())
    row = 0
    for run in runs:
        (path,) = (run / "episodes").glob("*.mcap")
        with Recording(path) as recording:
            trajectory, instruction = recording.trajectory(), recording.info.instruction
        item = dataset[row]
        assert item["task"] == instruction
        expected = np.array([*trajectory.joint_position[0, :7], trajectory.gripper_width[0]], np.float32)
        assert np.array_equal(item["observation.state"].numpy(), expected)
        row += len(trajectory.time_ns)
    assert row == dataset.num_frames
    assert len(dataset.meta.tasks) == len({dataset[i]["task"] for i in dataset.meta.episodes["dataset_from_index"]})

    assert [r for r in checked(out, "dataset").results if r.verdict in ("look", "broken")] == []
