"""Limits that a dataset's states are held to, on episodes of a robot that was scaled."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from support.recording import PANDA, make_episode

from demorec.check.base import Measurement
from demorec.check.dataset import DescribedEpisode
from demorec.check.dataset_motion import dataset_joint_limits
from demorec.scene.features import STATE


@pytest.mark.parametrize(("width", "beyond"), [(0.104, 0.0), (0.120, 0.016)])
def test_the_opening_of_a_scaled_gripper_is_scaled_once(width: float, beyond: float) -> None:
    """A Panda opens by 0.08 m; at 1.3 times the size, as in the tutorial, by 0.104 m."""
    info, *_ = make_episode(num_frames=2)
    placement = replace(info.scene.robot, scale=1.3)
    info = replace(info, robot=PANDA.scaled(1.3), scene=replace(info.scene, robot=placement))
    state = np.array([[*PANDA.home_q, width]], dtype=np.float32)
    episode = DescribedEpisode(number=0, rows={STATE: state}, kept={}, info=info)
    found = dataset_joint_limits.measure(SimpleNamespace(described=lambda: [episode]))
    assert isinstance(found, Measurement)
    assert found.value == pytest.approx(beyond, abs=1e-6)
