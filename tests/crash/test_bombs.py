"""Small recordings that unpack to gigabytes, hold millions of records or nest without end: one sentence, in limits."""

from __future__ import annotations

import json
import os
import struct
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import zstandard
from support.commands import exit_code
from support.export import export
from support.fuzz import LimitedCommands, problem_of
from support.mcap import chunk_record, message_record, record, rewritten
from support.recording import write_episode

from demorec.core.errors import RecordingError
from demorec.mcap import Recording
from demorec.robots.urdf import check_primitives

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def commands() -> Iterator[LimitedCommands]:
    with LimitedCommands() as process:
        yield process


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_episode(tmp_path_factory.mktemp("bombs") / "good.mcap", num_frames=12, cameras=())


def one_huge_chunk(good: Path, path: Path) -> None:
    """4 GB of zeros according to the zstd data; the chunk record claims a small size."""
    compressor = zstandard.ZstdCompressor(level=1).compressobj(size=4 << 30)
    zeros = bytes(1 << 24)
    packed = b"".join(compressor.compress(zeros) for _ in range(256)) + compressor.flush()
    path.write_bytes(rewritten(good, extra_chunks=[chunk_record(packed, size=1000, crc=1)]))


def many_large_chunks(good: Path, path: Path) -> None:
    """64 MB of records each."""
    content = record(200, bytes((64 << 20) - 9))
    chunk = chunk_record(zstandard.ZstdCompressor().compress(content), size=len(content), crc=zlib.crc32(content))
    path.write_bytes(rewritten(good, extra_chunks=[chunk] * 60))


def empty_messages(good: Path, path: Path) -> None:
    """Four million messages on an existing topic."""
    content = message_record(2, 0, b"") * 1_300_000
    chunk = chunk_record(zstandard.ZstdCompressor().compress(content), size=len(content), crc=zlib.crc32(content))
    path.write_bytes(rewritten(good, extra_chunks=[chunk] * 3))


BOMBS: tuple[Callable[[Path, Path], None], ...] = (one_huge_chunk, many_large_chunks, empty_messages)


@pytest.mark.parametrize(
    ("bomb", "command"),
    [(bomb, "check") for bomb in BOMBS]
    + [pytest.param(bomb, "recover", marks=pytest.mark.long if bomb is many_large_chunks else ()) for bomb in BOMBS],
)
def test_a_small_recording_never_becomes_large(
    bomb: Callable[[Path, Path], None], command: str, good: Path, commands: LimitedCommands, tmp_path: Path
) -> None:
    path = tmp_path / "bomb.mcap"
    bomb(good, path)
    assert path.stat().st_size < 1_000_000
    flags = ["--out", str(tmp_path / "kept.mcap")] if command == "recover" else []
    told = commands.run(command, path, *flags)
    assert problem_of(told) == "", told
    # Unknown records are valid, so a fast machine reads all of them within the limits.
    assert told.code == 1 or command == "recover" or bomb is many_large_chunks


@pytest.mark.parametrize("depth", [200, 100_000])
def test_metadata_nested_without_end(depth: int, good: Path, tmp_path: Path) -> None:
    text = '{"config": ' + "[" * depth + ("]" * depth if depth < 1000 else "") + "}"
    path = tmp_path / "nested.mcap"
    path.write_bytes(rewritten(good, change={"demorec.episode": {"info": text}}))
    with pytest.raises(RecordingError) as caught:
        Recording(path)
    assert len(str(caught.value)) < 600


def test_a_description_with_too_many_values(good: Path, commands: LimitedCommands, tmp_path: Path) -> None:
    path = tmp_path / "many.mcap"
    with Recording(good) as recording:
        found = recording._container.metadata("demorec.episode")
    assert found is not None
    info = json.loads(found["info"])
    info["simulation"]["scene"]["bodies"] = [{}] * 240_000
    path.write_bytes(rewritten(good, change={"demorec.episode": {"info": json.dumps(info)}}))
    assert len(commands.refused("info", path)) < 1000


def test_files_without_checksums_are_read(good: Path, tmp_path: Path) -> None:
    """A checksum of 0 means that there is none (MCAP specification); rosbag2 writes it."""
    path = tmp_path / "bare.mcap"
    path.write_bytes(rewritten(good, with_checksums=False))
    assert struct.unpack("<I", path.read_bytes()[-12:-8]) == (0,)
    with Recording(path) as recording, Recording(good) as original:
        assert recording.digest() == original.digest()


def _box(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I4s", 8 + len(content), kind) + content


@pytest.mark.parametrize(
    "table",
    [
        _box(b"stsz", struct.pack(">III", 0, 1, 10**9)),
        _box(b"stsz", struct.pack(">IIIII", 0, 0, 2, 2**31, 2**31)),
    ],
    ids=["images of a byte", "large images"],
)
def test_a_video_that_claims_too_many_images(table: bytes, commands: LimitedCommands, tmp_path: Path) -> None:
    recording = write_episode(tmp_path / "seen.mcap", num_frames=6, cameras=("front",))
    dataset = tmp_path / "dataset"
    export([recording], dataset)
    (video,) = dataset.rglob("*.mp4")
    whole = video.read_bytes()
    begin = whole.index(b"stsz") - 4
    (length,) = struct.unpack_from(">I", whole, begin)
    spoilt = whole[:begin] + table + _box(b"free", bytes(length)) + whole[begin + length :]
    video.write_bytes(spoilt)
    commands.refused("check", dataset, "--only", "undecodable_images")
    commands.refused("import", "lerobot", dataset, "--out", tmp_path / "run")


@pytest.mark.parametrize("name", ["meta/stats.json", "meta/tasks.parquet", "data/chunk-000/file-000.parquet"])
def test_fifos_in_a_dataset(name: str, good: Path, commands: LimitedCommands, tmp_path: Path) -> None:
    dataset = tmp_path / "dataset"
    export([good], dataset)
    (dataset / name).unlink()
    os.mkfifo(dataset / name)
    checks = ["--only", "unreadable_episodes", "contradicting_counts", "wrong_statistics"]
    assert "it is a FIFO" in commands.refused("check", dataset, *checks)
    commands.refused("export", "lerobot", good, "--out", dataset, "--append", "--no-verify")


def test_a_missing_lerobot_is_not_a_fault_of_a_dataset(
    good: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    export([good], tmp_path / "dataset")
    monkeypatch.setattr("demorec.extensions.doctor.checks.lerobot_opens.lerobot_is_installed", lambda: False)
    assert exit_code("check", tmp_path / "dataset", "--only", "lerobot_opens", "--lerobot") == 0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('<!DOCTYPE r [<!ENTITY a "b">]><robot/>', "has a document type"),
        ("<robot>" + " " * (5 << 20) + "</robot>", "characters, allowed are"),
        ('<robot><link name="a"/><joint name="j" type="fixed"/></robot>', "lacks its parent"),
        (
            """<robot><link name="r"/><link name="a"/><link name="b"/>
            <joint name="j" type="fixed"><parent link="a"/><child link="b"/></joint>
            <joint name="k" type="fixed"><parent link="b"/><child link="a"/></joint></robot>""",
            "must be one tree",
        ),
        (
            '<robot><link name="r"><visual><geometry><box size="1 nan 1"/></geometry></visual></link></robot>',
            "should be 3 finite numbers",
        ),
    ],
)
def test_invalid_urdfs(text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        check_primitives(text)
