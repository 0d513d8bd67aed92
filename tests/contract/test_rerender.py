"""Recorded states are rendered as new images."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.check import Spoilt, checked, simulate
from support.commands import exit_code

from demorec.extensions.remake.deep_check import deep_check
from demorec.extensions.remake.options import RerenderOptions
from demorec.extensions.remake.rerender import rerender
from demorec.mcap import Recording
from demorec.render.painter import WarmRenderer

pytestmark = pytest.mark.slow

SIDE = """
import math
from demorec.render.cameras import CameraPreset

SIDE = CameraPreset(summary="", eye=(0.5, 0.9, 0.5), target=(0.5, 0.0, 0.1), fov_y=math.radians(50))
"""


def own_camera(folder: Path) -> Path:
    """A folder on Python's path that contains `rerender_cameras:SIDE`."""
    (folder / "path").mkdir()
    (folder / "path" / "rerender_cameras.py").write_text(SIDE)
    return folder / "path"


@pytest.fixture(scope="session")
def filmed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("rerender") / "filmed.mcap"
    return simulate(path, seed=13, cameras=("front", "wrist"), width=64, height=64)


def test_own_cameras_and_looks_give_the_recorded_images_again(filmed: Path, tmp_path: Path) -> None:
    report = rerender(filmed, tmp_path / "again.mcap", RerenderOptions())
    assert report.compared == ("front", "wrist")
    assert not report.differing
    with Recording(filmed) as a, Recording(tmp_path / "again.mcap") as b:
        for camera in a.cameras:
            assert [p.data for p in a.packets(camera)] == [p.data for p in b.packets(camera)]
            assert np.array_equal(a.pixel_statistics(camera).counts, b.pixel_statistics(camera).counts)
        x, y = a.trajectory(), b.trajectory()
        for name in ("joint_position", "joint_velocity", "command_joint_target", "action_joint_target"):
            assert np.array_equal(getattr(x, name), getattr(y, name))
        assert np.array_equal(x.world_from_camera["wrist"], y.world_from_camera["wrist"])
        assert list(a.events()) == list(b.events())
        assert a.outcome == b.outcome
        assert b.info.origin == f"render of {a.digest()[:16]}"


def test_calibration_errors_survive_a_second_rendering(tmp_path: Path) -> None:
    """The error of a rendering does not follow from the seed; the recorded error leads to the camera's true pose."""
    source = simulate(tmp_path / "e.mcap", seed=2, cameras=("front",), width=64, height=64, variation="full")
    report = rerender(source, tmp_path / "again.mcap", RerenderOptions())
    assert (report.compared, report.differing) == (("front",), {})
    rerender(tmp_path / "again.mcap", tmp_path / "thrice.mcap", RerenderOptions())
    with Recording(source) as first, Recording(tmp_path / "thrice.mcap") as last:
        assert first.info.simulated.scene.cameras == last.info.simulated.scene.cameras
        off = [
            np.abs(a.astype(int) - b.astype(int)).max()
            for a, b in zip(first.images("front"), last.images("front"), strict=True)
        ]
    assert max(off) == 0


