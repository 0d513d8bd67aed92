"""`demorec view` with the real viewer and in the browser."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from support.commands import exit_code
from support.recording import make_episode, write_episode
from support.viewer import RerunViewer, chromium, need_chromium, need_vulkan, num_colors, pixels, rerun_viewer

from demorec.core.config import VideoConfig
from demorec.mcap import EpisodeWriter
from demorec.view.scene import save_each
from demorec.view.sources import find_episodes
from demorec.view.viewer import serve_web


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs") / "cubes"
    (folder / "episodes").mkdir(parents=True)
    for index in range(2):
        path = folder / "episodes" / f"episode_{index:06d}.mcap"
        write_episode(path, num_frames=45, width=96, height=72, episode_index=index)
    return folder


@pytest.mark.parametrize(
    ("name", "flags", "words"),
    [
        ("video.mp4", (), "The file is not a recording (.mcap)"),
        ("cut.mcap.part", (), "demorec recover"),
        ("folder", (), "The folder holds no recording"),
        ("runs", (), "it holds runs: name one (cubes)"),
        ("saved.rrd", (), "rerun shows it"),
        ("nothing.mcap", (), "No such file"),
        ("episode.mcap", ("--save", "x.mp4"), "writes a .rrd file"),
        ("episode.mcap", ("--port", "80"), "--port belongs to --web"),
        ("episode.mcap", ("--web", "--save", "x.rrd"), "--web serves"),
        ("episode.mcap", ("--save", "missing/x.rrd"), "folder missing is missing"),
        ("episode.mcap", (), "No screen is available"),
    ],
)
def test_an_impossible_request_is_one_sentence(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    name: str,
    flags: tuple[str, ...],
    words: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    Path("saved.rrd").write_bytes(b"RRF2")
    for file in ("video.mp4", "cut.mcap.part"):
        Path(file).write_bytes(b"0123456789")
    Path("folder").mkdir()
    Path("runs/cubes/episodes").mkdir(parents=True)
    write_episode(Path("episode.mcap"), num_frames=5, cameras=())
    assert exit_code("view", name, *flags) == 2
    said = capsys.readouterr().err
    assert words in said
    assert len(said.strip().splitlines()) == 1


def _check_views(viewer: RerunViewer) -> None:
    """Check that no view reports an error, that the 3D view shows robot, table and frusta, and that each camera shows
    its moving red square.
    """
    assert viewer.reports() == []
    world = viewer.view_image("pick_place: the world")
    assert num_colors(world) > 100
    white = (world.min(axis=2) > 150).mean()
    assert white > 0.005, "no robot"
    for camera in ("front", "wrist"):
        image = viewer.view_image(f"{camera} camera").astype(int)
        red = (image[..., 0] > 150) & (image[..., 1] < 90) & (image[..., 2] < 90)
        assert red.mean() > 0.01, f"no video of {camera}"


@pytest.mark.slow
@pytest.mark.viewer
def test_the_viewer_shows_a_run(run_folder: Path, tmp_path: Path) -> None:
    need_vulkan()
    files = save_each(find_episodes([run_folder]), tmp_path)
    with rerun_viewer(files[0]) as viewer:
        viewer.seek(1.0)
        _check_views(viewer)
        state = viewer.client.get_state()
        assert {recording.current_time for recording in state.recordings} == {1_000_000_000}
        before = viewer.view_image("front camera")
        viewer.seek(0.2)
        after = viewer.view_image("front camera")
    assert before.shape == after.shape
    assert np.abs(before.astype(int) - after).mean() > 1.0, "the video does not move"


@pytest.mark.slow
@pytest.mark.viewer
@pytest.mark.parametrize("codec", [pytest.param("av1", marks=pytest.mark.long), "jpeg"])
def test_the_viewer_shows_the_colours_that_were_recorded(codec: Literal["av1", "jpeg"], tmp_path: Path) -> None:
    """H.264 is left out: Rerun 0.41 assumes BT.709 whatever the stream specifies."""
    need_vulkan()
    colours = np.array([[200, 30, 30], [30, 200, 30], [30, 30, 200], [200, 200, 40]], dtype=np.uint8)
    image = np.repeat(np.repeat(colours[np.newaxis], 80, axis=1), 240, axis=0)
    info, frames, outcome = make_episode(num_frames=30, cameras=("front",), width=320, height=240)
    with EpisodeWriter(tmp_path / "episode_000000.mcap", info, video=VideoConfig(codec=codec)) as writer:
        for frame in frames:
            writer.write(replace(frame, images={"front": replace(frame.images["front"], color=image)}))
        writer.finish(outcome)
    with rerun_viewer(save_each(find_episodes([tmp_path]), tmp_path)[0]) as viewer:
        viewer.seek(0.5)
        shown = viewer.view_image("front camera")
    height, width = shown.shape[:2]
    np.testing.assert_allclose(shown[height // 2, width // 8 :: width // 4][:4], colours, atol=4)


@pytest.mark.slow
@pytest.mark.long  # the web viewer needs a minute to draw with a software rasteriser
@pytest.mark.viewer
def test_the_browser_shows_an_episode(run_folder: Path, tmp_path: Path) -> None:
    program = need_chromium()
    files = save_each(find_episodes([run_folder])[:1], tmp_path)
    with serve_web(files) as (address, _), chromium(program, address) as page:
        assert address.startswith("http://127.0.0.1:")
        deadline = time.monotonic() + 150
        colors, red = 0, 0.0
        while time.monotonic() < deadline and (colors < 200 or red < 0.002):
            time.sleep(2)
            image = pixels(page.image()).astype(int)
            colors = num_colors(image.astype(np.uint8))
            red = float(((image[..., 0] > 150) & (image[..., 1] < 90) & (image[..., 2] < 90)).mean())
    assert colors >= 200, "the page is empty"
    assert red >= 0.002, "neither the cube nor the videos are there"
