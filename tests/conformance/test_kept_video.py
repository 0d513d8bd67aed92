"""Episodes that begin between keyframes keep the encoded video: every image equals that of the bag's stream.

PyAV decodes the bag's stream from its beginning; the episodes are taken from its middle.
"""

from __future__ import annotations

import io
from pathlib import Path

import av
import numpy as np
import pytest
from numpy.typing import NDArray
from support import bag_mappings, bags
from support.export import episode_rows, export

from demorec.extensions.datasets.folder import LeRobotFolder
from demorec.extensions.datasets.inspect import dataset_digest
from demorec.extensions.datasets.playback import open_dataset_episode
from demorec.extensions.datasets.recording import DatasetRecording
from demorec.extensions.imports.dataset_import import import_lerobot
from demorec.extensions.imports.import_run import import_bags
from demorec.mcap import Recording

TOPIC, KEY = "/cameras/cam_high/image", "observation.images.high"
GOP = 20
CUTS = ((0.7, 1.9), (2.2, 4.2))
"""Seconds in which the joints of an episode move; both begin between keyframes, which are two thirds of a second
apart.
"""

pytestmark = pytest.mark.usefixtures("hf_datasets_cache")
Images = list[NDArray[np.uint8]]


def _pixels(frame: av.VideoFrame) -> NDArray[np.uint8]:
    return np.asarray(frame.to_ndarray(format="rgb24"), dtype=np.uint8)


def _seconds(note: bags.Note) -> float:
    return (note.header_ns - bags.EPOCH_NS) / bags.NS


@pytest.fixture(scope="module")
def notes() -> bags.Notes:
    return bags.trossen(4.5, gop=GOP)


