"""Damaged files: reading any damaged recording gives one sentence or exactly the data that were written."""

from __future__ import annotations

import random
from collections import Counter
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
from demorec.mcap import Recording, recover

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


def is_one_sentence(message: str, path: Path) -> bool:
    """Whether a message is one line that ends with the path."""
    return "\n" not in message and message.endswith(str(path)) and "Traceback" not in message


class Fuzz:
    """One recording of each codec, and the results of reading damaged copies of them."""

    def __init__(self, folder: Path) -> None:
        self.target = folder / "damaged.mcap"
        self.originals = []
        for codec in ("h264", "av1", "jpeg"):
            path = write_episode(
                folder / f"{codec}.mcap",
                num_frames=9,
                width=32,
                height=32,
                cameras=("front",),
                depth=codec == "h264",
                segmentation=codec == "h264",
                video=VideoConfig(codec=codec),
            )
            self.originals.append((path.read_bytes(), content(path)))
        self.results: Counter[str] = Counter()

    def try_one(self, damage: Damage, seed: int) -> None:
        rng = random.Random(seed)
        original, expected = self.originals[seed % len(self.originals)]
        damaged = damage(original, rng)
        if damaged == original:  # a byte was replaced by itself: nothing was tried
            self.results["not damaged"] += 1
            return
        self.target.write_bytes(damaged)
        self.results["damaged"] += 1
        refusal = None
        try:
            found = content(self.target)
        except RecordingError as error:
            refusal = str(error)
        if refusal is None:
            assert found == expected, f"wrong data after {damage}, seed {seed}"
            self.results["read, all data right"] += 1
        else:
            assert is_one_sentence(refusal, self.target), refusal
            self.results["refused in one sentence"] += 1

    def try_recover(self, damage: Damage, seed: int) -> None:
        """Recover a file: the result must be a prefix of the episode or one sentence."""
        rng = random.Random(seed)
        original, expected = self.originals[seed % len(self.originals)]
        self.target.write_bytes(damage(original, rng))
        kept = self.target.with_name("kept.mcap")
        kept.unlink(missing_ok=True)
        refusal = None
        try:
            recover(self.target, kept)
        except RecordingError as error:
            refusal = str(error)
        if refusal is not None:
            assert is_one_sentence(refusal, self.target), refusal
            assert not kept.exists()
            self.results["nothing to recover"] += 1
            return
        with Recording(kept) as recording:
            images = tuple(image.tobytes() for image in recording.images("front"))
            assert recording.info == expected[1]
        assert 0 < len(images) <= expected[3]
        assert images == expected[-1][: len(images)]
        self.results["recovered"] += 1


@pytest.mark.slow
def test_damaged_files(tmp_path: Path) -> None:
    fuzz = Fuzz(tmp_path)
    for seed in range(180):
        fuzz.try_one(DAMAGES[seed % len(DAMAGES)], seed)
    assert fuzz.results["damaged"] >= 125
    assert fuzz.results["refused in one sentence"] > 50


@pytest.mark.slow
def test_recovering_damaged_files(tmp_path: Path) -> None:
    fuzz = Fuzz(tmp_path)
    for seed in range(72):
        fuzz.try_recover(DAMAGES[seed % len(DAMAGES)], seed)
    assert fuzz.results["recovered"] > 10
    assert fuzz.results["nothing to recover"] > 10


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
