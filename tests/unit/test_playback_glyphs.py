from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest
import rerun as rr
from support.external import make_external, write_external
from support.recording import make_episode
from support.viewer import need_vulkan

from demorec.cli import run_command
from demorec.cli.view import View
from demorec.core.errors import DemorecError, RecordingError
from demorec.mcap import EpisodeWriter
from demorec.robots.urdf import Urdf
from demorec.view.glyphs import DRAWABLE, drawable_source
from demorec.view.layout import episode_layout
from demorec.view.scene import log_episode, new_recording, summary
from demorec.view.sources import find_episodes
from demorec.view.viewer import HeadlessViewer, why_it_ended

INSTRUCTION = "把红色方块放到绿色托盘里"


@pytest.fixture(scope="module")
def foreign(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A failed episode whose instruction, object, camera, phases and event are Chinese."""
    info, frames, outcome = make_episode(num_frames=10, cameras=("front",), success=False)
    scene = info.scene
    cube, camera = scene.goals[0].object, scene.cameras[0]
    scene = replace(
        scene,
        bodies=tuple(replace(body, name="方块" if body.name == cube else body.name) for body in scene.bodies),
        goals=tuple(replace(goal, object="方块") for goal in scene.goals),
        cameras=(replace(camera, name="前"),),
    )
    path = tmp_path_factory.mktemp("运行") / "episode_000000.mcap"
    with EpisodeWriter(path, replace(info, instruction=INSTRUCTION).with_simulation(scene=scene)) as writer:
        for frame in frames:
            seen = frame.observation
            poses = {("方块" if name == cube else name): pose for name, pose in seen.object_poses.items()}
            writer.write(
                replace(
                    frame,
                    observation=replace(seen, object_poses=poses),
                    images={"前": frame.images[camera.name]},
                    phase="抬起" if frame.frame_index < 5 else "放下",
                )
            )
        writer.finish(outcome)
    return path


def test_all_text_of_a_layout_is_drawable(foreign: Path) -> None:
    (source,) = find_episodes([foreign])
    missing: set[str] = set()
    with drawable_source(source, missing).open() as episode:
        assert episode.scene is not None
        written = [
            summary(episode),
            episode.name,
            episode.group,
            *episode.phase,
            *(body.name for body in episode.scene.bodies),
            *episode.videos,
            *episode.object_poses,
        ]
        recording = new_recording(episode)
        log_episode(recording, episode)  # bodies, goals, cameras and poses still belong together
        episode_layout(episode)
        assert episode.info.instruction == "".join(f"U+{ord(character):X}" for character in INSTRUCTION)
        assert set(episode.phase) == {"U+62ACU+8D77", "U+653EU+4E0B"}
        assert "U+65B9U+5757" in episode.object_poses
        assert [camera.name for camera in episode.scene.cameras] == list(episode.videos) == ["U+524D"]
    assert re.fullmatch(f"[{DRAWABLE}]*", "".join(written))
    assert set(INSTRUCTION) <= missing
    with source.open() as episode:  # the source itself is as it was
        assert episode.info.instruction == INSTRUCTION


def test_joints_of_a_robot_without_a_scene_still_belong_together(tmp_path: Path) -> None:
    path = tmp_path / "episode_000000.mcap"
    given = make_external()
    joint = next(iter(Urdf.parse(given.info.urdf).joints)).name
    features = tuple(
        replace(f, joints=tuple("关节" if j == joint else j for j in f.joints)) for f in given.info.features
    )
    info = replace(
        given.info, urdf=given.info.urdf.replace(f'"{joint}"', '"关节"'), features=features, robot_name="机器人"
    )
    write_external(path, replace(given, info=info))
    (source,) = find_episodes([path])
    missing: set[str] = set()
    with drawable_source(source, missing).open() as episode:
        assert episode.info.simulation is None
        assert missing == set("关节机器人")
        assert "U+5173U+8282" in episode.joint_position
        assert "U+5173U+8282" in {found.name for found in Urdf.parse(str(episode.robot_description)).joints}
        log_episode(new_recording(episode), episode)


@pytest.mark.slow
@pytest.mark.viewer
def test_the_viewer_draws_every_drawable_character(tmp_path: Path) -> None:
    need_vulkan()
    characters = [chr(code) for code in range(0x3000) if re.fullmatch(f"[{DRAWABLE}]", chr(code))]
    assert len(characters) > 400
    recording = rr.RecordingStream("glyphs")
    recording.save(tmp_path / "x.rrd")
    shown = "".join(characters).replace("\t", "").replace("\n", "")
    # As running text, as code (the font of numbers), as a log entry and as a state.
    recording.set_time("time", duration=0.0)
    recording.log("text", rr.TextDocument(shown))
    recording.log("code", rr.TextDocument(f"```\n{shown}\n```", media_type="text/markdown"))
    recording.log("log", rr.TextLog(shown))
    recording.log("state", rr.StateChange(state=shown))
    recording.disconnect()
    with HeadlessViewer(tmp_path / "x.rrd") as viewer:
        viewer.seek(0.0)
        viewer.save_image(tmp_path / "x.png")
        assert len(viewer.client.get_state().views) >= 3  # text, log and states
    assert (tmp_path / "x.png").stat().st_size > 10_000


@pytest.mark.viewer
def test_a_character_without_a_glyph_is_named(tmp_path: Path) -> None:
    need_vulkan()
    recording = rr.RecordingStream("glyphs")
    recording.save(tmp_path / "x.rrd")
    recording.log("text", rr.TextDocument("一"), static=True)
    recording.disconnect()
    with pytest.raises(RecordingError, match=r"cannot draw '一' \(U\+4E00\)"), HeadlessViewer(tmp_path / "x.rrd") as v:
        v.save_image(tmp_path / "x.png")


@pytest.mark.slow
@pytest.mark.viewer
def test_a_failed_episode_with_a_chinese_instruction_is_photographed(
    foreign: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    need_vulkan()
    target = tmp_path / "x.png"
    assert run_command(View, [str(foreign), "--screenshot", str(target)], prog="demorec view") == 0
    assert target.stat().st_size > 10_000
    assert "has no font" in capsys.readouterr().err


NO_DRIVER = """libEGL warning: MESA-LOADER: failed to open swrast
thread 'main' panicked at 'Failed to create render state: CustomNativeAdapterSelectionError("No adapter found")'
egui_kittest-0.37.0/src/wgpu.rs:77
"""
NO_VULKAN = """WARN egui_wgpu: Software rasterizer detected. backend: Gl
thread 'main' panicked at 'Failed to get render context'
re_viewer/src/app/mod.rs:1425
"""
OTHER = """WARN Vulkan: adapter llvmpipe
thread 'main' panicked at 'index out of bounds'
  13: table<core::iter::adapters::enumerate::Enumerate>
"""


@pytest.mark.parametrize(
    ("said", "words", "is_driver"),
    [
        (NO_DRIVER, "mesa-vulkan-drivers", True),
        (NO_VULKAN, "mesa-vulkan-drivers", True),
        (OTHER, "ended by itself: index out of bounds", False),
        ("error: the port is taken\n", "ended by itself: error: the port is taken", False),
    ],
)
def test_a_driver_is_missed_only_when_the_viewer_says_so(said: str, words: str, is_driver: bool) -> None:
    error = why_it_ended(said)
    assert isinstance(error, DemorecError)
    assert words in str(error)
    assert ("mesa-vulkan-drivers" in str(error)) == is_driver
