"""Datasets written by LeRobot are imported, and are identical when exported again; PyArrow and av verify them."""

from __future__ import annotations

import io
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from lerobot_datasets import CAMERA, DEPTH, write_by_lerobot
from numpy.typing import NDArray
from PIL import Image
from support.check import edit_json, edit_parquet
from support.commands import exit_code
from support.export import data_table, export, make_run, recordings

from demorec.core.errors import DemorecError
from demorec.extensions.imports.dataset_import import import_lerobot
from demorec.mcap import Recording
from demorec.runs.run_file import load_any_run_file

pytestmark = pytest.mark.usefixtures("hf_datasets_cache")
LENGTHS = (14, 9, 11)
VECTORS = ("observation.state", "observation.single", "observation.counts", "observation.touch", "action")
NAME = CAMERA.removeprefix("observation.images.")


@pytest.fixture(scope="module", params=[pytest.param("video", marks=pytest.mark.slow), "image", "long_gops"])
def imported(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path, Path]:
    """The kind of images, a dataset written by LeRobot, and the run imported from it."""
    from lerobot.configs import RGBEncoderConfig

    kind = str(request.param)
    folder = tmp_path_factory.mktemp(kind)
    arguments: dict[str, Any] = {"stored_as": "image"} if kind == "image" else {}
    if kind == "long_gops":
        arguments["rgb_encoder"] = RGBEncoderConfig(vcodec="h264", g=12, extra_options={"bf": "2"})
    write_by_lerobot(folder / "dataset", LENGTHS, **arguments)
    import_lerobot([folder / "dataset"], None, folder / "run")
    return kind, folder / "dataset", folder / "run"


def columns_of(dataset: Path, name: str) -> NDArray[np.generic]:
    """(T, D) of all data files, by PyArrow."""
    rows = data_table(dataset).column(name).to_pylist()
    return np.array(rows).reshape(len(rows), -1)


def shown_by(dataset: Path, key: str, pixels: str = "rgb24") -> list[NDArray[Any]]:
    """All images of a camera in order, by av."""
    images: list[NDArray[Any]] = []
    for file in sorted((dataset / "videos" / key).rglob("*.mp4")):
        with av.open(str(file)) as container:
            images += [frame.to_ndarray(format=pixels) for frame in container.decode(video=0)]
    return images


def test_numbers_and_tasks_are_those_of_the_dataset(imported: tuple[str, Path, Path]) -> None:
    _, dataset, run = imported
    assert [line.num_frames for line in load_any_run_file(run).attempts] == list(LENGTHS)
    begin = 0
    for number, file in enumerate(recordings(run)):
        with Recording(file) as recording:
            table, end = recording.table(), begin + LENGTHS[number]
            for name in VECTORS:
                expected = columns_of(dataset, name)[begin:end].astype(table.features[name].dtype)
                np.testing.assert_array_equal(table.features[name], expected)
            assert table.features["observation.single"].dtype == np.float64
            assert table.features["observation.counts"].max() > 2**25  # which float32 would round
            assert recording.info.instruction == ("push it", "pull it")[number % 2]
            assert table.time_ns.tolist() == [round(index * 1e9 / 30) for index in range(LENGTHS[number])]
            begin = end


def test_images_are_kept_or_coded_once(imported: tuple[str, Path, Path]) -> None:
    kind, dataset, run = imported
    found = []
    for file in recordings(run):
        with Recording(file) as recording:
            assert recording.info.cameras[0].kept == ("av1" if kind == "video" else "")
            found += list(recording.images(NAME))
    if kind == "image":
        stored = data_table(dataset).column(CAMERA).to_pylist()
        expected = [np.asarray(Image.open(io.BytesIO(image["bytes"])).convert("RGB")) for image in stored]
    else:
        expected = shown_by(dataset, CAMERA)
    assert len(found) == len(expected) == sum(LENGTHS)
    if kind == "video":
        assert all(np.array_equal(a, b) for a, b in zip(found, expected, strict=True))
    else:  # each is far closer to its own image than to the previous one
        for index in range(1, len(found)):
            own, before = (np.abs(found[index].astype(int) - expected[k]).mean() for k in (index, index - 1))
            assert own < before / 2, index


@pytest.mark.slow
def test_distances_are_those_of_the_dataset(tmp_path: Path) -> None:
    """LeRobot defines the distance of each code, and an export writes the same codes."""
    from lerobot.datasets.depth_utils import dequantize_depth

    write_by_lerobot(tmp_path / "d", LENGTHS, depth=True)
    codes = shown_by(tmp_path / "d", DEPTH, "gray12le")
    result = import_lerobot([tmp_path / "d"], None, tmp_path / "run")
    name = DEPTH.removeprefix("observation.images.")
    assert DEPTH not in result.left_out
    assert name in result.cameras
    found = []
    for file in recordings(tmp_path / "run"):
        with Recording(file) as recording:
            assert recording.depth_cameras == (name,)
            found += list(recording.distances(name))
    assert len(found) == sum(LENGTHS)
    for number, (metres, code) in enumerate(zip(found, codes, strict=True)):
        expected = np.squeeze(dequantize_depth(code, output_unit="m", output_tensor=False))
        expected = np.where(np.squeeze(code) == 0, 0, expected)  # not measured, or noise that was encoded badly
        np.testing.assert_allclose(metres, expected, atol=1e-5, err_msg=str(number))


