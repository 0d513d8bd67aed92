"""Depth in bags of ROS 1 and ROS 2: every distance is preserved, and third-party readers find it."""

from __future__ import annotations

import io
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from numpy.typing import NDArray
from PIL import Image
from support import bag_mappings, bags
from support.commands import exit_code

from demorec.check.report import CheckOptions, Subject, check_subject
from demorec.mcap import Recording
from demorec.mcap.lossless import encode_millimetres
from demorec.view.sources import find_episodes

COLOR = "/camera/wrist/color/image_raw"
DEPTH = "/camera/wrist/aligned_depth_to_color/image_raw"
MAPPING = f"""
{bag_mappings.SO101.split("[cameras.front]")[0]}
[cameras.wrist]
topic = "{COLOR}"
[cameras.wrist_depth]
topic = "{DEPTH}"
"""


def millimetres(time_ns: int) -> NDArray[np.uint16]:
    """Distances with holes, the largest 16-bit value, and noise that identifies the image."""
    values = np.random.default_rng(time_ns % 2**32).integers(300, 4000, (bags.HEIGHT, bags.WIDTH)).astype(np.uint16)
    values[:6] = 0
    values[10, 10] = 65535
    return values


def metres(time_ns: int) -> NDArray[np.float32]:
    """Distances that are not whole millimetres, with a hole, NaN and infinity."""
    values = millimetres(time_ns).astype(np.float32) / np.float32(997.3)
    values[7, :3] = [np.nan, np.inf, 0.0]
    return values


def png(values: NDArray[np.uint16]) -> bytes:
    stored = io.BytesIO()
    Image.fromarray(values).save(stored, "PNG")
    return stored.getvalue()


def body(kind: str, time_ns: int) -> dict[str, Any]:
    """The fields of a message, as realsense2_camera and compressed_depth_image_transport fill them in."""
    size = {"height": bags.HEIGHT, "width": bags.WIDTH}
    if kind in ("16UC1", "big endian"):
        data = millimetres(time_ns).astype(">u2" if kind == "big endian" else "<u2")
        padded = np.pad(data.view(np.uint8), ((0, 0), (0, 6)))  # rows may be padded
        return {
            "encoding": "16UC1",
            "step": padded.shape[1],
            "is_bigendian": kind == "big endian",
            "data": padded,
            **size,
        }
    if kind == "32FC1":
        return {"encoding": "32FC1", "step": 4 * bags.WIDTH, "data": metres(time_ns).view(np.uint8), **size}
    head = struct.pack("<iff", 0, 0.0, 0.0)
    if kind == "png":
        return {"format": "16UC1; compressedDepth png", "data": head + png(millimetres(time_ns))}
    return {"format": "16UC1; compressedDepth rvl", "data": encode_millimetres(millimetres(time_ns))}


def notes_with_depth(kind: str, moments: Sequence[int]) -> bags.Notes:
    """A follower, a leader, a colour camera, and depth images at the same times."""
    notes = [note for note in bags.so101(0.6) if "joint_states" in note.topic]
    notes += bags.raw_images(COLOR, moments, 1, "wrist_optical")
    name = "CompressedImage" if kind in ("png", "rvl") else "Image"

    def fields(moment: int) -> dict[str, Any]:
        found = body(kind, moment)
        return found | {"data": np.frombuffer(bytes(found["data"]), np.uint8)}

    notes += bags.messages(DEPTH, f"sensor_msgs/msg/{name}", moments, fields, latency_ns=21_000_000)
    return bags.in_order(notes)


def imported(kind: str, folder: Path, *, is_ros1: bool = False) -> tuple[Path, list[int]]:
    """A run, and the times of its depth images."""
    moments = bags.times(30, 0.6)
    bag = bags.write_mcap(notes_with_depth(kind, moments), folder / "bag.mcap", is_ros1=is_ros1)
    mapping = bag_mappings.write_mapping(MAPPING, folder / "robot.toml")
    assert exit_code("import", bag, "--mapping", mapping, "--out", folder / "run") == 0
    return folder / "run", moments


def recording_of(run: Path) -> Path:
    (path,) = (run / "episodes").glob("*.mcap")
    return path


