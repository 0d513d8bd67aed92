from __future__ import annotations

import os
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rerun.chunk import RrdReader
from support.recording import make_episode, write_episode

from demorec.core.geometry import Pose
from demorec.episode.scene import Body, Shape
from demorec.episode.simulated import with_simulation
from demorec.mcap import EpisodeWriter, Recording
from demorec.robots import assets
from demorec.robots.assets import asset_path
from demorec.view import bodies
from demorec.view.bodies import robot_model
from demorec.view.scene import save
from demorec.view.sources import find_episodes
from demorec.view.viewer import viewer_environment


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("run") / "episodes" / "episode_000000.mcap"
    path.parent.mkdir()
    return write_episode(path, num_frames=20, depth=True, segmentation=True)


@pytest.fixture(scope="module")
def saved(recording: Path) -> dict[str, list[Any]]:
    target = recording.parent / "x.rrd"
    save(find_episodes([recording])[0], target)
    return _chunks(target)


def _chunks(path: Path) -> dict[str, list[Any]]:
    entities: dict[str, list[Any]] = {}
    for chunk in RrdReader(path).stream():
        entities.setdefault(chunk.entity_path, []).append(chunk)
    return entities


def _column(chunks: list[Any], component: str) -> list[Any]:
    """(time in ns, value) of every row, in order of time."""
    rows: list[tuple[int, Any]] = []
    for chunk in chunks:
        batch = chunk.to_record_batch()
        if component in batch.schema.names and not chunk.is_static:
            times = batch.column("time").cast("int64").to_pylist()
            rows += zip(times, batch.column(component).to_pylist(), strict=True)
    return sorted(rows, key=lambda row: row[0])


def test_joints_are_plotted_at_every_frame(saved: dict[str, list[Any]], recording: Path) -> None:
    with Recording(recording) as source:
        times, count = source.time_ns - source.time_ns[0], len(source.info.simulated.robot.arm_joints)
        positions = source.trajectory().joint_position[:, :count]
    rows = _column(saved["/plots/position"], "Scalars:scalars")
    assert [time for time, _ in rows] == times.tolist()
    np.testing.assert_array_equal([value for _, value in rows], positions)


@pytest.mark.parametrize("camera", ["front", "wrist"])
def test_coded_images_are_passed_on_unchanged(saved: dict[str, list[Any]], recording: Path, camera: str) -> None:
    with Recording(recording) as source:
        packets = list(source.packets(camera))
    rows = _column(saved[f"/world/cameras/{camera}"], "VideoStream:sample")
    assert [(time, bytes(value[0])) for time, value in rows] == [(packet.time_ns, packet.data) for packet in packets]


def test_depth_and_segments_are_shown(saved: dict[str, list[Any]], recording: Path) -> None:
    with Recording(recording) as source:
        metres = next(iter(source.depth("front")))
    _, value = _column(saved["/world/cameras/front/depth"], "DepthImage:buffer")[0]
    millimetres = np.frombuffer(bytes(value[0]), dtype=np.uint16).reshape(metres.shape)
    np.testing.assert_allclose(millimetres / 1000, metres, atol=6e-4)
    assert metres.max() > 0.4
    _, labels = _column(saved["/world/cameras/front/segmentation"], "SegmentationImage:buffer")[0]
    assert len(np.unique(np.frombuffer(bytes(labels[0]), dtype=np.uint16))) == 4  # nothing, table, cube, robot


def test_robot_objects_path_and_goal_are_shown(saved: dict[str, list[Any]]) -> None:
    links = [entity for entity in saved if "/world/robot/" in entity and _has(saved[entity], "Mesh3D:vertex_positions")]
    assert len(links) == 11  # links 0 to 7, hand, two fingers
    assert len(_column(saved["/world/bodies/cube"], "Transform3D:translation")) == 20
    assert len(_column(saved["/world/ee_path"], "LineStrips3D:strips")) == 19
    assert _has(saved["/world/goals/cube"], "Boxes3D:half_sizes")


def _has(chunks: list[Any], component: str) -> bool:
    return any(component in chunk.to_record_batch().schema.names for chunk in chunks)


def test_the_recorded_description_replaces_a_model_with_other_joints(recording: Path) -> None:
    with Recording(recording) as source:
        description = source.description()
    moved = description.replace('xyz="0 0 0.333"', 'xyz="0 0 0.444"')
    assert moved != description
    other = robot_model("franka_panda/panda.urdf", 1.0, moved).urdf  # a different robot from the installed one
    assert next(joint for joint in other.joints if joint.name == "panda_joint1").parent_from_joint.position[2] == 0.444


