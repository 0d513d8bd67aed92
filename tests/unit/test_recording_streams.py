"""The table of streams: every row is read back as it was written, and a recording has the streams of its version."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.check import level_of, rewrite_messages
from support.recording import make_episode, write_episode

from demorec.core.errors import RecordingError
from demorec.episode.episode import Frame, Outcome
from demorec.episode.info import FORMAT_VERSION, EpisodeInfo
from demorec.mcap import EpisodeWriter, Recording, recover
from demorec.mcap.streams import frame_streams

NEWEST = [stream.topic for stream in frame_streams(make_episode(num_frames=1)[0]) if stream.since == FORMAT_VERSION]


def record(path: Path, info: EpisodeInfo, frames: list[Frame], outcome: Outcome) -> Path:
    with EpisodeWriter(path, info) as writer:
        for frame in frames:
            writer.write(frame)
        writer.finish(outcome)
    return path


@pytest.mark.parametrize("topic", NEWEST)
def test_a_stream_that_the_version_must_have_is_missed(topic: str, tmp_path: Path) -> None:
    whole = write_episode(tmp_path / "a.mcap", num_frames=5, cameras=())
    path = rewrite_messages(whole, tmp_path / "b.mcap", lambda m: [] if m[0] == topic else [m])
    with (
        Recording(path) as recording,
        pytest.raises(RecordingError, match=f"has 0 messages on {topic} at other times"),
    ):
        recording.columns()
    assert level_of(path, "topics") == "fail"
    with pytest.raises(RecordingError, match="no whole frame"):
        recover(path, tmp_path / "c.mcap")


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
        RecordingError,
        match=rf"not that of format version 1 \(its description is of format version {FORMAT_VERSION}\)",
    ):
        Recording(path)
