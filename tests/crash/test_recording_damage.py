"""Damaged files: reading any damaged recording gives one sentence or exactly the data that were written."""

from __future__ import annotations

import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from support.fuzz import changed_bytes
from support.mcap import rewritten
from support.recording import write_episode

from demorec.core.config import VideoConfig
from demorec.core.errors import RecordingError
from demorec.episode.info import FORMAT_VERSION
from demorec.extensions.recovery.recover import recover
from demorec.mcap import Recording

Damage = Callable[[bytes, random.Random], bytes]


def lose_the_front(data: bytes, rng: random.Random) -> bytes:
    return data[rng.randrange(1, len(data)) :]


def zero_a_sector(data: bytes, rng: random.Random) -> bytes:
    at = rng.randrange(len(data)) // 512 * 512
    return data[:at] + bytes(min(512, len(data) - at)) + data[at + 512 :]


def damage_the_index(data: bytes, rng: random.Random) -> bytes:
    """Flip a bit in the last fifth of the file, which holds the summary."""
    at = rng.randrange(len(data) * 4 // 5, len(data))
    return data[:at] + bytes([data[at] ^ (1 << rng.randrange(8))]) + data[at + 1 :]


DAMAGES: tuple[Damage, ...] = (
    changed_bytes,
    changed_bytes,
    lambda data, rng: data[: rng.randrange(len(data))],
    lose_the_front,
    zero_a_sector,
    damage_the_index,
)


def content(path: Path) -> tuple[Any, ...]:
    """Everything in a recording, read through every method."""
    with Recording(path) as recording:
        statistics = tuple(
            (camera, recording.pixel_statistics(camera).counts.tobytes(), recording.pixel_statistics(camera).num_images)
            for camera in recording.cameras
        )
        images = tuple(image.tobytes() for camera in recording.cameras for image in recording.images(camera))
        return (
            recording.digest(),
            recording.info,
            recording.outcome,
            recording.num_frames,
            tuple(sorted(recording.segment_names().items())),
            tuple(recording.video_settings(camera) for camera in recording.cameras),
            statistics,
            images,
        )


def check_message(error: RecordingError, path: Path) -> None:
    """Check that a message is one line that ends with the path."""
    message = str(error)
    assert "\n" not in message
    assert message.endswith(str(path))
    assert "Traceback" not in message


@pytest.fixture(scope="module")
def originals(tmp_path_factory: pytest.TempPathFactory) -> list[tuple[bytes, tuple[Any, ...]]]:
    """One recording of each codec: bytes and content."""
    folder = tmp_path_factory.mktemp("originals")
    found = []
    for codec in ("h264", "av1", "jpeg"):
        path = write_episode(
            folder / f"{codec}.mcap", num_frames=9, width=32, height=32, cameras=("front",),
            depth=codec == "h264", segmentation=codec == "h264", video=VideoConfig(codec=codec),
        )  # fmt: skip
        found.append((path.read_bytes(), content(path)))
    return found


@pytest.mark.slow
def test_damaged_files(originals: list[tuple[bytes, tuple[Any, ...]]], tmp_path: Path) -> None:
    num_refused, path = 0, tmp_path / "damaged.mcap"
    for seed in range(180):
        original, expected = originals[seed % len(originals)]
        path.write_bytes(DAMAGES[seed % len(DAMAGES)](original, random.Random(seed)))
        try:
            found = content(path)
        except RecordingError as error:
            check_message(error, path)
            num_refused += 1
        else:
            assert found == expected, f"wrong data, seed {seed}"
    assert num_refused > 50


@pytest.mark.slow
def test_recovering_damaged_files(originals: list[tuple[bytes, tuple[Any, ...]]], tmp_path: Path) -> None:
    """The result is the beginning of the episode, or one sentence."""
    num_recovered, path, kept = 0, tmp_path / "damaged.mcap", tmp_path / "kept.mcap"
    for seed in range(72):
        original, expected = originals[seed % len(originals)]
        path.write_bytes(DAMAGES[seed % len(DAMAGES)](original, random.Random(seed)))
        kept.unlink(missing_ok=True)
        try:
            recover(path, kept)
        except RecordingError as error:
            check_message(error, path)
            assert not kept.exists()
            continue
        with Recording(kept) as recording:
            images = tuple(image.tobytes() for image in recording.images("front"))
            assert recording.info == expected[1]
        assert 0 < len(images) <= expected[3]
        assert images == expected[-1][: len(images)]
        num_recovered += 1
    assert 10 < num_recovered < 62


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "The file is empty"),
        (b"\x89MCAP0\r\n", "cut off"),
        (b"\x89MC", "not an MCAP file"),
        (b"PK\x03\x04 a zip file, or so it says" * 99, "not an MCAP file"),
        (b"\x89MCAP0\r\n" + bytes(500) + b"\x89MCAP0\r\n", "damaged"),
    ],
)
def test_files_that_are_not_recordings(tmp_path: Path, data: bytes, message: str) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(data)
    with pytest.raises(RecordingError, match=message):
        Recording(path)


def test_a_foreign_mcap_file(tmp_path: Path) -> None:
    from mcap.writer import Writer

    path = tmp_path / "foreign.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        channel = writer.register_channel("/chatter", "json", 0)
        writer.add_message(channel, 1, b"{}", 1)
        writer.finish()
    with pytest.raises(RecordingError, match="not a demorec recording"):
        Recording(path)


@pytest.mark.parametrize("version", ["2", "99"])
def test_another_format_is_refused_by_its_number(version: str, tmp_path: Path) -> None:
    path = write_episode(tmp_path / "good.mcap", num_frames=2, cameras=())
    (tmp_path / "a.mcap").write_bytes(rewritten(path, change={"demorec.episode": {"format_version": version}}))
    with pytest.raises(RecordingError, match=f"format version {version}, but this demorec reads {FORMAT_VERSION}"):
        Recording(tmp_path / "a.mcap")
