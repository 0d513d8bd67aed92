"""A LeRobot v2.1 dataset, written with PyArrow and av, is read; only appending to it requires a conversion."""

from __future__ import annotations

import json
import shlex
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from numpy.typing import NDArray
from support.commands import exit_code

from demorec.datasets.lerobot.folder import LeRobotFolder
from demorec.mcap import Recording
from demorec.view.from_dataset import open_dataset_episode

SAMPLE = Path(__file__).parents[2] / "recordings" / "sample" / "pick_place.mcap"

CAMERA = "observation.images.top"
LENGTHS = (6, 5)
FPS = 10


def state(episode: int) -> NDArray[np.float32]:
    return (np.arange(2 * LENGTHS[episode]).reshape(-1, 2) + 100 * episode).astype(np.float32)


def statistics(values: NDArray[Any]) -> dict[str, list[float]]:
    rows = values.astype(np.float64).reshape(len(values), -1)
    found = {"min": rows.min(0), "max": rows.max(0), "mean": rows.mean(0), "std": rows.std(0)}
    return {**{name: row.tolist() for name, row in found.items()}, "count": [len(rows)]}


def write_video(path: Path, length: int) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=FPS, options={"g": "2", "bf": "0"})
        stream.width = stream.height = 64
        stream.pix_fmt = "yuv420p"
        for number in range(length):
            image = np.full((64, 64, 3), 20 * number + 10, np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode(None))


