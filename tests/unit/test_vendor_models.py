"""Models in the form of vendors: ROS packages, COLLADA, global materials; drawn where their meshes are found."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
import trimesh
from rerun.chunk import RrdReader

from demorec import Recorder
from demorec.core.errors import SceneError
from demorec.mcap.description import self_contained
from demorec.robots.assets import mesh_path
from demorec.robots.urdf import Urdf, mesh_names, read_dynamics, read_links
from demorec.view.bodies import robot_model
from demorec.view.meshes import urdf_meshes
from demorec.view.scene import save
from demorec.view.sources import find_episodes

WHITE, ORANGE = (242, 242, 242, 255), (255, 128, 0, 255)
BOX_CORNERS = 24
"""Vertices of a box with flat shading: three at each corner."""
MESH_CORNERS = 12
"""The same for a tetrahedron."""
CORNERS = [(0, 0, 0), (0.1, 0, 0), (0, 0.2, 0), (0, 0, 0.3)]
FACES = [(0, 2, 1), (0, 1, 3), (1, 2, 3), (0, 3, 2)]
COLLADA = """<?xml version="1.0"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
  <asset><unit meter="0.001"/></asset>
  <library_geometries><geometry id="g"><mesh>
    <source id="p"><float_array id="a" count="12">0 0 0 100 0 0 0 200 0 0 0 300</float_array>
      <technique_common><accessor source="#a" count="4" stride="3"/></technique_common></source>
    <vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
    <triangles count="4"><input semantic="VERTEX" source="#v" offset="0"/><p>0 2 1 0 1 3 1 2 3 0 3 2</p></triangles>
  </mesh></geometry></library_geometries>
  <library_visual_scenes><visual_scene id="s"><node><instance_geometry url="#g"/></node></visual_scene>
  </library_visual_scenes>
</COLLADA>"""
"""The same tetrahedron, written in millimetres."""


def urdf_text(mesh: str) -> str:
    """An arm of two links with one mesh each; the second has its own colour, the first a global material."""
    visual = f"<geometry><mesh scale='1 1 1' filename='{mesh}'/></geometry>"
    return f"""<robot name="vendor">
      <material name="arm_white"><color rgba="0.95 0.95 0.95 1"/></material>
      <link name="base"><visual>{visual}<material name="arm_white"/></visual></link>
      <link name="tip"><visual>{visual}<material name="o"><color rgba="1 0.5 0 1"/></material></visual></link>
      <joint name="turn" type="revolute"><parent link="base"/><child link="tip"/><origin xyz="0 0 0.3"/>
        <axis xyz="0 0 1"/><limit lower="-1" upper="1"/><dynamics damping="10" friction="1"/></joint>
      <gazebo><plugin name="control" filename="libgazebo_ros_control.so"/></gazebo>
      <!-- <visual><geometry><mesh filename="gone.stl"/></geometry></visual> -->
    </robot>"""


@pytest.fixture
def package(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A ROS package, `vendor_description`, with urdf/ and meshes/ in it."""
    for name in ("ROS_PACKAGE_PATH", "AMENT_PREFIX_PATH"):
        monkeypatch.delenv(name, raising=False)
    folder = tmp_path / "src" / "vendor_description"
    mesh = folder / "meshes" / "visual" / getattr(request, "param", "part.dae")
    for parent in (folder / "urdf", mesh.parent):
        parent.mkdir(parents=True)
    if mesh.suffix == ".dae":
        mesh.write_text(COLLADA)
    else:
        trimesh.Trimesh(CORNERS, FACES).export(mesh)
    text = urdf_text(f"package://vendor_description/meshes/visual/{mesh.name}")
    (folder / "urdf" / "vendor.urdf").write_text(text)
    return folder


def mesh_name(package: Path) -> str:
    (name,) = mesh_names((package / "urdf" / "vendor.urdf").read_text())
    return name


def test_a_mesh_is_found_where_ros_would_find_it(
    package: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = mesh_name(package)
    renamed = package.rename(package.with_name("vendor-main"))  # as a repository may be called
    assert mesh_path(renamed / "urdf", name).is_relative_to(renamed)
    renamed.rename(package)
    elsewhere = tmp_path / "a" / "b" / "c" / "d" / "e" / "f" / "g"
    elsewhere.mkdir(parents=True)
    monkeypatch.chdir(elsewhere)
    with pytest.raises(SceneError, match="put the package 'vendor_description' next to it or on ROS_PACKAGE_PATH"):
        mesh_path(elsewhere, name)
    file = package / "meshes" / "visual" / name.rpartition("/")[2]
    for entry in (package.parent, package):
        monkeypatch.setenv("ROS_PACKAGE_PATH", f"/nowhere{os.pathsep}{entry}")
        assert mesh_path(elsewhere, name).samefile(file)
        assert mesh_path(None, name).samefile(file)
    monkeypatch.delenv("ROS_PACKAGE_PATH")
    installed = tmp_path / "install" / "share" / "vendor_description"
    installed.parent.mkdir(parents=True)
    package.rename(installed)
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path / "install"))
    relative = name.removeprefix("package://")
    for wanted in (name, f"file:///home/me/ws/install/vendor_description/share/{relative}"):
        assert mesh_path(elsewhere, wanted).is_relative_to(installed)