def held(recording: Recording, moments: Sequence[int]) -> list[int]:
    """Times of the images in a recording."""
    stamps: list[int] = recording.table().image_stamps["wrist_depth"].tolist()
    assert set(stamps) <= set(moments)
    assert len(stamps) > 10
    return stamps


@pytest.mark.parametrize(
    ("kind", "is_ros1"),
    [("16UC1", False), ("16UC1", True), ("big endian", False), ("32FC1", False), ("png", True), ("rvl", False)],
)  # fmt: skip
def test_every_distance_is_kept(kind: str, is_ros1: bool, tmp_path: Path) -> None:
    run, moments = imported(kind, tmp_path, is_ros1=is_ros1)
    with Recording(recording_of(run)) as recording:
        assert (recording.cameras, recording.depth_cameras) == (("wrist",), ("wrist_depth",))
        camera = next(camera for camera in recording.info.cameras if camera.is_depth)
        assert camera.kept == ("32FC1" if kind == "32FC1" else "16UC1")
        stamps = held(recording, moments)
        expected = [metres(stamp) if kind == "32FC1" else millimetres(stamp) for stamp in stamps]
        for found, values in zip(recording.distances("wrist_depth"), expected, strict=True):
            assert found.dtype == values.dtype
            assert found.tobytes() == values.tobytes()


@pytest.mark.parametrize("kind", ["16UC1", "32FC1"])
def test_other_readers_find_it(kind: str, tmp_path: Path) -> None:
    run, moments = imported(kind, tmp_path)
    with recording_of(run).open("rb") as file:
        found = [
            message
            for _, channel, _, message in make_reader(
                file, decoder_factories=[DecoderFactory()]
            ).iter_decoded_messages()
            if channel.topic == "/camera/wrist_depth/depth"
        ]
    with Recording(recording_of(run)) as recording:
        stamps = held(recording, moments)
    assert [message.header.stamp.sec * bags.NS + message.header.stamp.nanosec for message in found] == stamps
    for message, stamp in zip(found, stamps, strict=True):
        if kind == "32FC1":
            assert (message.encoding, message.height, message.width) == ("32FC1", bags.HEIGHT, bags.WIDTH)
            assert (message.step, message.is_bigendian) == (4 * bags.WIDTH, 0)
            assert bytes(message.data) == metres(stamp).tobytes()
        else:
            assert message.format == "16UC1; compressedDepth rvl"


def test_every_command_accepts_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run, _ = imported("32FC1", tmp_path)
    report = check_subject(Subject(path=recording_of(run), kind="recording"), CheckOptions())
    assert not [result.check for result in report.results if result.verdict == "broken"]
    assert exit_code("info", recording_of(run)) == 0
    assert "64x48 32FC1 as it came" in capsys.readouterr().out
    assert exit_code("view", run, "--save", tmp_path / "view.rrd") == 0
    with find_episodes([run])[0].open() as episode:
        assert list(episode.depth) == ["wrist_depth"]
    assert exit_code("export", "lerobot", run, "--out", tmp_path / "plain", "--no-verify") == 0
    assert "left out without --depth: camera wrist_depth" in capsys.readouterr().out


FAULTS: dict[str, tuple[dict[str, Any], str]] = {
    "quantised": ({"format": "32FC1; compressedDepth png"}, "loses measured values"),
    "cut off": ({"data": np.zeros(15, np.uint8)}, "cut off"),
}


@pytest.mark.parametrize("name", sorted(FAULTS))
def test_other_images_are_refused_as_depth(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    change, told = FAULTS[name]
    notes = notes_with_depth("png", bags.times(30, 0.6))
    for note in notes:
        if note.topic == DEPTH:
            assert any(not np.array_equal(note.body[key], value) for key, value in change.items())
            note.body.update(change)
    bag = bags.write_mcap(notes, tmp_path / "bag.mcap")
    mapping = bag_mappings.write_mapping(MAPPING, tmp_path / "robot.toml")
    assert exit_code("import", bag, "--mapping", mapping, "--out", tmp_path / "run") == 1
    err = capsys.readouterr().err
    assert told in err
    assert err.count("\n") == 1
