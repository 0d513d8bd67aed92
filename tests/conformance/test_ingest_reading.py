"""Bags of third-party writers in all their forms are read message by message, number by number."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import IndexType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionMode, StoragePlugin
from support import bags

from demorec.extensions.imports.bag import Bag, open_bag
from demorec.extensions.imports.bag_files import BagError
from demorec.extensions.imports.decoding import UnknownEncodingError, decode_message
from demorec.extensions.imports.fields import stamp_of
from demorec.extensions.recovery.scan import ScannedChannel, ScannedMessage


def _read(bag: Bag) -> tuple[list[tuple[str, int, dict[str, Any]]], list[str]]:
    """(topic, log time, values) of all messages, and the problems."""
    problems: list[str] = []
    found = [(m.channel.topic, m.log_ns, decode_message(m)) for m in bag.messages(problems)]
    return found, problems


def _assert_same(notes: bags.Notes, found: list[tuple[str, int, dict[str, Any]]]) -> None:
    assert [(note.topic, note.log_ns) for note in notes] == [row[:2] for row in found]
    for note, (_, _, values) in zip(notes, found, strict=True):
        assert stamp_of(values) == note.header_ns
        for key, item in note.body.items():
            if isinstance(item, np.ndarray):
                assert values[key].tobytes() == item.tobytes()
            else:
                assert values[key] == item, (note.topic, key)


@pytest.fixture(scope="module")
def notes() -> bags.Notes:
    return bags.in_order(bags.so101(1.0))


@pytest.mark.parametrize("storage", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
@pytest.mark.parametrize("compression", [None, CompressionMode.FILE, CompressionMode.MESSAGE])
def test_rosbag2_folders(
    notes: bags.Notes, storage: StoragePlugin, compression: CompressionMode | None, tmp_path: Path
) -> None:
    bag = open_bag(bags.write_rosbag2(notes, tmp_path / "bag", storage=storage, compression=compression))
    found, problems = _read(bag)
    assert not problems
    _assert_same(notes, found)


@pytest.mark.parametrize(
    ("is_ros1", "compression", "is_bare"),
    [(False, "", True), (False, "lz4", False), (True, "zstd", True)],
)
def test_mcap_files(notes: bags.Notes, is_ros1: bool, compression: str, is_bare: bool, tmp_path: Path) -> None:
    bare: dict[str, Any] = {
        "index_types": IndexType.NONE, "use_statistics": False, "use_summary_offsets": False, "repeat_channels": False,
        "repeat_schemas": False, "use_chunking": False,
    }  # fmt: skip
    path = bags.write_mcap(
        notes, tmp_path / "bag.mcap", is_ros1=is_ros1, compression=compression, **(bare if is_bare else {})
    )
    found, problems = _read(open_bag(path))
    assert not problems
    _assert_same(notes, found)


@pytest.mark.parametrize("compression", [None, *Ros1Writer.CompressionFormat])
def test_ros_1(notes: bags.Notes, compression: Ros1Writer.CompressionFormat | None, tmp_path: Path) -> None:
    found, problems = _read(open_bag(bags.write_ros1(notes, tmp_path / "bag.bag", compression=compression)))
    assert not problems
    _assert_same(notes, found)


@pytest.mark.parametrize(
    ("damage", "compression"),
    [
        ("no index", None),
        ("cut off", Ros1Writer.CompressionFormat.LZ4),
        ("half a chunk", Ros1Writer.CompressionFormat.LZ4),
        ("half a file", None),
    ],
)
def test_an_unfinished_bag_of_ros_1(
    damage: str, compression: Ros1Writer.CompressionFormat | None, notes: bags.Notes, tmp_path: Path
) -> None:
    """An unfinished bag is read as far as it lasts, record by record where the index is missing."""
    path = bags.write_ros1(notes, tmp_path / "bag.bag", compression=compression)
    whole = path.read_bytes()
    place = whole.index(b"index_pos=") + len(b"index_pos=")
    index = int.from_bytes(whole[place : place + 8], "little")
    assert 0 < index < len(whole)
    data = {
        "no index": whole[:place] + bytes(8) + whole[place + 8 :],
        "cut off": whole[: index - 10],
        "half a chunk": whole[: index // 2] + bytes(50) + whole[index // 2 + 50 :],
        "half a file": whole[: index // 2],
    }[damage]
    assert data != whole
    path.write_bytes(data)
    if damage == "half a chunk":
        problems: list[str] = []
        assert len(list(open_bag(path).messages(problems))) < len(notes)
        assert problems[0].startswith("bag.bag: it is damaged")
        return
    found, problems = _read(open_bag(path))
    assert "bag.bag: it was not finished" in problems[0]
    if damage == "no index":
        assert len(problems) == 1
    if damage == "half a file":
        assert len(found) < len(notes)
        assert found
        assert "cut off" in problems[1]
    else:
        assert len(found) == len(notes)
    _assert_same(notes[: len(found)], found)


def test_protobuf_of_another_writer(tmp_path: Path) -> None:
    from google.protobuf.timestamp_pb2 import Timestamp
    from mcap_protobuf.writer import Writer as ProtobufWriter

    with (tmp_path / "bag.mcap").open("wb") as file, ProtobufWriter(file) as writer:
        writer.write_message("/when", Timestamp(seconds=12, nanos=34), log_time=5)
    (row,), problems = _read(open_bag(tmp_path / "bag.mcap"))
    assert row == ("/when", 5, {"seconds": 12, "nanos": 34})
    assert not problems


def test_json(tmp_path: Path) -> None:
    with (tmp_path / "bag.mcap").open("wb") as file:
        writer = McapWriter(file)
        writer.start()
        schema = writer.register_schema("state", "jsonschema", b"{}")
        channel = writer.register_channel("/state", "json", schema)
        body = {"timestamp": {"sec": 3, "nsec": 4}, "q": [0.1, 2], "name": ["a", "b"]}
        writer.add_message(channel, 7, json.dumps(body).encode(), 7)
        writer.finish()
    ((_, _, values),), problems = _read(open_bag(tmp_path / "bag.mcap"))
    assert stamp_of(values) == 3_000_000_004
    assert values["q"].tolist() == [0.1, 2.0]
    assert values["name"] == ["a", "b"]
    assert not problems


@pytest.mark.parametrize(("part", "use_chunking"), [(0.05, True), (0.7, True), (0.98, False)])
def test_a_truncated_bag_is_read_up_to_its_end(
    notes: bags.Notes, part: float, use_chunking: bool, tmp_path: Path
) -> None:
    path = bags.write_mcap(notes, tmp_path / "bag.mcap", use_chunking=use_chunking, chunk_size=20_000)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(len(whole) * part)])
    found, problems = _read(open_bag(path))
    assert len(problems) == (0 if len(found) == len(notes) else 1)
    _assert_same(notes[: len(found)], found)
    assert len(found) >= len(notes) * (part - 0.3)


def test_a_damaged_chunk_is_reported(notes: bags.Notes, tmp_path: Path) -> None:
    path = bags.write_mcap(notes, tmp_path / "bag.mcap", chunk_size=20_000)
    data = bytearray(path.read_bytes())
    middle = len(data) // 3
    data[middle : middle + 8] = bytes(8)
    assert bytes(data) != path.read_bytes()
    path.write_bytes(data)
    found, problems = _read(open_bag(path))
    assert len(problems) == 1
    assert 0 < len(found) < len(notes)


def test_no_folder_of_rosbag2(tmp_path: Path) -> None:
    (tmp_path / "metadata.yaml").write_text("a: [")
    with pytest.raises(BagError, match="cannot be read"):
        open_bag(tmp_path)
    (tmp_path / "metadata.yaml").write_text("rosbag2_bagfile_information: {relative_file_paths: [x.mcap]}")
    with pytest.raises(BagError, match=r"lacks its file x\.mcap"):
        open_bag(tmp_path)


HOSTILE = {
    "itself": b"Loop again\n" + b"=" * 80 + b"\nMSG: a/Loop\nLoop again\n",
    "unknown": b"b/Missing x\n",
    "code": b"float64 x = __import__('os').system('touch /tmp/ran')\n'''\n",
}


@pytest.mark.parametrize("name", sorted(HOSTILE))
def test_definitions_are_data(name: str) -> None:
    channel = ScannedChannel(
        topic="/x", type="a/msg/Top", encoding="cdr", schema_encoding="ros2msg", schema=HOSTILE[name]
    )
    with pytest.raises(UnknownEncodingError):
        decode_message(ScannedMessage(channel, 0, b""))
    assert not Path("/tmp/ran").exists()


def test_no_message_fills_the_memory() -> None:
    schema = b"float64[] values\nstring[] names\nb/E[] items\n" + b"=" * 80 + b"\nMSG: b/E\n"
    channel = ScannedChannel(topic="/x", type="a/msg/Top", encoding="cdr", schema_encoding="ros2msg", schema=schema)
    many = (2**32 - 1).to_bytes(4, "little")
    for data in (many, bytes(4) + many, bytes(8) + many, b""):
        with pytest.raises(ValueError, match="end"):
            decode_message(ScannedMessage(channel, 0, b"\x00\x01\x00\x00" + data))