def test_a_text_of_unknown_origin_leads_to_no_other_file(
    package: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    secret = tmp_path / "secret.stl"
    secret.write_text("solid")
    monkeypatch.chdir(package)
    assert mesh_path(None, mesh_name(package)).is_file()
    for name in (str(secret), f"file://{secret}", "../../secret.stl", "package://vendor_description/../../secret.stl"):
        with pytest.raises(SceneError, match="neither next to its URDF"):
            mesh_path(None, name)


@pytest.mark.parametrize("package", ["part.stl", "part.dae", "part.obj"], indirect=True)
def test_it_is_drawn_in_its_materials(package: Path) -> None:
    text = (package / "urdf" / "vendor.urdf").read_text()
    links = urdf_meshes(text, package / "urdf")
    for link, color in (("base", WHITE), ("tip", ORANGE)):
        assert (np.abs(255 * links[link].colors - color[:3]) <= 1).all()
        np.testing.assert_allclose(links[link].points.max(axis=0), (0.1, 0.2, 0.3), atol=1e-6)
    boxes = {link.name: link.visuals[0] for link in read_links(self_contained(text, package / "urdf"))}
    assert boxes["base"].size == pytest.approx((0.1, 0.2, 0.3))
    assert boxes["base"].rgba == pytest.approx((0.95, 0.95, 0.95, 1.0))


def record(folder: Path, robot: Path | str) -> Path:
    with Recorder(folder, fps=10, robot=robot, task="turn") as recorder, recorder.episode() as episode:
        for step in range(5):
            episode.write({"turn": 0.1 * step}, time_ns=step * 100_000_000)
    return folder


def drawn(recording: Path, out: Path) -> dict[str, tuple[int, set[int]]]:
    """Link -> number of corners of its mesh in a file of `view --save`, and their colours."""
    robot_model.cache_clear()
    save(find_episodes([recording])[0], out)
    found = {}
    for chunk in RrdReader(out).stream():
        batch = chunk.to_record_batch()
        if "Mesh3D:vertex_positions" in batch.schema.names:
            positions, colors = (batch.column(f"Mesh3D:vertex_{name}")[0].as_py() for name in ("positions", "colors"))
            found[chunk.entity_path.rsplit("/", 1)[-1]] = len(positions), set(colors)
    return found


def test_a_recorded_arm_is_drawn_with_its_meshes_while_they_exist(package: Path, tmp_path: Path) -> None:
    recording = record(tmp_path / "run", package / "urdf" / "vendor.urdf")
    found = drawn(recording, tmp_path / "a.rrd")
    for link, color in (("base", WHITE), ("tip", ORANGE)):
        corners, (rgba,) = found[link]
        assert corners == MESH_CORNERS
        assert np.abs(np.subtract([rgba >> shift & 255 for shift in (24, 16, 8, 0)], color)).max() <= 1
    package.rename(package.with_name("gone"))
    assert {link: n for link, (n, _) in drawn(recording, tmp_path / "b.rrd").items()} == {
        "base": BOX_CORNERS,
        "tip": BOX_CORNERS,
    }


def test_a_described_arm_is_drawn_with_its_meshes_where_ros_finds_them(
    package: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """The arm is imported from a bag with /robot_description."""
    recording = record(tmp_path / "run", (package / "urdf" / "vendor.urdf").read_text())
    drawn(recording, tmp_path / "a.rrd")
    assert "drawn as rods" in caplog.text
    assert "vendor_description" in caplog.text
    monkeypatch.setenv("ROS_PACKAGE_PATH", str(package.parent))
    found = drawn(recording, tmp_path / "b.rrd")
    assert {link: n for link, (n, _) in found.items()} == {"base": MESH_CORNERS, "tip": MESH_CORNERS}


def test_joint_losses_are_read_and_invalid_urdfs_are_named(package: Path) -> None:
    text = (package / "urdf" / "vendor.urdf").read_text()
    assert read_dynamics(text) == {"turn": (10.0, 1.0)}
    with pytest.raises(ValueError, match="'turn' is -1; set it to 0 or more"):
        read_dynamics(text.replace('friction="1"', 'friction="-1"'))
    with pytest.raises(ValueError, match=r"xacro FILE\.xacro > FILE\.urdf"):
        Urdf.parse('<robot xmlns:xacro="http://wiki.ros.org/xacro"><xacro:include filename="a.xacro"/></robot>')
