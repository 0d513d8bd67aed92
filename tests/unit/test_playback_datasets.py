"""Objects in the playback of a dataset, compared with the recording that it was exported from."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from rerun.chunk import RrdReader
from support.export import export, make_run
from support.recording import write_episode

from demorec.core.errors import ExportError
from demorec.core.geometry import Array
from demorec.extensions.datasets.folder import LeRobotFolder
from demorec.extensions.datasets.playback import open_dataset_episode
from demorec.mcap import Recording
from demorec.view.scene import save
from demorec.view.sources import find_episodes

SAMPLE = Path(__file__).parents[2] / "recordings" / "sample" / "pick_place.mcap"
"""A simulated episode: the cube is lifted, carried 26 cm and put down."""


@pytest.fixture(scope="module")
def recorded() -> Array:
    with Recording(SAMPLE) as recording:
        return recording.trajectory().object_poses["red_cube"]


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("dataset") / "cubes"
    export(SAMPLE, folder)
    return folder


def test_a_dataset_without_poses_has_the_first_of_each_object(dataset: Path, recorded: Array) -> None:
    with open_dataset_episode(LeRobotFolder(dataset), 0) as episode:
        assert not episode.motion.object_poses
        assert episode.scene is not None
        start = episode.scene.body("red_cube").world_from_body.vector()
    np.testing.assert_allclose(start, recorded[0], atol=2e-3)


def test_recorded_object_poses_are_shown_where_a_dataset_has_them(tmp_path: Path, recorded: Array) -> None:
    export(SAMPLE, tmp_path / "cubes", privileged=True)
    with open_dataset_episode(LeRobotFolder(tmp_path / "cubes"), 0) as episode:
        assert episode.info.simulation is not None
        np.testing.assert_allclose(episode.motion.object_poses["red_cube"], recorded, atol=1e-6)


def test_depth_is_shown_as_the_recordings_have_it(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run", (3, 4), depth=True, cameras=("front",))
    export(run, tmp_path / "d", depth=True)
    with open_dataset_episode(LeRobotFolder(tmp_path / "d"), 1) as episode:  # the second in its file
        assert episode.info.simulation is not None
        times, images = zip(*episode.distances("front"), strict=True)
        shown = np.array(images)
        assert list(times) == episode.time_ns.tolist()
        packets = list(episode.packets("front"))
    with Recording(run / "episodes" / "episode_000001.mcap") as recording:
        measured = np.array(list(recording.depth("front")))
    assert shown.shape == measured.shape
    assert len(packets) == 4
    assert (measured == 0).any()  # the sky
    np.testing.assert_array_equal(shown == 0, measured == 0)
    np.testing.assert_allclose(shown, measured, atol=2e-3)
    save(find_episodes([tmp_path / "d"])[1], tmp_path / "x.rrd")
    chunks = [chunk for chunk in RrdReader(tmp_path / "x.rrd").stream() if chunk.entity_path.endswith("front/depth")]
    batches = [chunk.to_record_batch() for chunk in chunks]
    buffers = [row[0] for batch in batches for row in batch.column("DepthImage:buffer").to_pylist()]
    drawn = np.frombuffer(bytes(buffers[-1]), dtype=np.float32).reshape(measured[0].shape)
    np.testing.assert_allclose(drawn, measured[-1], atol=2e-3)


def test_info_json_must_match_the_video(tmp_path: Path) -> None:
    write_episode(tmp_path / "e.mcap", num_frames=3, depth=True, cameras=("front",))
    export(tmp_path / "e.mcap", tmp_path / "d", depth=True)
    info = tmp_path / "d" / "meta" / "info.json"
    written = json.loads(info.read_text())
    depth, colour = (written["features"][f"observation.images.front{end}"] for end in ("_depth", ""))
    height, width = depth["shape"][:2]
    depth["shape"][:2] = [8, 9]
    assert colour["info"]["video.codec"] == "h264"
    colour["info"]["video.codec"] = "av1"
    info.write_text(json.dumps(written))
    with open_dataset_episode(LeRobotFolder(tmp_path / "d"), 0) as episode:
        assert episode.info.simulation is not None
        with pytest.raises(ExportError, match=f"it has {width}x{height} pixels, and meta/info.json lists 9x8"):
            list(episode.distances("front"))
        with pytest.raises(ExportError, match=r"its codec is h264, and meta/info\.json lists av1"):
            list(episode.packets("front"))