def test_depth_of_another_scale_is_read_by_it_and_without_one_left_out(tmp_path: Path) -> None:
    export(make_run(tmp_path / "simulated", (4,), depth=True), tmp_path / "d", depth=True)
    path = tmp_path / "d" / "meta" / "info.json"
    described = json.loads(path.read_text())
    key = next(name for name in described["features"] if name.endswith("_depth"))
    described["features"][key]["info"] |= {"video.depth_min": 0.0, "video.depth_max": 4.095, "video.use_log": False}
    path.write_text(json.dumps(described))
    import_lerobot([tmp_path / "d"], None, tmp_path / "run")
    with Recording(recordings(tmp_path / "run")[0]) as recording:
        found = list(recording.distances(key.removeprefix("observation.images.")))
    np.testing.assert_allclose(found, np.array(shown_by(tmp_path / "d", key, "gray12le")) / 1000, atol=1e-6)
    del described["features"][key]["info"]["video.shift"]
    path.write_text(json.dumps(described))
    assert "scale of depth" in import_lerobot([tmp_path / "d"], None, tmp_path / "other").left_out[key]


def test_integers_beyond_float64_are_left_out(imported: tuple[str, Path, Path], tmp_path: Path) -> None:
    _, dataset, _ = imported
    shutil.copytree(dataset, tmp_path / "d")
    file = sorted((tmp_path / "d" / "data").rglob("*.parquet"))[-1]
    edit_parquet(file, "observation.counts", lambda rows: [*rows[:-1], [2**53 + 1, *rows[-1][1:]]])
    told = import_lerobot([tmp_path / "d"], None, tmp_path / "run").left_out
    assert told["observation.counts"] == "it has whole numbers that float64 cannot hold"
    assert "observation.touch" not in told


def _backwards(dataset: Path) -> None:
    file = sorted((dataset / "data").rglob("*.parquet"))[0]
    edit_parquet(file, "timestamp", lambda times: [*times[:2], times[1] - 0.01, *times[3:]])


def _no_video(dataset: Path) -> None:
    for file in (dataset / "videos").rglob("*.mp4"):
        file.write_bytes(file.read_bytes()[:1000])


def _odd_name(dataset: Path) -> None:
    edit_json(
        dataset / "meta" / "info.json", lambda info: info["features"].update(frames=info["features"].pop("action"))
    )


FAULTS: dict[str, tuple[Callable[[Path], object], str]] = {
    "times": (_backwards, "timestamps must rise"),
    "video": (_no_video, "video"),
    "column": (_odd_name, "frames"),
    "tasks": (lambda dataset: (dataset / "meta" / "tasks.parquet").unlink(), "tasks.parquet"),
    "info": (lambda dataset: (dataset / "meta" / "info.json").write_text("{}"), "damaged"),
}


@pytest.mark.parametrize("imported", ["long_gops"], indirect=True)
@pytest.mark.parametrize("fault", sorted(FAULTS))
def test_impossible_imports_are_one_sentence(fault: str, imported: tuple[str, Path, Path], tmp_path: Path) -> None:
    _, dataset, _ = imported
    shutil.copytree(dataset, tmp_path / "d")
    change, words = FAULTS[fault]
    change(tmp_path / "d")
    with pytest.raises(DemorecError, match=words) as refused:
        import_lerobot([tmp_path / "d"], None, tmp_path / "run")
    assert "\n" not in str(refused.value)
    assert not recordings(tmp_path / "run") or fault in ("times", "video")


def test_the_command(imported: tuple[str, Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    _, dataset, run = imported
    for args, code, words in (
        (["lerobot", dataset, "--out", run], 0, "3 of 3 episodes had been imported before."),
        (["lerobot", dataset], 2, "--out"),
        (["--suggest", dataset], 2, f"demorec import lerobot {dataset}"),
        (["lerobot", dataset, "--out", tmp_path / "x", "--mapping", "a.toml"], 2, "leave --mapping"),
        (["lerobot", tmp_path / "nothing", "--out", tmp_path / "x"], 2, "No such file"),
        (["lerobot", run, "--out", tmp_path / "x"], 2, "found a run"),
    ):
        assert exit_code("import", *args) == code
        printed = capsys.readouterr()
        assert words in printed.out + printed.err
    assert not (tmp_path / "x").exists()