@pytest.fixture(scope="module")
def run(notes: bags.Notes, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("kept")
    text = bag_mappings.TROSSEN.split("[cameras.wrist]")[0]
    paths = []
    for number, (begin, end) in enumerate(CUTS):
        part = [note for note in notes if begin <= _seconds(note) <= end or note.topic == TOPIC]
        part = [note for note in part if begin - 0.7 <= _seconds(note) <= end + 0.1]
        paths.append(bags.write_trossen(bags.in_order(part), folder / f"{number}.mcap"))
    import_bags(paths, bag_mappings.write_mapping(text, folder / "robot.toml"), folder / "run")
    return folder / "run"


@pytest.fixture(scope="module")
def dataset(run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("dataset") / "d"
    assert export(run, out).transcoded == ()
    return out


@pytest.fixture(scope="module")
def expected(notes: bags.Notes, run: Path) -> list[Images]:
    """Episode -> image of each frame, from the whole stream."""
    of_topic = bags.of_topic(notes, TOPIC)
    stream = io.BytesIO(b"".join(bytes(note.body["data"]) for note in of_topic))
    with av.open(stream, "r", format="h264") as container:
        shown = [_pixels(frame) for frame in container.decode(video=0)]
    by_stamp = {note.header_ns: image for note, image in zip(of_topic, shown, strict=True)}
    found = []
    for path in sorted((run / "episodes").glob("*.mcap")):
        with Recording(path) as recording:
            table = recording.table()
            found.append([by_stamp[stamp] for stamp in table.image_stamps["high"][table.images["high"]].tolist()])
    return found


def shown_by(dataset: Path) -> list[Images]:
    """Episode -> its images, found by their times in the file, which PyAV decodes as a whole."""
    found = []
    for row in episode_rows(dataset):
        name = f"chunk-{row[f'videos/{KEY}/chunk_index']:03d}/file-{row[f'videos/{KEY}/file_index']:03d}.mp4"
        with av.open(str(dataset / "videos" / KEY / name)) as container:
            images = {round((frame.time or 0) * 30): _pixels(frame) for frame in container.decode(video=0)}
        first, end = (round(row[f"videos/{KEY}/{edge}_timestamp"] * 30) for edge in ("from", "to"))
        assert end - first == row["length"]
        found.append([images[number] for number in range(first, end)])
    return found


def assert_equal(found: list[Images], expected: list[Images]) -> None:
    assert [len(images) for images in found] == [len(images) for images in expected]
    for one, other in zip(found, expected, strict=True):
        assert all(np.array_equal(a, b) for a, b in zip(one, other, strict=True))


def test_whole_episodes_between_keyframes(expected: list[Images], dataset: Path) -> None:
    # No frame is left out to begin with a keyframe, and none is encoded again.
    assert [len(images) for images in expected] == pytest.approx([30 * (end - begin) for begin, end in CUTS], abs=1)
    assert_equal(shown_by(dataset), expected)
    (first, second) = (row[f"videos/{KEY}/from_timestamp"] * 30 for row in episode_rows(dataset))
    assert 0 < first < GOP
    assert 0 < second - first - len(expected[0]) < GOP


@pytest.mark.slow
def test_lerobot_shows_them(expected: list[Images], dataset: Path) -> None:
    from lerobot.datasets import LeRobotDataset

    opened = LeRobotDataset("local/kept", root=dataset, video_backend="pyav", return_uint8=True)
    images = [image for episode in expected for image in episode]
    assert len(opened) == len(images)
    for number in (0, 1, 17, len(expected[0]) - 1, len(expected[0]), len(expected[0]) + 5, len(images) - 1):
        assert np.array_equal(opened[number][KEY].numpy().transpose(1, 2, 0), images[number])


def test_appended_they_stay(expected: list[Images], run: Path, tmp_path: Path) -> None:
    files = sorted((run / "episodes").glob("*.mcap"))
    export(files[1], tmp_path / "d")
    export(files[0], tmp_path / "d", append=True)
    assert_equal(shown_by(tmp_path / "d"), expected[::-1])


def test_imported_again_packets_and_digest_are_the_same(dataset: Path, run: Path, tmp_path: Path) -> None:
    result = import_lerobot([dataset], None, tmp_path / "run")
    assert result.cameras["high"] == "h264, passed through as it is"
    for path in sorted((run / "episodes").glob("*.mcap")):
        with Recording(path) as given, Recording(tmp_path / "run/episodes" / path.name) as found:
            ours, theirs = (list(recording.packets("high")) for recording in (found, given))
            length = given.table().num_frames
            slices = [[packet.data[packet.data.rfind(b"\0\0\1") :] for packet in packets] for packets in (ours, theirs)]
            assert slices[0] == slices[1][: len(ours)]
            assert len(ours) - length == found.table().images["high"][0] > 0
            times = found.table().time_ns
            assert np.array_equal(found.table().image_stamps["high"][-length:], times)
    export(tmp_path / "run", tmp_path / "d")
    assert dataset_digest(tmp_path / "d") == dataset_digest(dataset)


def test_playback_has_what_the_first_frames_are_decoded_from(expected: list[Images], dataset: Path) -> None:
    found = LeRobotFolder(dataset)
    for number, (place, images) in enumerate(zip(found.places, expected, strict=True)):
        packets = list(DatasetRecording(found, number).packets("high"))
        assert packets[0].is_keyframe
        assert [packet.frame_index for packet in packets] == list(range(len(packets)))
        with av.open(io.BytesIO(b"".join(packet.data for packet in packets)), "r", format="h264") as container:
            shown = [_pixels(frame) for frame in container.decode(video=0)]
        assert_equal([shown[len(packets) - place.length :]], [images])
        with open_dataset_episode(LeRobotFolder(dataset), place.episode_index) as episode:
            times = np.array([time_ns for time_ns, _, _ in episode.packets("high")])
        assert len(times) == len(packets)
        lead = len(packets) - place.length
        assert times[: lead + 1].tolist() == [episode.time_ns[0]] * (lead + 1)
        assert np.array_equal(times[lead:], episode.time_ns)
