"""Limits that a dataset's states are held to, on episodes of a robot that was scaled."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from support.check import checked
from support.export import export
from support.recording import PANDA, make_episode

from demorec.mcap import EpisodeWriter


@pytest.mark.parametrize(("width", "beyond"), [(0.104, 0.0), (0.120, 0.016)])
def test_the_opening_of_a_scaled_gripper_is_scaled_once(width: float, beyond: float, tmp_path: Path) -> None:
    """A Panda opens by 0.08 m; at 1.3 times the size, as in the tutorial, by 0.104 m."""
    info, frames, outcome = make_episode(num_frames=5)
    placement = replace(info.scene.robot, scale=1.3)
    info = info.with_simulation(robot=PANDA.scaled(1.3), scene=replace(info.scene, robot=placement))
    with EpisodeWriter(tmp_path / "a.mcap", info) as writer:
        for frame in frames:
            home = replace(frame.observation, gripper_width=width)
            writer.write(replace(frame, observation=home))
        writer.finish(outcome)
    export(tmp_path / "a.mcap", tmp_path / "ds")
    (found,) = checked(tmp_path / "ds", "dataset", only=("joint_limits",), images=False).results
    assert found.value is not None
    assert (found.value if "gripper" in found.detail else 0.0) == pytest.approx(beyond, abs=1e-6)
