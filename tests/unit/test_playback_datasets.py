"""Objects in the playback of a dataset, judged by the recording that it was exported from."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from rerun.chunk import RrdReader
from support.export import export

from demorec.errors import RecordingError
from demorec.geometry import Array
from demorec.playback.episode import PlayedEpisode
from demorec.playback.from_dataset import open_dataset_episode
from demorec.playback.held_objects import held
from demorec.playback.save import save
from demorec.playback.sources import find_episodes
from demorec.recording import Recording

SAMPLE = Path(__file__).parents[2] / "recordings" / "sample" / "format_1.mcap"
"""A simulated episode: the cube is lifted, carried 26 cm and put down."""


@pytest.fixture(scope="module")
def recorded() -> Array:
    with Recording(SAMPLE) as recording:
        return recording.columns().object_poses["red_cube"]


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("dataset") / "cubes"
    export(SAMPLE, folder)
    return folder


def test_what_the_hand_holds_moves_with_it(dataset: Path, recorded: Array) -> None:
    with open_dataset_episode(dataset, 0) as episode:
        assert isinstance(episode, PlayedEpisode)
        drawn = episode.object_poses["red_cube"]
    assert np.ptp(recorded[:, 2]) > 0.1  # lifted
    assert drawn.shape == recorded.shape
    np.testing.assert_allclose(drawn[:, :3], recorded[:, :3], atol=2e-3)
    np.testing.assert_array_equal(drawn[-1], recorded[-1])
    turned = np.abs((drawn[:, 3:] * recorded[:, 3:]).sum(axis=1))
    assert turned.min() > np.cos(np.deg2rad(3) / 2)


def test_recorded_object_poses_are_shown_where_a_dataset_has_them(tmp_path: Path, recorded: Array) -> None:
    export(SAMPLE, tmp_path / "cubes", privileged=True)
    with open_dataset_episode(tmp_path / "cubes", 0) as episode:
        assert isinstance(episode, PlayedEpisode)
        np.testing.assert_allclose(episode.object_poses["red_cube"], recorded, atol=1e-6)


def test_an_end_is_drawn_where_the_object_ended(dataset: Path, recorded: Array, tmp_path: Path) -> None:
    save(find_episodes([dataset])[0], tmp_path / "x.rrd")
    positions: dict[str, Array] = {}
    for chunk in RrdReader(tmp_path / "x.rrd").stream():
        batch = chunk.to_record_batch()
        if chunk.is_static and "Transform3D:translation" in batch.schema.names:
            positions[chunk.entity_path] = np.array(batch.column("Transform3D:translation").to_pylist()[0][0])
    (end,) = [entity for entity in positions if "/ends/" in entity or entity.endswith("/end")]
    above = [parent for parent in positions if end.startswith(f"{parent}/")]
    np.testing.assert_allclose(sum(positions[entity] for entity in [end, *above]), recorded[-1, :3], atol=1e-6)


@pytest.mark.parametrize(
    ("opening", "target", "expected"),
    [
        # Millimetres. Closed around 50 mm, then opened.
        ([80, 75, 68, 60, 52, 50, 50, 50, 50, 60], [80] + [0] * 7 + [80] * 2, [0, 0, 0, 0, 0, 0, 1, 1, 0, 0]),
        # Closed beside the object: nothing stops the fingers before they are where they shall be.
        ([80, 50, 20, 0, 0, 0], [80] + [0] * 5, [0] * 6),
        # Something that gives way is held, something lost is not.
        ([80, 60, 50, 50, 49, 48, 40, 30, 20, 10], [80] + [0] * 9, [0, 0, 0, 1, 1, 1, 0, 0, 0, 0]),
    ],
)
def test_closing_fingers_that_stop_hold_something(opening: list[int], target: list[int], expected: list[int]) -> None:
    assert held(np.array(opening) / 1000, np.array(target) / 1000, 30).astype(int).tolist() == expected


_READ = """
import sys
import av
from rerun.experimental import LeRobotReader
assert av.logging.get_level() is None  # nothing of FFmpeg's reaches the terminal
list(LeRobotReader(sys.argv[1]).stream(0))
"""


@pytest.mark.slow
def test_what_reruns_reader_says_of_a_dataset_cannot_act_on_a_terminal(dataset: Path, tmp_path: Path) -> None:
    """It writes to the terminal by itself, past our own output: foreign words must be spelt out in there already."""
    spoilt = tmp_path / "d"
    shutil.copytree(dataset, spoilt)
    info = spoilt / "meta" / "info.json"
    text = info.read_text().replace('"float32"', '"odd\\u001b[2Jtype"')
    assert text != info.read_text()
    info.write_text(text)
    environment = {**os.environ, "RUST_LOG": "warn"}
    done = subprocess.run([sys.executable, "-c", _READ, spoilt], env=environment, capture_output=True, check=False)
    assert b"odd" in done.stderr
    assert b"\x1b[2J" not in done.stderr


def test_a_missing_video_is_one_sentence(dataset: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    spoilt = tmp_path / "d"
    shutil.copytree(dataset, spoilt)
    video = next((spoilt / "videos").rglob("*.mp4"))
    video.unlink()
    with pytest.raises(RecordingError, match="Failed to read video"):
        save(find_episodes([spoilt])[0], tmp_path / "x.rrd")
    assert capfd.readouterr().err == ""  # Rerun's warnings go there, past our own output
