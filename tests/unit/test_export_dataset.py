"""The result of an export, option by option, read back without LeRobot; tests/conformance uses LeRobot itself."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow.parquet as pq
import pytest
from support.export import data_table, episode_rows, export, export_in_files, files_of, info, make_run, recordings
from support.recording import make_episode, write_episode

from demorec.core.config import VideoConfig
from demorec.core.errors import ConfigError
from demorec.datasets.options import parse_episodes
from demorec.extensions.datasets.inspect import dataset_digest
from demorec.mcap import Recording


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_run(tmp_path_factory.mktemp("run") / "run", (20, 15, 17, 9), failures=(2,))


def video_frames(dataset: Path, camera: str) -> Iterator[np.ndarray[Any, Any]]:
    for path in sorted((dataset / "videos" / f"observation.images.{camera}").glob("*/*.mp4")):
        with av.open(str(path)) as container:
            for frame in container.decode(video=0):
                yield frame.to_ndarray(format="rgb24")


def vectors(dataset: Path, name: str) -> np.ndarray[Any, Any]:
    return np.array(data_table(dataset).column(name).to_pylist())


def test_the_digest_depends_on_the_content_alone(run: Path, tmp_path: Path) -> None:
    whole = export(run, tmp_path / "a").digest
    split = export_in_files(run, tmp_path / "b", video_mb=0.005, data_mb=0.005).digest
    assert split == whole == dataset_digest(tmp_path / "b")
    assert len(list((tmp_path / "b" / "data").glob("*/*.parquet"))) > 1
    assert export(run, tmp_path / "c", episodes=":3").digest != whole
    path = next((tmp_path / "a" / "videos").rglob("*.mp4"))
    data = bytearray(path.read_bytes())
    data[-20] ^= 1
    path.write_bytes(data)
    assert dataset_digest(tmp_path / "a") != whole


def test_several_processes_write_the_same_files(run: Path, tmp_path: Path) -> None:
    for workers in (1, 2):
        export(run, tmp_path / f"d{workers}", workers=workers)
    assert files_of(tmp_path / "d1") == files_of(tmp_path / "d2")
    assert {path.name for path in tmp_path.iterdir()} == {"d1", "d2"}


def test_an_mp4_file_holds_one_set_of_parameters(tmp_path: Path) -> None:
    for n, crf in enumerate((23, 23, 35)):
        write_episode(
            tmp_path / f"e{n}.mcap", num_frames=8, episode_index=n, cameras=("front",), video=VideoConfig(crf=crf)
        )
    out = tmp_path / "d"
    export(tmp_path, out)
    rows = episode_rows(out)
    assert [row["videos/observation.images.front/file_index"] for row in rows] == [0, 0, 1]
    coding = info(out)["features"]["observation.images.front"]["info"]
    assert coding["video.crf"] is None  # they differ
    assert coding["video.g"] == 2


def test_transcoded_jpeg_recordings_are_reported(tmp_path: Path) -> None:
    write_episode(tmp_path / "e.mcap", num_frames=8, cameras=("front",), video=VideoConfig(codec="jpeg"))
    report = export(tmp_path, tmp_path / "d")
    assert len(report.transcoded) == 1
    assert "jpeg" in report.transcoded[0]
    coding = info(tmp_path / "d")["features"]["observation.images.front"]["info"]
    assert (coding["video.codec"], coding["video.crf"]) == ("h264", 18)
    with Recording(tmp_path / "e.mcap") as recording:
        for found, expected in zip(video_frames(tmp_path / "d", "front"), recording.images("front"), strict=True):
            assert np.abs(found.astype(int) - expected).mean() < 5


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", range(12)),
        ("0:3", [0, 1, 2]),
        (":2,5", [0, 1, 5]),
        ("::4", [0, 4, 8]),
        ("1:9:3", [1, 4, 7]),
    ],
)
def test_episode_ranges(text: str, expected: list[int]) -> None:
    assert [n for n in range(12) if parse_episodes(text)(n)] == list(expected)


def test_all_differences_of_a_recording_are_reported_at_once(run: Path, tmp_path: Path) -> None:
    write_episode(tmp_path / "large.mcap", num_frames=8, fps=15, width=80, video=VideoConfig(codec="av1"))
    write_episode(tmp_path / "blind.mcap", num_frames=8, cameras=("front",))
    large = ["fps is 15 instead of 30", "camera front is 80x48 instead of 64x48", "camera wrist is av1 instead of h264"]
    for name, parts in {"large": large, "blind": ["cameras is front instead of front wrist. Export"]}.items():
        with pytest.raises(ConfigError) as error:
            export([run, tmp_path / f"{name}.mcap"], tmp_path / "d")
        assert all(part in str(error.value) for part in parts)
        assert not (tmp_path / "d").exists()


def test_append_continues_at_the_end_of_the_dataset(run: Path, tmp_path: Path) -> None:
    whole, grown = tmp_path / "whole", tmp_path / "grown"
    export(run, whole)
    export(run, grown, episodes=":2")
    kept = {
        name: data
        for name, data in files_of(grown).items()
        if name.endswith((".mp4", ".parquet")) and "tasks" not in name
    }
    report = export(run, grown, episodes="2:", append=True)
    assert (report.num_episodes, report.new_episodes, report.num_frames) == (4, 2, 61)
    assert kept.items() <= files_of(grown).items()  # existing files are kept
    assert report.digest == dataset_digest(whole)
    assert data_table(grown).equals(data_table(whole))
    a, b = (json.loads((folder / "meta/stats.json").read_text()) for folder in (whole, grown))
    assert a.keys() == b.keys()
    for name in a:
        for what in ("min", "max", "mean", "std"):
            assert np.allclose(a[name][what], b[name][what], rtol=1e-9), (name, what)
        assert a[name]["count"] == b[name]["count"]
        if not name.startswith("observation.images"):  # image statistics are averaged, as LeRobot does
            assert all(a[name][q] == b[name][q] for q in ("q01", "q10", "q50", "q90", "q99"))
    rows = episode_rows(grown)
    assert [row["data/file_index"] for row in rows] == [0, 0, 1, 1]
    assert [row["meta/episodes/file_index"] for row in rows] == [0, 0, 1, 1]


def test_append_refuses_unsuitable_recordings_with_all_reasons(run: Path, tmp_path: Path) -> None:
    out = tmp_path / "d"
    export(run, out, episodes="0", action="ee", privileged=True)
    before = files_of(out)
    with pytest.raises(ConfigError) as error:
        export(write_episode(tmp_path / "slow.mcap", num_frames=8, fps=15), out, append=True)
    text = str(error.value)
    assert "fps is 30, the recordings have 15" in text
    assert "observation.environment_state" in text
    assert "tcp.x" in text
    assert files_of(out) == before


def test_append_leaves_out_features_that_the_dataset_lacks(run: Path, tmp_path: Path) -> None:
    out = tmp_path / "d"
    export(run, out, episodes="0")
    report = export(run, out, episodes="1", append=True, privileged=True)
    assert report.left_out == ("observation.environment_state",)
    assert "observation.environment_state" not in info(out)["features"]


ALWAYS = {"observation.state", "action", "timestamp", "frame_index", "episode_index", "index", "task_index"}


@pytest.mark.parametrize(
    "chosen",
    [
        ("observation.environment_state",),
        ("action", "observation.images.wrist", "next.done"),
        ("observation.images.front_depth", "observation.velocity"),
    ],
)
def test_only_the_chosen_features(tmp_path: Path, chosen: tuple[str, ...]) -> None:
    run = make_run(tmp_path / "run", (5, 4), depth=True)
    whole, few = tmp_path / "whole", tmp_path / "few"
    export(run, whole, privileged=True, depth=True)
    report = export(run, few, privileged=True, depth=True, features=chosen)
    wanted = ALWAYS | set(chosen)
    assert info(few)["features"] == {k: v for k, v in info(whole)["features"].items() if k in wanted}
    numbers = [name for name in data_table(whole).column_names if name in wanted]
    assert data_table(few).equals(data_table(whole).select(numbers).replace_schema_metadata(None))
    assert json.loads((few / "meta/stats.json").read_text()).keys() == wanted
    videos = {path.name for path in (few / "videos").glob("*")}
    assert videos == {name for name in chosen if name.startswith("observation.images.")}
    for name in videos:
        mp4 = f"videos/{name}/chunk-000/file-000.mp4"
        assert (few / mp4).read_bytes() == (whole / mp4).read_bytes()
    assert report.digest == dataset_digest(few) != dataset_digest(whole)
    card = (few / "README.md").read_text()
    assert all(f"| `{name}` |" in card for name in wanted)
    assert "observation.ee_pose" not in card


def test_the_sidecar_has_the_data_that_lerobot_cannot_hold(run: Path, tmp_path: Path) -> None:
    out = tmp_path / "d"
    export(run, out)
    row = pq.read_table(out / "demorec/episodes/chunk-000/file-000.parquet").to_pylist()[1]
    made, frames, outcome = make_episode(num_frames=15, episode_index=1)
    assert (row["run_episode_index"], row["root_seed"], row["config_digest"]) == (1, 0, made.simulated.config_digest)
    assert row["success"] is True
    assert row["checks"][0]["value"] == outcome.checks[0].value
    assert row["phases"][0] == {"name": "approach", "from": 0, "to": 3}
    assert row["phases"][-1]["to"] == 15
    camera = row["cameras"][0]
    assert camera["name"] == "front"
    assert camera["intrinsics"] == made.simulated.scene.cameras[0].intrinsics.reshape(-1).tolist()
    assert camera["mount_from_camera"] == frames[0].images["front"].world_from_camera.vector().tolist()  # in the world
    assert json.loads(row["episode_info"])["simulation"]["scene"]["bodies"][1]["name"] == "cube"
    assert json.loads((out / "demorec/configs.json").read_text()) == {
        made.simulated.config_digest: made.simulated.config
    }


def test_append_refuses_existing_episodes(run: Path, tmp_path: Path) -> None:
    """Episodes are compared by content: neither the recording's name nor its place matters."""
    out, copies = tmp_path / "d", tmp_path / "copies"
    export(run, out, episodes=":3")
    before = files_of(out)
    copies.mkdir()
    for number, path in enumerate(recordings(run)[1:]):
        shutil.copy(path, copies / f"other_{number}.mcap")
    with pytest.raises(ConfigError, match="has 2 of these episodes already") as error:
        export(copies, out, append=True)
    assert "other_0.mcap (its episode 1), other_1.mcap (its episode 2)" in str(error.value)
    assert files_of(out) == before