def write_v21(root: Path) -> Path:
    """Write a file of rows and a video for each episode, and tables as JSON lines."""
    (root / "meta").mkdir(parents=True)
    (root / "data" / "chunk-000").mkdir(parents=True)
    tables: dict[str, list[dict[str, Any]]] = {"episodes": [], "episodes_stats": []}
    for episode, length in enumerate(LENGTHS):
        count = np.arange(length)
        columns: dict[str, NDArray[Any]] = {
            "observation.state": state(episode),
            "action": state(episode) + 1,
            "timestamp": (count / FPS).astype(np.float32),
            "frame_index": count,
            "episode_index": np.full(length, episode),
            "index": count + sum(LENGTHS[:episode]),
            "task_index": np.zeros(length, np.int64),
        }
        vector = pa.list_(pa.float32(), 2)
        arrays = {
            name: pa.array(rows.tolist(), vector) if rows.ndim == 2 else pa.array(rows)
            for name, rows in columns.items()
        }
        pq.write_table(pa.table(arrays), root / f"data/chunk-000/episode_{episode:06d}.parquet")
        write_video(root / f"videos/chunk-000/{CAMERA}/episode_{episode:06d}.mp4", length)
        stats: dict[str, Any] = {name: statistics(rows) for name, rows in columns.items()}
        stats[CAMERA] = {**{name: [[[0.5]]] * 3 for name in ("min", "max", "mean", "std")}, "count": [length]}
        tables["episodes"].append({"episode_index": episode, "tasks": ["push it"], "length": length})
        tables["episodes_stats"].append({"episode_index": episode, "stats": stats})
    tables["tasks"] = [{"task_index": 0, "task": "push it"}]
    for name, rows in tables.items():
        (root / "meta" / f"{name}.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    video = {"video.fps": FPS, "video.codec": "h264", "video.pix_fmt": "yuv420p", "has_audio": False}
    numbers = {"observation.state": ("float32", 2), "action": ("float32", 2), "timestamp": ("float32", 1)}
    integers = dict.fromkeys(("frame_index", "episode_index", "index", "task_index"), ("int64", 1))
    features: dict[str, Any] = {
        name: {"dtype": dtype, "shape": [count], "names": None}
        for name, (dtype, count) in {**numbers, **integers}.items()
    }
    features[CAMERA] = {"dtype": "video", "shape": [64, 64, 3], "names": ["height", "width", "channels"], "info": video}
    totals = {"episodes": len(LENGTHS), "frames": sum(LENGTHS), "tasks": 1, "videos": len(LENGTHS), "chunks": 1}
    info = {
        "codebase_version": "v2.1",
        "robot_type": "so100",
        **{f"total_{name}": count for name, count in totals.items()},
        "chunks_size": 1000,
        "fps": FPS,
        "splits": {"train": f"0:{len(LENGTHS)}"},
        "data_path": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
        "video_path": "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4",
        "features": features,
    }
    (root / "meta" / "info.json").write_text(json.dumps(info))
    return root


def assert_imported(root: Path, run: Path) -> None:
    """Check that the numbers, instruction and images of every episode equal those written."""
    assert exit_code("import", "lerobot", root, "--out", run) == 0
    found = sorted((run / "episodes").glob("*.mcap"))
    assert len(found) == len(LENGTHS)
    for episode, path in enumerate(found):
        with Recording(path) as recording:
            np.testing.assert_array_equal(recording.table().features["observation.state"], state(episode))
            assert (recording.info.instruction, recording.info.robot_name) == ("push it", "so100")
            assert recording.info.cameras[0].kept == "h264"
            levels = [int(image.mean().round()) for image in recording.images("top")]
            np.testing.assert_allclose(levels, 20 * np.arange(LENGTHS[episode]) + 10, atol=2)


@pytest.mark.parametrize("version", ["v2.0", "v2.1"])
def test_it_is_imported_and_shown(version: str, tmp_path: Path) -> None:
    root = write_v21(tmp_path / "cups")
    path = root / "meta" / "info.json"
    path.write_text(path.read_text().replace("v2.1", version))
    assert_imported(root, tmp_path / "run")
    with open_dataset_episode(LeRobotFolder(root), 1) as episode:
        assert episode.info.simulation is None
        np.testing.assert_array_equal(episode.curves["observation.state"].values, state(1))
        assert len(list(episode.packets("top"))) == LENGTHS[1]


def test_its_copy_in_the_new_format_is_the_same(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root, copy = write_v21(tmp_path / "old"), tmp_path / "new"
    for words in (["reorder", root, "--order", "1,0", "--out", copy], ["diff", root, copy]):
        assert exit_code("dataset", *words) == 0, capsys.readouterr()
    told = capsys.readouterr().out
    assert "No difference: 2 of 2 and 2 episodes are the same." in told


def test_an_export_that_would_append_names_the_command_that_converts_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = write_v21(tmp_path / "my cups")
    assert exit_code("export", "lerobot", SAMPLE, "--out", root, "--append", "--no-verify") == 1
    told = capsys.readouterr().err.strip()
    assert "format v2.1, and only v3.0 can be appended to" in told
    _, *arguments = shlex.split(told[told.index("demorec dataset select") :])
    assert exit_code(*arguments[:-1], tmp_path / "new") == 0
    assert json.loads((tmp_path / "new/meta/info.json").read_text())["codebase_version"] == "v3.0"
    assert_imported(tmp_path / "new", tmp_path / "run")


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("info.json", '"v2.1"|"v9.0"', "format v9.0, supported are v2.0, v2.1 and v3.0"),
        ("episodes.jsonl", '"length": 5|"length": -5', "has -5 as length"),
        ("episodes.jsonl", '"length": 5|"length": 9', "its table of episodes has 2 of 15"),
        ("episodes.jsonl", '{"episode_index": 1|[{"episode_index": 1', "The table cannot be read"),
        ("tasks.jsonl", '"task_index": 0|"task_index": null', "has None as task_index"),
        ("tasks.jsonl", '"task_index": 0|"task_index": 0}{', "The table cannot be read"),
    ],
)
def test_a_damaged_dataset_is_refused_in_a_sentence(
    name: str, text: str, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = write_v21(tmp_path / "cups")
    path, (old, new) = root / "meta" / name, text.split("|")
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new))
    assert exit_code("import", "lerobot", root, "--out", tmp_path / "run") == 1
    told = capsys.readouterr().err.splitlines()[-1]
    assert words in told
