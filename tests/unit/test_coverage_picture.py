"""The coverage picture: axes with round numbers and units."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image, ImageDraw
from support.recording import make_episode

from demorec.check.coverage import draw_coverage, ticks
from demorec.core.geometry import Pose


@given(st.floats(-5, 5), st.floats(1e-3, 10))
def test_ticks_are_round_numbers_within_the_range(low: float, width: float) -> None:
    found = ticks(low, low + width)
    assert 3 <= len(found) <= 9
    assert low - 1e-9 <= min(found) <= max(found) <= low + width + 1e-9
    step = np.diff(found).mean()
    assert np.allclose(np.array(found) / step, np.round(np.array(found) / step), atol=1e-4)
    assert f"{step:.3e}"[0] in "125"


def test_every_axis_is_labelled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    info, _, _ = make_episode(num_frames=1)
    random = np.random.default_rng(0)
    infos = []
    for _ in range(20):
        x, y = random.uniform(0.3, 0.6), random.uniform(-0.2, 0.2)
        bodies = [
            replace(body, world_from_body=Pose.from_yaw((x, y, 0.02), x)) if body.name == "cube" else body
            for body in info.scene.bodies
        ]
        infos.append(replace(info, scene=replace(info.scene, bodies=tuple(bodies))))
    written: list[str] = []
    write = ImageDraw.ImageDraw.text

    def text(self: ImageDraw.ImageDraw, xy: Any, text: str, *args: Any, **options: Any) -> None:
        written.append(text)
        write(self, xy, text, *args, **options)

    monkeypatch.setattr(ImageDraw.ImageDraw, "text", text)
    draw_coverage(infos, tmp_path / "c.png")
    for label in (
        "x (m)",
        "y (m)",
        "0.4",
        "-0.1",
        "object x (m)",
        "object y (m)",
        "object yaw (rad)",
        "episodes per bin",
        "20 episodes from above, the robot below: starts (dots), goals (rings)",
    ):
        assert label in written
    assert np.asarray(Image.open(tmp_path / "c.png")).std() > 1


def test_without_histograms_there_is_no_empty_half(tmp_path: Path) -> None:
    info, _, _ = make_episode(num_frames=1)
    draw_coverage([info] * 4, tmp_path / "c.png")  # too few values for a histogram
    with Image.open(tmp_path / "c.png") as image:
        drawn = np.array(image.convert("L")) < 255
    right = int(np.flatnonzero(drawn.any(axis=0)).max())
    assert right > 0.85 * drawn.shape[1]
