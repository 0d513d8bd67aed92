"""Is the file whole: index, checksums, topics, readable to the last message."""

from __future__ import annotations

from collections.abc import Iterator

from demorec.check.base import Measurement, file_check
from demorec.check.episode import CheckedEpisode
from demorec.mcap import channels, messages
from demorec.mcap.streams import frame_streams


@file_check(
    measures="recordings that cannot be opened (index, metadata, format version)",
    on=("simulated", "external"),
    needs="a recording",
)
def opens(episode: CheckedEpisode) -> Measurement:
    """The index and the metadata pass their checksums and are of a known format version."""
    return Measurement(value=0, detail=f"format version {episode.recording.info.format_version}")


@file_check(
    measures="topics whose message count differs from the index; every chunk passes its CRC",
    on=("simulated", "external"),
    needs="a recording",
)
def checksums(episode: CheckedEpisode) -> Measurement:
    """Every byte that holds a message or an attachment passes its checksum, and the index counts them right."""
    counts = episode.message_counts
    wrong = [
        f"{topic}: {counts[topic]}, index says {count}"
        for topic, (_, count) in episode.recording.topics.items()
        if counts[topic] != count
    ]
    return Measurement(value=len(wrong), detail="; ".join(wrong[:3]) or f"{sum(counts.values())} messages")


@file_check(
    measures="topics that are missing, of another type or not one message a frame",
)
def topics(episode: CheckedEpisode) -> Measurement:
    """Every stream that the metadata promises is there, of its type, with one message for each frame."""
    expected: dict[str, tuple[str, int | None]] = {}
    for stream in frame_streams(episode.info):
        expected[stream.topic] = (stream.schema, episode.num_frames)
    for camera in episode.cameras:
        expected |= {topic: (schema, episode.num_frames) for topic, schema in _image_streams(episode, camera.name)}
        expected[channels.camera_topic(camera.name, "camera_info")] = (messages.CAMERA_INFO, None)
    wrong = []
    for topic, (schema, count) in expected.items():
        found = episode.scan.get(topic)
        if found is None:
            wrong.append(f"{topic} is missing")
        elif found.schema != schema:
            wrong.append(f"{topic} is {found.schema}, expected {schema}")
        elif topic == channels.JOINT_STATES:
            # There may be more joint states than frames, but one at each frame.
            missing = episode.num_frames - len(set(found.time_ns.tolist()) & set(episode.frame_times.tolist()))
            if missing:
                wrong.append(f"{topic} lacks {missing} frames")
        elif count is not None and len(found.time_ns) != count:
            wrong.append(f"{topic} has {len(found.time_ns)} messages, expected {count}")
        elif len(found.time_ns) == 0:
            wrong.append(f"{topic} is empty")
    return Measurement(value=len(wrong), detail="; ".join(wrong[:3]) or f"{len(expected)} topics")


def _image_streams(episode: CheckedEpisode, camera: str) -> Iterator[tuple[str, str]]:
    recording = episode.recording
    codec = recording.video_settings(camera).codec
    schema = messages.PROTOBUF_VIDEO if codec == "av1" else messages.COMPRESSED_IMAGE
    yield channels.video_topic(camera, codec), schema
    if codec == "h264":
        yield channels.camera_topic(camera, "video"), messages.COMPRESSED_VIDEO
    if recording.has_depth(camera):
        yield channels.camera_topic(camera, "depth"), messages.COMPRESSED_IMAGE
    if recording.has_segmentation(camera):
        yield channels.camera_topic(camera, "segmentation"), messages.COMPRESSED_IMAGE


@file_check(
    measures="streams that do not decode into numbers",
    on=("simulated", "external"),
    needs="a recording",
)
def readable(episode: CheckedEpisode) -> Measurement:
    """Every message has the layout that the metadata promises, at its frame's time."""
    return Measurement(value=0, detail=f"{episode.columns.num_frames} frames, {episode.num_words} events and subtasks")


@file_check(
    measures="recordings that a crash cut off (recovered, without an outcome)",
    fail=1,
    on=("simulated", "external"),
    needs="a recording",
)
def complete(episode: CheckedEpisode) -> Measurement:
    """The episode was recorded to its end."""
    cut = episode.recording.outcome is None
    return Measurement(value=int(cut), detail="recovered from a crash, no outcome" if cut else "")