def test_other_cameras_sizes_and_looks_pass_the_checks(
    filmed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(own_camera(tmp_path))
    out = tmp_path / "out"
    args = ("--cameras", "rerender_cameras:SIDE", "front", "--width", 128, "--height", 96)
    assert exit_code("render", filmed, "--out", out, *args, "--looks", 3, "--depth", "--segmentation") == 0
    report = checked(out / "filmed.mcap")
    assert [r for r in report.results if r.verdict in ("look", "broken")] == []
    deep = deep_check(out / "filmed.mcap")
    assert (deep.level, deep.differences, deep.error) == ("pass", (), "")
    with Recording(filmed) as a, Recording(out / "filmed.mcap") as b:
        assert b.cameras == ("side", "front")
        assert next(b.images("side")).shape == (96, 128, 3)
        side = b.info.simulated.scene.cameras[0]
        assert side.mount_from_camera.position.tolist() == [0.5, 0.9, 0.5]
        assert np.degrees(side.fov_y) == pytest.approx(50)
        assert b.info.simulated.scene.light != a.info.simulated.scene.light
        assert b.info.simulated.scene.goals == a.info.simulated.scene.goals


def test_looks_are_a_function_of_the_seed(filmed: Path, tmp_path: Path) -> None:
    scenes = []
    with WarmRenderer() as warm:  # "c" is drawn by a renderer with different colours
        for name, seed, renderers in (("a", 1, None), ("b", 2, warm), ("c", 1, warm)):
            options = RerenderOptions(looks=seed, cameras=("front",))
            rerender(filmed, tmp_path / f"{name}.mcap", options, renderers=renderers)
            with Recording(tmp_path / f"{name}.mcap") as recording:
                scenes.append((recording.info.simulated.scene, recording.digest()))
    assert scenes[0] == scenes[2]
    assert scenes[0][0] != scenes[1][0]


def test_a_spoilt_image_is_found(filmed: Path, tmp_path: Path) -> None:
    spoilt = Spoilt(filmed)
    spoilt.image("front", lambda t, p: p[::-1] if t == 20 else p)
    path = spoilt.write(tmp_path / "s.mcap")
    assert exit_code("render", path, "--out", tmp_path / "out") == 1


def test_impossible_requests(filmed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_code("render", filmed, "--out", tmp_path, "--cameras", "frnt") == 2
    assert "Did you mean 'front'" in capsys.readouterr().err
    assert exit_code("render", filmed, "--out", tmp_path, "--cameras", "front", "front") == 2
    assert exit_code("render", filmed, "--out", tmp_path, "--width", 65) == 2
    assert exit_code("render", filmed, "--out", filmed.parent) == 2  # over its own source
    assert exit_code("render", tmp_path, "--out", tmp_path / "x") == 2
    assert exit_code("render", filmed, "--out", tmp_path, "--renderer", "rastr") == 2


def test_several_processes_give_the_same(filmed: Path, tmp_path: Path) -> None:
    for index in range(2):
        simulate(
            tmp_path / "in" / f"{index}.mcap", seed=13, episode_index=index, cameras=("front",), width=64, height=64
        )
    assert exit_code("render", tmp_path / "in", "--out", tmp_path / "out", "--workers", 2) == 0
    assert sorted(path.name for path in (tmp_path / "out").glob("*.mcap")) == ["0.mcap", "1.mcap"]


@pytest.mark.parametrize(
    ("robot", "task"),
    [("panda", "pick_shapes"), pytest.param("iiwa", "tutorial", marks=[pytest.mark.slow, pytest.mark.long])],
)
def test_every_kind_of_body_is_drawn_as_it_was_recorded(
    robot: str, task: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # Both arms, one of them scaled; primitives, meshes and URDFs; textures, segmentation, a camera on the hand.
    config: dict[str, Any] = {
        "robot": robot,
        "task": task,
        "variation": "full",
        "segmentation": True,
        "max_episode_seconds": 1.0,
    }
    source = simulate(tmp_path / "e.mcap", seed=4, cameras=("front", "wrist"), width=64, height=64, **config)
    assert exit_code("render", source, "--out", tmp_path / "again.mcap") == 0
    assert "2 of 2 unchanged cameras reproduce the recorded images bit-exactly" in capsys.readouterr().out
    with Recording(source) as a, Recording(tmp_path / "again.mcap") as b:
        for camera in a.cameras:
            assert [p.data for p in a.packets(camera)] == [p.data for p in b.packets(camera)]
            assert np.array_equal(a.trajectory().world_from_camera[camera], b.trajectory().world_from_camera[camera])
            pairs = zip(a.segmentation(camera), b.segmentation(camera), strict=True)
            assert all(np.array_equal(one, two) for one, two in pairs)
