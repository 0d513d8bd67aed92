"""Where the checks take a camera to be whose recorded pose is off on purpose."""

from __future__ import annotations

import numpy as np
import pytest

from demorec.check.episode_drawn import drawable_scene
from demorec.core.config import EpisodePlan, GenerateConfig
from demorec.core.geometry import angle_between
from demorec.loop import prepare


@pytest.mark.parametrize("index", range(3))
def test_a_calibration_error_is_taken_back(index: int) -> None:
    episode = prepare(EpisodePlan(config=GenerateConfig(variation="full"), episode_index=index))
    found = drawable_scene(episode.info).cameras
    for true, recorded, camera in zip(episode.cameras, episode.info.scene.cameras, found, strict=True):
        assert angle_between(recorded.mount_from_camera, true.mount_from_camera) > 1e-3
        np.testing.assert_allclose(camera.mount_from_camera.matrix(), true.mount_from_camera.matrix(), atol=1e-14)


@pytest.mark.parametrize("index", range(3))
def test_of_an_older_recording_the_offset_is_taken_back(index: int) -> None:
    episode = prepare(EpisodePlan(config=GenerateConfig(variation="full"), episode_index=index))
    older = {name: value for name, value in episode.info.behaviour.items() if name[-3:] not in ("_qx", "_qy", "_qz")}
    info = episode.info.with_simulation(behaviour=older)
    assert len(older) == len(episode.info.behaviour) - 6
    for true, recorded, found in zip(episode.cameras, info.scene.cameras, drawable_scene(info).cameras, strict=True):
        before, after, truth = recorded.mount_from_camera, found.mount_from_camera, true.mount_from_camera
        offset = float(np.linalg.norm(before.position - truth.position))
        angle = angle_between(before, truth)
        assert offset > 2e-4
        # All but what the unknown rotation turns the offset by.
        assert np.linalg.norm(after.position - truth.position) <= angle * offset + 1e-9
        assert angle_between(after, truth) == pytest.approx(angle)
