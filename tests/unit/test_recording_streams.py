"""The table of streams: every row is read back as it was written, and a recording has the streams of its version."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from support.check import checked, level_of, rewrite_messages
from support.recording import make_episode, write_episode

from demorec.core.errors import RecordingError
from demorec.episode.episode import FORMAT_VERSION, Frame, Outcome, SimulatedColumns, SimulatedInfo
from demorec.mcap import SimulatedRecording, SimulatedWriter, recover
from demorec.mcap.recording import frames_of
from demorec.mcap.ros2 import DEFINITIONS
from demorec.mcap.streams import FrameValues, frame_streams, merged_columns

LATER = {stream.topic for stream in frame_streams(make_episode(num_frames=1)[0]) if stream.since > 1}
"""Topics that the first version did not have."""
NEWEST = [stream.topic for stream in frame_streams(make_episode(num_frames=1)[0]) if stream.since == FORMAT_VERSION]


def record(path: Path, info: SimulatedInfo, frames: list[Frame], outcome: Outcome) -> Path:
    with SimulatedWriter(path, info) as writer:
        for frame in frames:
            writer.write(frame)
        writer.finish(outcome)
    return path


def without_wrench(frames: list[Frame]) -> list[Frame]:
    return [replace(frame, observation=replace(frame.observation, sensed={})) for frame in frames]


def test_every_column_comes_from_one_stream() -> None:
    info, frames, _ = make_episode(num_frames=4)
    values = [FrameValues.of(frame) for frame in frames]
    found = []
    for stream in frame_streams(info):
        assert stream.schema in DEFINITIONS
        encoded = stream.encode([frame.time_ns for frame in frames], stream.rows(values))
        found.append(stream.columns(stream.layout.decode(encoded)))
    told = Counter(
        (name, *sorted(rows)) if isinstance(rows, Mapping) else (name,)
        for columns in found
        for name, rows in columns.items()
    )
    assert set(told.values()) == {1}
    others = {"time_ns", "phase", "is_deliberate_miss"}
    assert merged_columns(found).keys() == {field.name for field in fields(SimulatedColumns)} - others


def test_frames_are_rebuilt_to_the_bit(tmp_path: Path) -> None:
    info, frames, outcome = make_episode(num_frames=35, cameras=())
    with SimulatedRecording(record(tmp_path / "a.mcap", info, frames, outcome)) as recording:
        rebuilt = list(frames_of(recording))
    for found, true in zip(rebuilt, frames, strict=True):
        for part in ("observation", "action", "command"):
            for field in fields(getattr(true, part)):
                value = getattr(getattr(found, part), field.name)
                expected = getattr(getattr(true, part), field.name)
                if field.name == "sensed":
                    value, expected = value["wrench"], expected["wrench"]
                assert np.array_equal(value, expected) if isinstance(expected, np.ndarray) else value == expected, field


def test_a_recording_of_version_1_has_no_wrench(tmp_path: Path) -> None:
    info, frames, outcome = make_episode(num_frames=5, cameras=())
    old = replace(info, format_version=1)
    path = record(tmp_path / "old.mcap", old, without_wrench(frames), outcome)
    with (
        SimulatedRecording(path) as recording,
        SimulatedRecording(write_episode(tmp_path / "new.mcap", num_frames=5, cameras=())) as new,
    ):
        assert set(new.topics) - set(recording.topics) == LATER
        assert not recording.columns().sensed
        assert not recording[2].observation.sensed
        assert not [name for name in recording.to_pandas() if name.startswith("wrench")]
        assert recording.digest() != new.digest()
        digest = recording.digest()
    # What a frame knows beyond the version is not written: the recording is the same to the byte.
    again = record(tmp_path / "again.mcap", old, frames, outcome)
    assert again.read_bytes() == path.read_bytes()
    assert level_of(path, "topics") == "pass"
    # A crash loses nothing either.
    rescued = recover(path, tmp_path / "rescued.mcap").path
    with SimulatedRecording(rescued) as recording:
        assert recording.digest() == digest


@pytest.mark.parametrize("topic", NEWEST)
def test_a_stream_that_the_version_must_have_is_missed(topic: str, tmp_path: Path) -> None:
    whole = write_episode(tmp_path / "a.mcap", num_frames=5, cameras=())
    path = rewrite_messages(whole, tmp_path / "b.mcap", lambda m: [] if m[0] == topic else [m])
    with (
        SimulatedRecording(path) as recording,
        pytest.raises(RecordingError, match=f"has 0 messages on {topic} at other times"),
    ):
        recording.columns()
    assert level_of(path, "topics") == "fail"
    with pytest.raises(RecordingError, match="no whole frame"):
        recover(path, tmp_path / "c.mcap")


def test_one_bit_of_the_wrench_is_another_digest(tmp_path: Path) -> None:
    info, frames, outcome = make_episode(num_frames=5, cameras=())
    wrench = frames[3].observation.sensed["wrench"].copy()
    wrench[4] = np.nextafter(wrench[4], 99.0)
    changed = replace(frames[3], observation=replace(frames[3].observation, sensed={"wrench": wrench}))
    with (
        SimulatedRecording(record(tmp_path / "a.mcap", info, frames, outcome)) as one,
        SimulatedRecording(record(tmp_path / "b.mcap", info, [*frames[:3], changed, frames[4]], outcome)) as other,
    ):
        assert one.digest() != other.digest()


def test_stamps_of_the_wrench_are_checked(tmp_path: Path) -> None:
    whole = write_episode(tmp_path / "a.mcap", num_frames=5, cameras=())
    assert level_of(whole, "stamps") == "pass"

    def late(message: tuple[str, str, bytes, int]) -> list[tuple[str, str, bytes, int]]:
        topic, schema, data, time_ns = message
        return [(topic, schema, data[:4] + b"\x09" + data[5:] if topic == "/wrench" else data, time_ns)]

    path = rewrite_messages(whole, tmp_path / "b.mcap", late)
    (result,) = (row for row in checked(path, only=["stamps"]).results if row.check == "stamps")
    assert (result.level, result.detail) == ("fail", "/wrench")


def test_a_description_of_another_version_than_its_record_is_refused(tmp_path: Path) -> None:
    from demorec.mcap import metadata

    info, frames, outcome = make_episode(num_frames=2, cameras=())
    record(tmp_path / "a.mcap", info, frames, outcome)

    def relabelled(name: str, values: dict[str, str]) -> dict[str, str]:
        if name != metadata.EPISODE:
            return values
        content = {key: value for key, value in values.items() if key != "crc32"}
        return metadata.sealed({**content, "format_version": "1"})

    path = rewrite_messages(tmp_path / "a.mcap", tmp_path / "b.mcap", lambda m: [m], metadata=relabelled)
    with pytest.raises(
        RecordingError, match=r"not that of format version 1 \(its description is of format version 2\)"
    ):
        SimulatedRecording(path)