DUCK = Body(
    name="duck",
    role="object",
    shape=Shape(
        kind="mesh", file="duck.obj", scale=0.04, size=(0.066, 0.046, 0.062), origin=(-0.1344, 0.87, 0.037), y_up=True
    ),
    world_from_body=Pose(position=np.array([0.5, 0.1, 0.031])),
)
BRICK = Body(
    name="brick",
    role="object",
    shape=Shape(kind="urdf", file="lego/lego.urdf", size=(0.032, 0.032, 0.023)),
    world_from_body=Pose(position=np.array([0.5, -0.1, 0.012])),
    rgba=(0.2, 0.4, 1.0, 1.0),
)


@pytest.fixture
def with_models(tmp_path: Path) -> Path:
    """A recording with a mesh and a URDF in addition to the table and the cube."""
    info, frames, outcome = make_episode(num_frames=3, cameras=())
    info = with_simulation(
        info, scene=replace(info.simulated.scene, bodies=(*info.simulated.scene.bodies, DUCK, BRICK))
    )
    with EpisodeWriter(tmp_path / "e.mcap", info) as writer:
        for frame in frames:
            writer.write(frame)
        writer.finish(outcome)
    return tmp_path / "e.mcap"


def _drawn(path: Path, tmp_path: Path) -> dict[str, list[Any]]:
    robot_model.cache_clear()
    bodies._installed_mesh.cache_clear()
    try:
        save(find_episodes([path])[0], tmp_path / "x.rrd")
    finally:
        robot_model.cache_clear()
        bodies._installed_mesh.cache_clear()
    return _chunks(tmp_path / "x.rrd")


def _mesh_of(chunks: list[Any]) -> tuple[np.ndarray[Any, Any], set[int]]:
    """Vertices (N, 3) and the colours, 0xRRGGBBAA."""
    (batch,) = [b for c in chunks if "Mesh3D:vertex_positions" in (b := c.to_record_batch()).schema.names]
    vertices = np.array(batch.column("Mesh3D:vertex_positions").to_pylist()[0])
    return vertices, set(batch.column("Mesh3D:vertex_colors").to_pylist()[0])


def test_models_are_drawn_in_their_place_and_colour(with_models: Path, tmp_path: Path) -> None:
    drawn = _drawn(with_models, tmp_path)
    for body in (DUCK, BRICK):
        vertices, _ = _mesh_of(drawn[f"/world/bodies/{body.name}"])
        half = np.array(body.shape.size) / 2
        np.testing.assert_allclose(vertices.max(axis=0), half, atol=0.001)
        np.testing.assert_allclose(vertices.min(axis=0), -half, atol=0.001)
    assert _mesh_of(drawn["/world/bodies/brick"])[1] == {0x3366FFFF}
    channels = [(c >> 24, c >> 16 & 255, c >> 8 & 255) for c in _mesh_of(drawn["/world/bodies/duck"])[1]]
    assert any(min(red, green) > 180 > 60 > blue for red, green, blue in channels), "the duck is yellow"


@pytest.mark.parametrize("lost", ["all", "meshes"])
def test_a_recording_shows_everything_where_the_models_are_not_installed(
    with_models: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, lost: str
) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    if lost == "meshes":
        for name in ("franka_panda/panda.urdf", "lego/lego.urdf"):
            (elsewhere / name).parent.mkdir()
            shutil.copy(asset_path(name), elsewhere / name)
    installed = _drawn(with_models, tmp_path)
    monkeypatch.setattr(assets, "data_folder", lambda: elsewhere)
    drawn = _drawn(with_models, tmp_path)
    said = caplog.text
    assert "The robot is drawn as the recording describes it" in said
    assert said.count("An object is drawn as the recording describes it") == 2
    assert all(message.endswith(".") and ". " not in message for message in caplog.messages)  # a sentence each
    links = {entity for entity in drawn if "/robot/" in entity and _has(drawn[entity], "Mesh3D:vertex_positions")}
    assert {link.rpartition("/")[2] for link in links} >= {f"panda_link{n}" for n in range(8)} | {"panda_hand"}
    for entity in [*sorted(links), "/world/bodies/duck", "/world/bodies/brick"]:
        (vertices, _), (real, _) = _mesh_of(drawn[entity]), _mesh_of(installed[entity])
        np.testing.assert_allclose(vertices.max(axis=0), real.max(axis=0), atol=0.03)
        np.testing.assert_allclose(vertices.min(axis=0), real.min(axis=0), atol=0.03)
        assert not np.array_equal(vertices, real)
    assert _mesh_of(drawn["/world/bodies/brick"])[1] == {0x3366FFFF}


def test_the_viewer_finds_ffmpeg(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setenv("DEMOREC_CACHE", str(tmp_path / "cache"))
    folder = viewer_environment()["PATH"].split(os.pathsep)[-1]
    said = subprocess.run([f"{folder}/ffmpeg", "-version"], capture_output=True, text=True, check=True).stdout
    assert said.startswith("ffmpeg version")
