"""The turn of a camera's calibration error, found in its images: against the one that was drawn from the seed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.check import simulate

from demorec.check.cells import ImageKind
from demorec.check.episode import CheckedEpisode
from demorec.check.episode_drawn import draw_episode, drawable_world
from demorec.core.config import EpisodePlan, GenerateConfig
from demorec.core.plain import from_plain
from demorec.episode.info import EpisodeInfo
from demorec.loop import prepare


def older(info: EpisodeInfo) -> EpisodeInfo:
    """As recordings were before they told about which axis a camera is turned."""
    behaviour = {name: value for name, value in info.behaviour.items() if name[-3:] not in ("_qx", "_qy", "_qz")}
    assert len(behaviour) < len(info.behaviour)
    return info.with_simulation(behaviour=behaviour)


@pytest.mark.slow
@pytest.mark.parametrize("size", [64, pytest.param(224, marks=pytest.mark.long)])
def test_the_found_turn_is_the_true_one(size: int, tmp_path: Path) -> None:
    cameras = ("front", "wrist")
    path = simulate(tmp_path / "e.mcap", variation="full", seed=31, cameras=cameras, width=size, height=size)
    with CheckedEpisode(path) as episode:
        config = from_plain(episode.info.config, GenerateConfig)
        made = prepare(EpisodePlan(config=config, episode_index=0, attempt=episode.info.attempt))
        colors = {camera.name: episode.images(camera).cells for camera in episode.cameras}
        kinds: dict[str, tuple[ImageKind, ...]] = dict.fromkeys(colors, ("color",))
        info = older(episode.info)
        shift = draw_episode(info, drawable_world(info, episode.columns), kinds, colors, draw_each=False).shift
        for camera in episode.cameras:
            x, y, _, _ = made.true_from_recorded[camera.name].quat_xyzw
            # A camera turned to the right (about y, which is down) by a sees everything farther left by tan(a).
            true = np.array([2 * y, -2 * x]) / (2 * np.tan(camera.fov_y / 2))
            assert np.linalg.norm(true) > 0.002
            assert np.linalg.norm(shift[camera.name] - true) < 0.4 * np.linalg.norm(true)


@pytest.mark.slow
def test_what_is_turned_farther_than_told_stays_so(tmp_path: Path) -> None:
    path = simulate(tmp_path / "e.mcap", variation="full", seed=31, cameras=("front",), width=64, height=64)
    with CheckedEpisode(path) as episode:
        colors = {"front": np.roll(episode.images(episode.cameras[0]).cells, 1, axis=2)}  # one of 32 cells: 1.4 deg
        info = older(episode.info)
        world = drawable_world(info, episode.columns)
        drawn = draw_episode(info, world, {"front": ("color",)}, colors, draw_each=False)
        assert drawn.shift == {}
