"""Bags and mappings of less than a megabyte that claim, nest or compute without end: one sentence, within limits.

Expected values follow from the format's definition; a separate process measures memory and time.
"""

from __future__ import annotations

import io
import sqlite3
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
import zstandard
from mcap.writer import Writer
from PIL import Image
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin
from support import bag_mappings, bags
from support.fuzz import LimitedCommands, problem_of

pytestmark = pytest.mark.slow

MAPPING = (
    bag_mappings.HEAD.format(robot="r")
    + """
[[features."observation.state"]]
topic = "/joints"
field = "position"
[[features.action]]
next = "observation.state"
[cameras.front]
topic = "/image"
"""
)
_SEPARATOR = "=" * 80 + "\n"


@pytest.fixture(scope="module")
def commands() -> Iterator[LimitedCommands]:
    with LimitedCommands(("demorec.extensions.imports.suggest", "demorec.extensions.imports.import_run")) as process:
        yield process


def _mcap(path: Path, kind: str, encoding: str, schema: bytes, of_message: str, messages: Sequence[bytes]) -> Path:
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        channel = writer.register_channel("/joints", of_message, writer.register_schema(kind, encoding, schema))
        for number, data in enumerate(messages):
            writer.add_message(channel, bags.EPOCH_NS + number * 10**7, data, 0)
        writer.finish()
    return path


def _nested(line: str, depth: int, last: str) -> bytes:
    """A definition of `depth` types, each with the fields `line`, in which %d is the number of the next type."""
    parts = [line.replace("%d", str(number + 1)) for number in range(depth)]
    return _SEPARATOR.join(
        [parts[0], *(f"MSG: a/T{k + 1}\n{part}" for k, part in enumerate([*parts[1:], last]))]
    ).encode()


def two_fields_a_type(folder: Path) -> Path:
    """2^31 fields of 31 types."""
    schema = _nested("a/T%d x\na/T%d y\n", 31, "uint8[0] x\n")
    return _mcap(folder / "bag.mcap", "a/msg/T0", "ros2msg", schema, "cdr", [b"\x00\x01\x00\x00" + bytes(5000)] * 2)


def lists_of_nothing(folder: Path) -> Path:
    """JSON of 60 MB, which compresses to some kilobytes: 20 million lists."""
    text = b'{"position": [' + b"[]," * 20_000_000 + b"[]]}"
    return _mcap(folder / "bag.mcap", "x", "jsonschema", b"{}", "json", [text])


def messages_that_claim_64_megabytes(folder: Path) -> Path:
    """Each compressed by itself, as rosbag2 can: 40 images of zeros in 100 kB."""
    packed = zstandard.ZstdCompressor(level=19).compress(bytes(64_000_000))
    notes = bags.in_order(bags.so101(0.3))
    folder = bags.write_rosbag2(notes, folder / "bag")
    text = (folder / "metadata.yaml").read_text()
    text = text.replace("compression_format: ''", "compression_format: zstd")
    (folder / "metadata.yaml").write_text(text.replace("compression_mode: ''", "compression_mode: message"))
    assert "compression_mode: message" in (folder / "metadata.yaml").read_text()
    data = [bags.Note(topic=note.topic, type=note.type, log_ns=note.log_ns, header_ns=0, data=packed) for note in notes]
    bags.write_mcap(data, next(folder.glob("*.mcap")))
    return folder


def images_of_nothing(folder: Path) -> Path:
    """60 PNG files of 4000x4000 pixels, all black."""
    png = io.BytesIO()
    Image.fromarray(np.zeros((4000, 4000), np.uint8)).save(png, format="PNG", compress_level=9)
    data = np.frombuffer(png.getvalue(), np.uint8)
    notes = bags.joints("/joints", ("a", "b"), bags.times(50, 2.2))
    for moment in bags.times(30, 2.0):
        body = {"format": "png", "data": data}
        notes.append(
            bags.Note(
                topic="/image", type="sensor_msgs/msg/CompressedImage", log_ns=moment, header_ns=moment, body=body
            )
        )
    return bags.write_mcap(bags.in_order(notes), folder / "bag.mcap")


def a_chunk_of_zeros(folder: Path) -> Path:
    """A bag of ROS 1 whose image unpacks to 300 MB, by bzip2."""
    zeros = np.zeros(300_000_000, np.uint8)
    body = {"encoding": "rgb8", "width": 10_000, "height": 10_000, "step": 30_000, "data": zeros}
    note = bags.Note(
        topic="/image", type="sensor_msgs/msg/Image", log_ns=bags.EPOCH_NS, header_ns=bags.EPOCH_NS, body=body
    )
    return bags.write_ros1([note], folder / "bag.bag", compression=Ros1Writer.CompressionFormat.BZ2)


BAGS = (
    two_fields_a_type,
    lists_of_nothing,
    messages_that_claim_64_megabytes,
    images_of_nothing,
    a_chunk_of_zeros,
)


