"""The rows of four robots' bags: each holds the message that the plainest search finds, with its bits and its age."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin
from support import bag_mappings, bags

from demorec.sources.bag import open_bag
from demorec.sources.episodes import windows
from demorec.sources.mapping import SourceMapping
from demorec.sources.mapping_file import read_mapping
from demorec.sources.rows import EpisodeRows, NoRowsError, Timelines
from demorec.sources.streams import read_streams

Write = Callable[[bags.Notes, Path], Path]
LAYOUTS: dict[str, tuple[bags.Notes, Write, str]] = {
    "franka": (bags.franka(1.5), lambda notes, path: bags.write_rosbag2(notes, path / "bag"), bag_mappings.FRANKA),
    "so101": (
        bags.so101(1.5),
        lambda notes, path: bags.write_rosbag2(notes, path / "bag", storage=StoragePlugin.SQLITE3),
        bag_mappings.SO101,
    ),
    "agilex": (
        bags.agilex(1.5),
        lambda notes, path: bags.write_mcap(notes, path / "bag.mcap", is_ros1=True, use_chunking=False),
        bag_mappings.AGILEX,
    ),
    "trossen": (
        bags.trossen(1.5),
        lambda notes, path: bags.write_trossen(notes, path / "bag.mcap"),
        bag_mappings.TROSSEN,
    ),
}


def _rows(path: Path, mapping: SourceMapping) -> list[EpisodeRows]:
    bag = open_bag(path)
    streams = read_streams(bag, mapping)
    lines = Timelines(streams, mapping)
    return [lines.rows(window) for window in windows(bag, streams, list(lines.lines.values()), mapping)]


def _mapping(text: str, tmp_path: Path) -> SourceMapping:
    return read_mapping(bag_mappings.write_mapping(text, tmp_path / "robot.toml"))


def _latest(notes: bags.Notes, time_ns: int) -> tuple[int, bags.Note]:
    number = max(k for k, note in enumerate(notes) if note.header_ns <= time_ns)
    return number, notes[number]


def _vector(note: bags.Note, joints: tuple[str, ...], field: str) -> list[float]:
    if field == "pose":
        position, orientation = note.body["pose"]["position"], note.body["pose"]["orientation"]
        return [*(position[k] for k in "xyz"), *(orientation[k] for k in "xyzw")]
    values = note.body[field].tolist()
    return [values[note.body["name"].index(joint)] for joint in joints] if joints else list(values)


@pytest.mark.parametrize("name", sorted(LAYOUTS))
def test_each_row_holds_the_right_message(name: str, tmp_path: Path) -> None:
    notes, write, text = LAYOUTS[name]
    mapping = _mapping(text, tmp_path)
    (episode,) = _rows(write(bags.in_order(notes), tmp_path), mapping)
    assert len(episode.times_ns) >= 40
    # A row for each image of the slowest camera, whose others are as fast: at the stamp of one of a set's images.
    stamps = {note.header_ns for source in mapping.cameras.values() for note in bags.of_topic(notes, source.topic)}
    assert stamps >= set(episode.times_ns[1:].tolist())
    for shown in episode.cameras.values():
        assert np.all(np.diff(shown.numbers) == 1)
    for feature, sources in mapping.features.items():
        rows = episode.features[feature]
        for row, time_ns in enumerate(episode.times_ns.tolist()):
            taken = [_latest(bags.of_topic(notes, source.topic), time_ns)[1] for source in sources]
            parts = [_vector(note, source.joints, source.field) for note, source in zip(taken, sources, strict=True)]
            expected = np.array(list(itertools.chain(*parts)), dtype=rows.values.dtype)
            assert rows.values[row].tobytes() == expected.tobytes()
            assert rows.ages_ns[row] == max(time_ns - note.header_ns for note in taken)
    for camera, source in mapping.cameras.items():
        shown = episode.cameras[camera]
        for row, time_ns in enumerate(episode.times_ns.tolist()):
            number, note = _latest(bags.of_topic(notes, source.topic), time_ns)
            assert shown.numbers[row] == number
            assert shown.stamps_ns[shown.positions[row]] == note.header_ns


def _so101(tmp_path: Path, notes: bags.Notes, *changes: tuple[str, str]) -> list[EpisodeRows]:
    text = bag_mappings.SO101
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    return _rows(bags.write_mcap(bags.in_order(notes), tmp_path / "bag.mcap"), _mapping(text, tmp_path))


def test_a_stream_that_pauses_is_refused_with_its_name(tmp_path: Path) -> None:
    topic = "/leader/joint_states"
    notes = bags.changed(bags.so101(1.5), topic, lambda k, note: None if 30 <= k < 50 else note)
    with pytest.raises(NoRowsError, match=r"action \(/leader/joint_states\) is up to 0\.4\d\d s away at \d of 45 rows"):
        _so101(tmp_path, notes)


@pytest.mark.parametrize(("keep", "told"), [(lambda k: k >= 65, "begins 1.3"), (lambda k: k < 10, "ends 1.2")])
def test_a_stream_that_is_not_there_all_the_time(keep: Callable[[int], bool], told: str, tmp_path: Path) -> None:
    topic = "/leader/joint_states"
    notes = bags.changed(bags.so101(1.5), topic, lambda k, note: note if keep(k) else None)
    with pytest.raises(NoRowsError, match=told):
        _so101(tmp_path, notes)


def test_two_publishers_on_one_topic(tmp_path: Path) -> None:
    notes = bags.so101(1.0)
    moments = bags.times(20, 1.0, seed=9)
    notes += bags.joints("/follower/joint_states", ("wheel_left", "wheel_right"), moments)
    joints = ", ".join(f'"{name}"' for name in bags.SO101_JOINTS)
    (episode,) = _so101(
        tmp_path,
        notes,
        ('topic = "/follower/joint_states"\n', f'topic = "/follower/joint_states"\njoints = [{joints}]\n'),
    )
    assert episode.features["observation.state"].names == bags.SO101_JOINTS


CUTS = {
    "times": ('[episodes]\ncut = "times"\ntimes_s = [[0.1, 0.5], [0.8, 1.2]]\n', 2),
    "gap": ('[episodes]\ncut = "gap"\ngap_s = 1.0\n', 2),
    "marker": ('[episodes]\ncut = "marker"\ntopic = "/marker"\n', 2),
}


@pytest.mark.parametrize("cut", sorted(CUTS))
def test_several_episodes_in_a_bag(cut: str, tmp_path: Path) -> None:
    notes = bags.so101(1.5)
    table, count = CUTS[cut]
    if cut == "gap":
        notes = [note for note in bags.so101(4.0) if not 1.0 <= (note.header_ns - bags.EPOCH_NS) / bags.NS < 3.0]
    marks = ((0.1, "start"), (0.5, "success"), (0.7, "start"), (1.2, "stop"))
    for seconds, word in marks if cut == "marker" else ():
        time_ns = bags.EPOCH_NS + round(seconds * bags.NS)
        notes.append(
            bags.Note(topic="/marker", type="std_msgs/msg/String", log_ns=time_ns, header_ns=0, body={"data": word})
        )
    episodes = _so101(tmp_path, notes, ("[cameras.front]", table + "[cameras.front]"))
    assert len(episodes) == count
    assert episodes[0].times_ns[-1] < episodes[1].times_ns[0]
    if cut == "marker":
        assert [episode.window.success for episode in episodes] == [True, None]
        front = [note.header_ns for note in bags.of_topic(notes, "/follower/cam_front/image_raw/compressed")]
        begin = bags.EPOCH_NS + bags.NS // 10
        assert episodes[0].times_ns[0] == min(time for time in front if time >= begin)
