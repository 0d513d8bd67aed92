"""Every task in the table meets the contract that `demorec.testing` has for all tasks; and properties of some tasks."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

from demorec.core.config import EpisodePlan, GenerateConfig
from demorec.core.errors import ConfigError
from demorec.core.tables import TASKS
from demorec.loop import prepare
from demorec.testing import TaskContract


def plan(task: str, index: int = 0, **options: object) -> EpisodePlan:
    config = replace(GenerateConfig(task=task, cameras=(), seed=11), **options)  # type: ignore[arg-type]
    return EpisodePlan(config=config, episode_index=index)


@pytest.mark.parametrize("task", TASKS.names(), scope="class")
class TestEveryTask(TaskContract):
    seed = 11
    num_episodes: ClassVar[int] = 1  # benchmarks/success.py makes thousands
    min_success: ClassVar[float] = 1.0

    @pytest.fixture(autouse=True, scope="class")
    @classmethod
    def _row(cls, task: str) -> None:
        cls.task = task

    # The test below makes the recording again; `test_loop.py` has a quick one.
    test_an_episode_repeats_to_the_bit = None  # type: ignore[assignment]

    # `test_check_recordings.py` and `test_replay.py` have quick ones.
    @pytest.mark.slow
    def test_its_recording_passes_every_check_and_is_made_again_to_the_bit(self, tmp_path: Path) -> None:
        super().test_its_recording_passes_every_check_and_is_made_again_to_the_bit(tmp_path)


@pytest.mark.slow
def test_instructions_come_in_several_wordings() -> None:
    for task in TASKS.names():
        words = {prepare(plan(task, index)).info.instruction for index in range(40)}
        assert len(words) >= 2, task


def test_a_fixed_layout_is_exact_and_refused_elsewhere() -> None:
    scenes = [prepare(plan("tutorial", index, fixed=True, variation="none")).info.simulated.scene for index in range(3)]
    assert scenes[0] == scenes[1] == scenes[2]
    cube = scenes[0].body("red_cube").world_from_body
    np.testing.assert_allclose(cube.position, [1.0, 1.0, 0.1], atol=1e-12)
    assert scenes[0].robot.scale == 1.3
    with pytest.raises(ConfigError, match="no fixed layout"):
        prepare(plan("stack", fixed=True))