def _size(bag: Path) -> int:
    return sum(path.stat().st_size for path in (bag.iterdir() if bag.is_dir() else [bag]))


@pytest.mark.parametrize("make", BAGS)
def test_a_small_bag_never_becomes_large(
    make: Callable[[Path], Path], commands: LimitedCommands, tmp_path: Path
) -> None:
    bag = make(tmp_path)
    assert _size(bag) < 1_000_000
    text = MAPPING
    if make is not images_of_nothing:
        text = text[: text.index("[cameras")]
    if bag.is_dir():
        text = bag_mappings.SO101
    mapping = bag_mappings.write_mapping(text, tmp_path / "mapping.toml")
    told = commands.run("import", bag, "--mapping", mapping, "--out", tmp_path / "run")
    assert problem_of(told) == "", told
    assert told.code in (1, 2), told
    *progress, sentence = told.text.splitlines()
    assert sentence.startswith("demorec import: "), told.text
    assert all(line.startswith("importing: ") for line in progress), told.text  # of a busy machine
    assert len(sentence) < 1500
    assert not list(tmp_path.glob("run/episodes/*.mcap"))


def _joints(folder: Path, moments: Sequence[int] | None = None, names: Sequence[str] = ("a", "b")) -> Path:
    moments = bags.times(50, 0.5) if moments is None else moments
    return bags.write_mcap(bags.joints("/joints", names, moments), folder / "joints.mcap")


_NO_CAMERA = MAPPING[: MAPPING.index("[cameras")]
MAPPINGS: dict[str, tuple[str, str]] = {
    "lists in lists": ("x = " + "[" * 100_000 + "]" * 100_000 + "\n", "nested too deeply"),
    "20,000 unknown keys": (_NO_CAMERA + "[cloak]\n" + "".join(f"keyy{k} = 1\n" for k in range(20_000)), "unknown key"),
    "a trim of 1e300 s": (_NO_CAMERA.replace("fps = 30", "fps = 30\nmax_trim_s = 1e300"), "max_trim_s is 1e+300"),
    "an infinity": (_NO_CAMERA.replace("fps = 30", "fps = 30\nmax_trim_s = inf"), "is not a finite number"),
    "NUL in urdf": (_NO_CAMERA.replace('name = "r"', 'name = "r"\nurdf = "a\\u0000b"'), "The URDF cannot be read"),
}  # fmt: skip


@pytest.mark.parametrize("name", sorted(MAPPINGS))
def test_a_mapping_is_bounded(name: str, commands: LimitedCommands, tmp_path: Path) -> None:
    text, told = MAPPINGS[name]
    mapping = bag_mappings.write_mapping(text, tmp_path / "mapping.toml")
    answer = commands.run("import", _joints(tmp_path), "--mapping", mapping, "--out", tmp_path / "run")
    assert problem_of(answer) == "", answer
    assert answer.code in (1, 2)
    assert told in answer.text, answer.text
    assert answer.text.count("\n") == 1
    assert len(answer.text) < 2000


def test_a_link_out_of_the_bag_is_not_followed(tmp_path: Path, commands: LimitedCommands) -> None:
    bag = bags.write_rosbag2(bags.in_order(bags.so101(0.3)), tmp_path / "bag")
    (file,) = bag.glob("*.mcap")
    elsewhere = file.rename(tmp_path / "elsewhere.mcap")
    file.symlink_to(elsewhere)
    told = commands.run("import", "--suggest", bag)
    assert told.code == 1
    assert "is a link to another folder" in told.text
    assert commands.run("import", "--suggest", elsewhere).code == 0
    beside = elsewhere.rename(bag / "beside.mcap")
    file.unlink()
    file.symlink_to(beside.name)
    assert commands.run("import", "--suggest", bag).code == 0


def test_a_database_with_a_journal(tmp_path: Path, commands: LimitedCommands) -> None:
    """A recorder that was killed in SQLite's WAL mode has left its last messages in the journal."""
    bag = bags.write_rosbag2(bags.in_order(bags.so101(0.3)), tmp_path / "sql", storage=StoragePlugin.SQLITE3)
    path, copy = next(bag.glob("*.db3")), tmp_path / "copy" / "bag.db3"
    copy.parent.mkdir()
    with closing(sqlite3.connect(path)) as database:
        database.execute("PRAGMA journal_mode = WAL")
        with database:
            database.execute("INSERT INTO messages (topic_id, timestamp, data) SELECT 1, 7, x'00010000'")
        copy.write_bytes(path.read_bytes())
        (journal := Path(f"{copy}-wal")).write_bytes(Path(f"{path}-wal").read_bytes())
    assert journal.stat().st_size > 0
    told = commands.run("import", "--suggest", copy)
    assert "bag.db3-wal" in told.text, told.text
    assert copy.parent.joinpath("bag.db3-wal").stat().st_size > 0
