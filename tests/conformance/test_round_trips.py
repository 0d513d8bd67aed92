"""An exported dataset is imported again: everything that recordings can hold comes back, and the rest is named."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from support.commands import exit_code
from support.export import export, make_run, recordings
from support.external import TOP, URDF, Episode, make_external, write_external

from demorec.core.geometry import Pose
from demorec.core.text import printable
from demorec.episode.info import Camera
from demorec.extensions.datasets.inspect import dataset_digest
from demorec.mcap import Recording

MILLIMETRES = Camera(name="near_depth", width=32, height=24, kept="16UC1")
METRES = Camera(name="far", width=32, height=24, kept="32FC1")
ON_THE_HAND = replace(TOP, mount="lower", mount_from_camera=Pose(position=np.array([0.1, 0.0, 0.02])))
SUBTASKS = {0: "reach", 7: "grasp"}


def episode(index: int, *, success: bool | None, reason: str = "") -> Episode:
    """Twelve frames with colour and depth in millimetres and metres; every frame has an image of each."""
    given = make_external(cameras=(TOP,), num_frames=12, episode_index=index, success=success)
    random = np.random.default_rng(index)
    stamps = [stamp for stamp, _ in given.images["top"]]
    near = [(stamp, random.integers(0, 9000, (24, 32)).astype(np.uint16)) for stamp in stamps]
    far = [(stamp, (values / 1000).astype(np.float32)) for stamp, values in near]
    shown = dict.fromkeys(("top", "near_depth", "far"))
    frames = [
        replace(frame, images=dict.fromkeys(shown, number), subtask=SUBTASKS.get(number, ""))
        for number, frame in enumerate(given.frames)
    ]
    images: dict[str, Any] = {**given.images, "near_depth": near, "far": far}
    info = replace(given.info, cameras=(ON_THE_HAND, MILLIMETRES, METRES))
    outcome = replace(given.outcome, failure_reason=reason, drops={})
    return Episode(info=info, frames=frames, images=images, outcome=outcome)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("external") / "run"
    (folder / "episodes").mkdir(parents=True)
    outcomes: list[dict[str, Any]] = [{"success": None}, {"success": True}, {"success": False, "reason": "it slipped"}]
    for index, outcome in enumerate(outcomes):
        write_external(folder / "episodes" / f"episode_{index:06d}.mcap", episode(index, **outcome))
    return folder


def imported(exporter: str, source: Path, out: Path) -> Path:
    """The run that the command makes from a dataset."""
    if exporter == "lerobot":
        assert exit_code("import", "lerobot", source, "--out", out) == 0
        return out
    mapping = out.with_suffix(".toml")
    assert exit_code("import", "hdf5", source, "--mapping", mapping, "--out", out) == 0
    return out


@pytest.mark.parametrize("exporter", ["lerobot", "hdf5"])
def test_round_trip_of_another_robot(
    exporter: str, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options: dict[str, Any] = {"depth": True, "include_failures": True}
    options |= {"language": ()} if exporter == "lerobot" else {}
    export(run, tmp_path / "a", exporter, **options)
    if exporter == "hdf5":
        assert exit_code("import", "hdf5", tmp_path / "a", "--suggest") == 0
        (tmp_path / "again.toml").write_text(capsys.readouterr().out.replace("# urdf = ", "urdf = "))
        (tmp_path / "robot.urdf").write_text(URDF)
    again = imported(exporter, tmp_path / "a", tmp_path / "again")
    for before, after in zip(recordings(run), recordings(again), strict=True):
        with Recording(before) as there, Recording(after) as here:
            assert (here.success, here.info.instruction, here.num_frames) == (there.success, "stack the cups", 12)
            assert here.info.robot_name == "two_joints"
            for name, values in there.table().features.items():
                found = here.table().features[name]
                np.testing.assert_array_equal(found, values.astype(np.float32) if exporter == "lerobot" else values)
            (state,) = (feature for feature in here.info.features if feature.name == "observation.state")
            assert state.names == ("shoulder.pos", "elbow.pos", "gripper.pos")
            assert state.joints == ("shoulder", "elbow", "")
            assert set(here.depth_cameras) == {"near_depth", "far"}
            millimetres = np.array(list(there.distances("near_depth")))
            metres = np.array(list(here.distances("near_depth")))
            if exporter == "hdf5":  # the dataset has float32
                np.testing.assert_array_equal(np.rint(metres * 1000), millimetres)
                np.testing.assert_array_equal(list(here.distances("far")), list(there.distances("far")))
                continue
            # Half a step of LeRobot's codes: (z + 3.5 m) ln(13.5 / 3.51) / 4095; distances below 1 cm mean no
            # measurement.
            step = (millimetres / 1000 + 3.5) * np.log(13.5 / 3.51) / 4095
            seen = millimetres > 20
            assert (np.abs(metres - millimetres / 1000)[seen] < 0.51 * step[seen]).all()
            assert here.subtasks == there.subtasks == tuple(SUBTASKS.items())
            assert here.outcome is not None
            assert there.outcome is not None
            assert here.outcome.failure_reason == there.outcome.failure_reason
            (top,) = (camera for camera in here.info.cameras if camera.name == "top")
            assert (top.intrinsics, top.mount, top.kept) == (TOP.intrinsics, "lower", "h264")
            assert top.mount_from_camera is not None
            assert top.mount_from_camera.position.tolist() == [0.1, 0.0, 0.02]
            assert [packet.data for packet in here.packets("top")] == [packet.data for packet in there.packets("top")]
    export(again, tmp_path / "b", exporter, **options)
    if exporter == "lerobot":
        assert dataset_digest(tmp_path / "b") == dataset_digest(tmp_path / "a")
        return
    with h5py.File(tmp_path / "a") as a, h5py.File(tmp_path / "b") as b:
        names: list[str] = []
        a.visit(names.append)
        datasets = [name for name in names if isinstance(a[name], h5py.Dataset) and not name.endswith("_image")]
        assert len(datasets) == 3 * 6 + 2 + 2  # rewards of two episodes, and both masks
        for name in datasets:
            np.testing.assert_array_equal(a[name][()], b[name][()], err_msg=name)


@pytest.mark.slow
def test_round_trip_of_a_simulated_episode(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Colour and depth of two cameras, subtasks and outcome come back; scene, boxes and the rest are named."""
    made = make_run(tmp_path / "run", (4, 6), depth=True, segmentation=True)
    export(made, tmp_path / "a", depth=True, language=(), boxes=True, progress=True)
    again = imported("lerobot", tmp_path / "a", tmp_path / "again")
    told = capsys.readouterr().out
    for name in ("demorec/episodes", "demorec/boxes", "sarm_progress.parquet", "next.reward", "language_persistent"):
        assert f"{name} is left out: " in told, printable(told)
    rows = pq.read_table(next((tmp_path / "a" / "data").rglob("*.parquet"))).to_pylist()
    for index, file in enumerate(recordings(again)):
        with Recording(file) as recording:
            assert recording.success is True
            assert recording.cameras + recording.depth_cameras == ("front", "wrist", "front_depth", "wrist_depth")
            own = [row for row in rows if row["episode_index"] == index]
            said = [entry for entry in own[0]["language_persistent"] if entry["style"] == "subtask"]
            assert [text for _, text in recording.subtasks] == [entry["content"] for entry in said]
            np.testing.assert_array_equal(recording.table().features["action"], [row["action"] for row in own])
    export(again, tmp_path / "b", depth=True, language=())
    imported("lerobot", tmp_path / "b", tmp_path / "third")
    export(tmp_path / "third", tmp_path / "c", depth=True, language=())
    assert dataset_digest(tmp_path / "c") == dataset_digest(tmp_path / "b")
    for camera in ("front", "wrist", "front_depth", "wrist_depth"):
        a, b = (list((tmp_path / name / "videos").glob(f"*.{camera}/*/*.mp4")) for name in "ab")
        assert [path.read_bytes() for path in a] == [path.read_bytes() for path in b]


def test_implausible_sidecar_data_is_ignored(run: Path, tmp_path: Path) -> None:
    """An unknown camera, a pose without a rotation, control characters in a reason."""
    export(run, tmp_path / "a", include_failures=True)
    (path,) = (tmp_path / "a" / "demorec" / "episodes").glob("*/*.parquet")
    table = pq.read_table(path)
    rows = table.to_pylist()
    for row in rows:
        row["failure_reason"] = "\x1b[31mred"
        top = row["cameras"][0] | {"mount_from_camera": [0.0] * 7, "intrinsics": [float("nan")] * 9}
        row["cameras"] = [None, top]
    pq.write_table(pa.Table.from_pylist(rows, schema=table.schema), path)
    for file in recordings(imported("lerobot", tmp_path / "a", tmp_path / "again")):
        with Recording(file) as recording:
            assert recording.outcome is not None
            assert recording.outcome.failure_reason == ""
            (camera,) = recording.info.cameras
            assert (camera.name, camera.intrinsics, camera.mount_from_camera) == ("top", None, None)
