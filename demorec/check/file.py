"""Checks of a recording's file: index, checksums, topics, messages, and the times of every stream.

External recordings have a separate clock for each stream.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from demorec.check.base import (
    Found,
    Measurement,
    check,
    counted,
    external_check,
    file_check,
    time_check,
    worst_frame,
)
from demorec.check.episode import CheckedEpisode
from demorec.episode.episode import NO_IMAGE
from demorec.mcap import channels, messages


@file_check(
    measures="recordings that cannot be opened",
)
def opens(episode: CheckedEpisode) -> Measurement:
    """Verify the checksums of index and metadata, and the format version."""
    return Measurement(value=0, detail=f"{episode.recording.num_frames} frames")


@file_check(
    measures="damaged chunks, and messages that differ from the index",
)
def checksums(episode: CheckedEpisode) -> Measurement:
    """Verify the checksum of every chunk and attachment, and the counts of the index."""
    counts = {topic: len(scan.time_ns) for topic, scan in episode.scan.items()}
    wrong = [
        f"{topic}: {counts[topic]}, the index has {count}"
        for topic, (_, count) in episode.recording.topics.items()
        if counts[topic] != count
    ]
    return counted(wrong, f"{sum(counts.values())} messages")


@check(
    group="file",
    measures="topics that are missing or of another type",
)
def topics(episode: CheckedEpisode) -> Measurement:
    """Find the streams that the metadata lists: each with its type and one message per frame."""
    num_frames = episode.recording.num_frames
    expected: dict[str, tuple[str, int | None]] = {}
    for stream in episode.recording.streams:
        expected[stream.topic] = (stream.schema, num_frames)
    for camera in episode.recording.info.simulated.scene.cameras:
        expected |= {topic: (schema, num_frames) for topic, schema in _image_streams(episode, camera.name)}
        expected[channels.camera_topic(camera.name, "camera_info")] = (messages.CAMERA_INFO, None)
    wrong = []
    for topic, (schema, count) in expected.items():
        found = episode.scan.get(topic)
        if found is None:
            wrong.append(f"{topic} is missing")
        elif found.schema != schema:
            wrong.append(f"{topic} is {found.schema}, expected {schema}")
        elif topic == channels.JOINT_STATES:
            # There may be more joint states than frames, but each frame needs one.
            missing = num_frames - len(set(found.time_ns.tolist()) & set(episode.frame_times.tolist()))
            if missing:
                wrong.append(f"{topic} lacks {missing} frames")
        elif count is not None and len(found.time_ns) != count:
            wrong.append(f"{topic} has {len(found.time_ns)} messages, expected {count}")
        elif len(found.time_ns) == 0:
            wrong.append(f"{topic} is empty")
    return counted(wrong, f"{len(expected)} topics")


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
)
def readable(episode: CheckedEpisode) -> Measurement:
    """Decode every message by the layout in the metadata, at its frame's time."""
    words = len(list(episode.recording.events())) + len(episode.recording.subtasks)
    return Measurement(value=0, detail=f"{episode.recording.table().num_frames} frames, {words} events and subtasks")


@file_check(
    measures="recordings that a crash cut off",
    fail=1,
)
def complete(episode: CheckedEpisode) -> Measurement:
    """Check for the outcome at the end of a recording."""
    cut = episode.recording.outcome is None
    return Measurement(value=int(cut), detail="recovered from a crash, no outcome" if cut else "")


@time_check(
    measures="messages away from their frame's time",
    unit="ms",
)
def frame_times(episode: CheckedEpisode) -> Iterator[Found]:
    """Compare the times of every stream of numbers with multiples of 1 / fps."""
    expected = episode.frame_times
    for topic in (stream.topic for stream in episode.recording.streams if stream.topic in episode.scan):
        times = episode.scan[topic].time_ns
        if topic == channels.JOINT_STATES and len(times) != len(expected):
            times = times[np.isin(times, expected)]  # the others are between frames
        count = min(len(times), len(expected))
        yield worst_frame(np.abs(times[:count] - expected[:count]) / 1e6, topic)


@time_check(
    measures="header timestamps that differ from the log time",
    unit="ms",
)
def stamps(episode: CheckedEpisode) -> Iterator[Found]:
    """Compare the timestamp in each message's header, which ROS tools use, with its log time."""
    for topic, scan in episode.scan.items():
        if scan.stamp_ns is None or not len(scan.time_ns):
            continue
        off = np.abs(scan.stamp_ns - scan.time_ns)
        index = int(np.argmax(off))
        frame = int(np.searchsorted(episode.frame_times, scan.time_ns[index], side="right")) - 1
        yield Measurement(value=float(off[index]) / 1e6, frame=max(frame, 0), detail=topic)


@time_check(
    measures="images that are missing or far from a keyframe",
)
def video_frames(episode: CheckedEpisode) -> Iterator[Found]:
    """Count each camera's encoded images: one per frame, at the frame's time, with a keyframe in every GOP."""
    expected = episode.frame_times
    for camera in episode.recording.info.simulated.scene.cameras:
        settings = episode.recording.video_settings(camera.name)
        topic = channels.video_topic(camera.name, settings.codec)
        scan = episode.scan.get(topic)
        times = np.empty(0, dtype=np.int64) if scan is None else scan.time_ns
        count = min(len(times), len(expected))
        off = np.flatnonzero(times[:count] != expected[:count])
        if len(times) != len(expected) or len(off):
            number = abs(len(times) - len(expected)) + len(off)
            frame = int(off[0]) if len(off) else count
            detail = f"camera {camera.name}: {len(times)} images for {len(expected)} frames"
            yield Measurement(value=number, frame=frame, detail=detail)
            continue
        keyframes = episode.recording.keyframes(camera.name).tolist()
        gaps = np.diff([*keyframes, len(expected)]) if keyframes else np.array([len(expected)])
        late = (0 if keyframes[:1] == [0] else 1) + int((gaps > settings.gop).sum())
        place = keyframes[int(np.argmax(gaps))] if late and keyframes else None
        detail = f"camera {camera.name}: {len(keyframes)} keyframes, GOP {settings.gop}"
        yield Measurement(value=late, frame=place, detail=detail)


@external_check(
    group="images",
    measures="frames without an image of a camera (share)",
    fail=0.5,
)
def missing_images(subject: CheckedEpisode) -> Iterator[Found]:
    """Count the frames of each camera without an image."""
    for camera, numbers in subject.recording.table().images.items():
        without = np.flatnonzero(numbers == NO_IMAGE)
        if len(numbers):
            first = int(without[0]) if len(without) else None
            text = f"camera {camera}: {len(without)} of {len(numbers)} frames"
            yield Measurement(value=len(without) / len(numbers), frame=first, detail=text)
