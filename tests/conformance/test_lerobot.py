"""A dataset with several files of each kind, verified by the installed LeRobot."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.check import checked, edit_json, verdict_of
from support.docs import run_examples
from support.export import data_table, episode_rows, export, export_in_files, make_run
from support.recording import make_episode

import demorec.datasets.lerobot.parquet
from demorec.datasets.lerobot.depth import DepthScale, quantised
from demorec.extensions.datasets.inspect import dataset_digest
from demorec.mcap import Recording

LENGTHS = (20, 15, 17, 9, 31, 12)
CAMERAS = ("front", "wrist")


pytestmark = pytest.mark.usefixtures("hf_datasets_cache")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_run(tmp_path_factory.mktemp("run") / "run", LENGTHS, failures=(2,))


@pytest.fixture(scope="module")
def dataset(run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("dataset") / "d"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(demorec.datasets.lerobot.parquet, "_ROWS_PER_TABLE", 2)
        export_in_files(run, out, privileged=True, video_mb=0.006, data_mb=0.03, chunk=2)
    for folder in ("data", "meta/episodes", "videos/observation.images.front", "videos/observation.images.wrist"):
        assert len(list((out / folder).rglob("file-*"))) > 1, folder
    return out


def open_dataset(root: Path, **arguments: Any) -> Any:
    from lerobot.datasets import LeRobotDataset

    return LeRobotDataset("local/test", root=root, **{"video_backend": "pyav", "return_uint8": True, **arguments})


def recorded_images(run: Path, episode: int) -> dict[str, list[np.ndarray[Any, Any]]]:
    with Recording(run / "episodes" / f"episode_{episode:06d}.mcap") as recording:
        return {camera: list(recording.images(camera)) for camera in CAMERAS}


def image(item: dict[str, Any], camera: str) -> np.ndarray[Any, Any]:
    return np.asarray(item[f"observation.images.{camera}"].numpy().transpose(1, 2, 0))


@pytest.mark.parametrize("backend", ["pyav", pytest.param("torchcodec", marks=pytest.mark.slow)])
def test_lerobot_reads_every_frame_as_it_was_recorded(run: Path, dataset: Path, backend: str) -> None:
    if backend == "torchcodec":
        try:
            import torchcodec.decoders  # noqa: F401
        except (ImportError, RuntimeError, OSError) as error:
            pytest.skip(f"torchcodec does not load here: {str(error).splitlines()[0]}")
    found = open_dataset(dataset, video_backend=backend)
    assert (found.num_episodes, found.num_frames, found.fps) == (len(LENGTHS), sum(LENGTHS), 30)
    row = 0
    for episode, length in enumerate(LENGTHS):
        images = recorded_images(run, episode)
        _, frames, _ = make_episode(num_frames=length, episode_index=episode)
        for t in range(length):
            item = found[row]
            observation, action = frames[t].observation, frames[t].action
            state = np.array([*observation.joint_position[:7], observation.gripper_width], np.float32)
            assert np.array_equal(item["observation.state"].numpy(), state)
            assert np.array_equal(
                item["action"].numpy(), np.array([*action.joint_target, action.gripper_target], np.float32)
            )
            assert (int(item["episode_index"]), int(item["frame_index"]), int(item["index"])) == (episode, t, row)
            assert item["task"] == "pick up the red cube and place it on the green target"
            ends = [bool(item[f"next.{name}"]) for name in ("done", "success", "reward")]
            assert ends == [t == length - 1] * 3
            for camera in CAMERAS:
                assert np.array_equal(image(item, camera), images[camera][t]), (episode, t, camera)
            row += 1


def test_statistics_equal_those_of_the_decoded_data(dataset: Path) -> None:
    found = open_dataset(dataset)
    stats = found.meta.stats
    names = {"min": 0.0, "max": 1.0, "q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
    assert set(stats) == set(found.features)
    for name in found.hf_dataset.column_names:
        values = np.array(data_table(dataset).column(name).to_pylist(), dtype=np.float64).reshape(sum(LENGTHS), -1)
        for what, q in names.items():
            assert np.allclose(stats[name][what], np.quantile(values, q, axis=0), rtol=1e-12, atol=1e-12), (name, what)
        assert np.allclose(stats[name]["mean"], values.mean(axis=0), rtol=1e-9, atol=1e-12)
        assert np.allclose(stats[name]["std"], values.std(axis=0), rtol=1e-9, atol=1e-12)
        assert stats[name]["count"] == [sum(LENGTHS)]
    images = [found[row] for row in range(sum(LENGTHS))]
    for camera in CAMERAS:
        key = f"observation.images.{camera}"
        pixels = np.stack([image(item, camera) for item in images]).reshape(-1, 3) / 255
        shaped = {what: np.asarray(value).reshape(-1) for what, value in stats[key].items()}
        assert stats[key]["mean"].shape == (3, 1, 1)
        # Counted on every other image, before encoding.
        assert np.abs(shaped["mean"] - pixels.mean(axis=0)).max() < 0.01
        assert np.abs(shaped["std"] - pixels.std(axis=0)).max() < 0.02
        for what in ("q10", "q50", "q90"):
            assert np.abs(shaped[what] - np.quantile(pixels, names[what], axis=0)).max() < 0.06, (camera, what)
        assert shaped["count"] == sum((length + 1) // 2 for length in LENGTHS)


def test_statistics_of_each_episode_are_of_that_episode(dataset: Path) -> None:
    table = data_table(dataset)
    for row in episode_rows(dataset):
        part = table.slice(row["dataset_from_index"], row["length"])
        values = np.array(part.column("action").to_pylist(), dtype=np.float64)
        assert np.allclose(row["stats/action/mean"], values.mean(axis=0), rtol=1e-9)
        assert np.allclose(row["stats/action/q90"], np.quantile(values, 0.9, axis=0), rtol=1e-12)


@pytest.mark.slow
def test_depth_is_read_as_metres(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run", (6, 5), depth=True)
    export(run, tmp_path / "d", depth=True)
    found = open_dataset(tmp_path / "d", depth_output_unit="m")
    assert found.meta.depth_keys == ["observation.images.front_depth", "observation.images.wrist_depth"]
    with Recording(run / "episodes" / "episode_000001.mcap") as recording:
        for t, recorded in enumerate(recording.depth("front")):
            seen = found[6 + t]["observation.images.front_depth"].numpy()[0]
            hit = recorded > 0
            assert hit.any()
            assert not hit.all()
            assert np.abs(seen - recorded)[hit].max() < 1e-3
            assert np.allclose(seen[~hit], 0.01, atol=1e-6)
    from lerobot.datasets.depth_utils import quantize_depth

    depth = np.random.default_rng(0).uniform(0, 12, (48, 64)).astype(np.float32)
    assert np.array_equal(quantised(depth), quantize_depth(depth, video_backend=None, input_unit="m"))
    values = DepthScale().values()
    assert found.meta.stats["observation.images.front_depth"]["min"].reshape(-1)[0] == pytest.approx(values[0])


# ------------------------------------------------------------------------------------------- LeRobot's own tools, slow


def assert_readable(root: Path, lengths: tuple[int, ...]) -> Any:
    found = open_dataset(root)
    assert [row["length"] for row in found.meta.episodes] == list(lengths)
    for row in range(0, sum(lengths), 5):
        item = found[row]
        assert int(item["index"]) == row
    return found


@pytest.mark.slow
@pytest.mark.long
def test_datasets_can_be_merged(run: Path, dataset: Path, tmp_path: Path) -> None:
    from lerobot.datasets.aggregate import aggregate_datasets
    from lerobot.datasets.dataset_tools import merge_datasets

    other = tmp_path / "other"
    export(run, other, privileged=True, episodes=":2")
    aggregate_datasets(["a/a", "b/b"], "c/c", roots=[dataset, other], aggr_root=tmp_path / "both")
    found = assert_readable(tmp_path / "both", (*LENGTHS, *LENGTHS[:2]))
    for row, episode, t in ((sum(LENGTHS) + 3, 0, 3), (sum(LENGTHS) + 20 + 14, 1, 14), (33, 1, 13)):
        assert np.array_equal(image(found[row], "wrist"), recorded_images(run, episode)["wrist"][t])
    merged = merge_datasets([open_dataset(other), open_dataset(dataset)], "d/d", tmp_path / "merged")
    assert merged.num_episodes == len(LENGTHS) + 2
    assert_readable(tmp_path / "merged", (*LENGTHS[:2], *LENGTHS))
    assert (dataset / "demorec" / "robots").is_dir()  # docs/dataset-format.md describes LeRobot's tools
    assert not any((tmp_path / name / "demorec").exists() for name in ("both", "merged"))
    # The merge averages both datasets' quantiles, which are then between those of the episodes.
    verdicts = {r.check: r.verdict for r in checked(tmp_path / "both", "dataset").results}
    assert verdicts["wrong_statistics"] == "good"
    assert [name for name, verdict in verdicts.items() if verdict == "broken"] == ["copied_episodes"]  # they are
    edit_json(tmp_path / "both/meta/stats.json", lambda data: data["action"].update(q90=data["action"]["max"]))
    assert verdict_of(tmp_path / "both", "wrong_statistics", "dataset") == "look"


def lerobot_command(name: str, *arguments: str, timeout: float = 280) -> str:
    program = Path(sys.executable).parent / name
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "HF_HUB_OFFLINE": "1", "WANDB_MODE": "disabled"}
    done = subprocess.run(
        [program, *arguments], check=False, capture_output=True, text=True, timeout=timeout, env=environment
    )
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    return done.stdout + done.stderr


@pytest.mark.slow
def test_lerobot_continues_recording_and_then_demorec_appends(run: Path, tmp_path: Path) -> None:
    from lerobot.configs.video import RGBEncoderConfig
    from lerobot.datasets import LeRobotDataset

    root = tmp_path / "d"
    export(run, root, episodes=":2")
    encoder = RGBEncoderConfig(vcodec="h264", crf=23, preset="veryfast", extra_options={"bf": 0})
    resumed = LeRobotDataset.resume("local/test", root=root, rgb_encoder=encoder)
    rng = np.random.default_rng(0)
    for _ in range(2):
        for _ in range(11):
            frame: dict[str, Any] = {}
            for name, feature in resumed.features.items():
                if feature["dtype"] == "video":
                    frame[name] = rng.integers(0, 255, feature["shape"], dtype=np.uint8)
                elif feature["dtype"] == "bool":
                    frame[name] = np.array([False])
                elif feature["dtype"] == "float32" and name != "timestamp":
                    frame[name] = rng.normal(size=feature["shape"]).astype(np.float32)
            resumed.add_frame({**frame, "task": "another task"})
        resumed.save_episode()
    resumed.finalize()
    report = export(run, root, episodes="2:4", append=True)
    assert (report.num_episodes, report.new_episodes) == (6, 2)
    assert report.digest == dataset_digest(root)
    found = assert_readable(root, (20, 15, 11, 11, 17, 9))
    assert np.array_equal(image(found[35 + 22 + 5], "front"), recorded_images(run, 2)["front"][5])
    assert found[40]["task"] == "another task"
    values = np.array(data_table(root).column("action").to_pylist(), dtype=np.float64)
    assert np.allclose(found.meta.stats["action"]["q50"], np.quantile(values, 0.5, axis=0), rtol=1e-12)


@pytest.mark.slow
def test_lerobot_doctor_finds_no_fault(run: Path, tmp_path: Path) -> None:
    export_in_files(run, tmp_path / "d", video_mb=0.006, data_mb=0.03)
    text = lerobot_command("lerobot-doctor", "check", str(tmp_path / "d"), "--ci")
    report, _ = json.JSONDecoder().raw_decode(text)
    assert report["summary"]["FAIL"] == 0
    # Warnings about synthetic data remain: short episodes, joints that hardly move.
    assert report["summary"]["PASS"] >= 6


@pytest.mark.slow
def test_rerun_opens_the_folder(dataset: Path, tmp_path: Path) -> None:
    import rerun as rr

    with rr.RecordingStream("demorec_test") as stream:
        stream.save(tmp_path / "d.rrd")
        stream.log_file_from_path(dataset)
        stream.flush()
    assert (tmp_path / "d.rrd").stat().st_size > 10_000


@pytest.mark.parametrize("backend", ["as installed", "missing"])
def test_the_example_of_the_readme_runs_without_a_warning(
    dataset: Path,
    capsys: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
    backend: str,
) -> None:
    """Without FFmpeg LeRobot's default video backend cannot be loaded, and prints a long reason."""
    if backend == "missing":
        monkeypatch.setitem(sys.modules, "torchcodec", None)
    assert run_examples("README.md", "LeRobotDataset", {"recordings/demo/dataset": dataset}) == 1
    assert caplog.records == []
    printed = capsys.readouterr()
    assert "pick up the red cube" in printed.out
    assert printed.err == ""
