"""Is the file whole, readable to the last message, and do its streams tell the same time, every frame its own.

Of a recording that somebody else made, whose streams have clocks of their own: are these in order.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from demorec.check.base import Found, Measurement, NotMeasured, external_check, file_check, time_check, worst_frame
from demorec.check.episode import CheckedEpisode
from demorec.episode.episode import NO_IMAGE
from demorec.episode.info import FORMAT_VERSION
from demorec.mcap import channels, messages
from demorec.mcap.streams import frame_streams

_NANOSECONDS = 1_000_000_000


@file_check(
    measures="recordings that cannot be opened (index, metadata, format version)",
    on=("simulated", "external"),
    needs="a recording",
)
def opens(episode: CheckedEpisode) -> Measurement:
    """The index and the metadata pass their checksums and are of a known format version."""
    return Measurement(value=0, detail=f"format version {FORMAT_VERSION}")


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


@time_check(
    measures="largest distance of a message from its frame's time",
    unit="ms",
)
def frame_times(episode: CheckedEpisode) -> Iterator[Found]:
    """Times rise in equal steps of 1 / fps from 0, the same on every stream of numbers."""
    expected = episode.frame_times
    for topic in (stream.topic for stream in frame_streams(episode.info) if stream.topic in episode.scan):
        times = episode.scan[topic].time_ns
        if topic == channels.JOINT_STATES and len(times) != len(expected):
            times = times[np.isin(times, expected)]  # others are between the frames
        count = min(len(times), len(expected))
        yield worst_frame(np.abs(times[:count] - expected[:count]) / 1e6, topic)


@time_check(
    measures="largest difference between a message's own stamp and its time",
    unit="ms",
)
def stamps(episode: CheckedEpisode) -> Iterator[Found]:
    """The stamp in each message's header, which ROS tools go by, is the time at which it was logged."""
    for topic, scan in episode.scan.items():
        if scan.stamp_ns is None or not len(scan.time_ns):
            continue
        off = np.abs(scan.stamp_ns - scan.time_ns)
        index = int(np.argmax(off))
        frame = int(np.searchsorted(episode.frame_times, scan.time_ns[index], side="right")) - 1
        yield Measurement(value=float(off[index]) / 1e6, frame=max(frame, 0), detail=topic)


@time_check(
    measures="images missing, surplus, off their frame's time, or too far from a keyframe",
)
def video_frames(episode: CheckedEpisode) -> Iterator[Found]:
    """Each camera has one coded image a frame at the frame's time, and a keyframe at least every GOP."""
    expected = episode.frame_times
    for camera in episode.cameras:
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
        keyframes = episode.keyframes[camera.name].tolist()
        gaps = np.diff([*keyframes, len(expected)]) if keyframes else np.array([len(expected)])
        late = (0 if keyframes[:1] == [0] else 1) + int((gaps > settings.gop).sum())
        place = keyframes[int(np.argmax(gaps))] if late and keyframes else None
        detail = f"camera {camera.name}: {len(keyframes)} keyframes, GOP {settings.gop}"
        yield Measurement(value=late, frame=place, detail=detail)


@external_check(
    group="time",
    measures="frames and images that were dropped while recording",
    fail=float("inf"),
)
def drops(subject: CheckedEpisode) -> Found:
    """What came could be taken."""
    outcome = subject.recording.outcome
    if outcome is None:
        return NotMeasured(why="the recording has no outcome, which would tell")
    lost = ", ".join(f"{count} of {what}" for what, count in outcome.drops.items() if count)
    return Measurement(value=sum(outcome.drops.values()), detail=lost)


@external_check(
    group="time",
    measures="how much the frames' mean rate differs from the nominal one, as a share of it",
    warn=0.05,
    fail=0.5,
)
def rate(subject: CheckedEpisode) -> Found:
    """The frames came at the rate that the episode names, by which datasets and policies go."""
    times, fps = subject.columns.time_ns, subject.recording.info.fps
    if len(times) < 2:
        return None
    rate = (len(times) - 1) * _NANOSECONDS / float(times[-1] - times[0])
    return Measurement(value=abs(rate / fps - 1), detail=f"{rate:.4g} Hz instead of {fps} Hz")


@external_check(
    group="time",
    measures="the longest time between two frames, in nominal periods",
    warn=2.5,
    fail=30,
)
def gaps(subject: CheckedEpisode) -> Found:
    """No frames are missing between others."""
    steps = np.diff(subject.columns.time_ns)
    if not len(steps):
        return None
    frame = int(steps.argmax())
    periods = float(steps[frame]) * subject.recording.info.fps / _NANOSECONDS
    return Measurement(value=periods, frame=frame + 1, detail=f"{steps[frame] / 1e6:.4g} ms after the frame before")


@external_check(
    group="alignment",
    unit="s",
    measures="the largest distance between the stamps of a frame and of a sample that it holds",
    warn=0.1,
    fail=1.0,
)
def sample_age(subject: CheckedEpisode) -> Iterator[Found]:
    """What a frame holds was sensed at about its time."""
    columns = subject.columns
    for name in columns.stamps:
        yield worst_frame(np.abs(columns.age_ns(name)) / _NANOSECONDS, name)


@external_check(
    group="alignment",
    unit="s",
    measures="the largest distance between the stamps of a frame and of an image that it holds",
    warn=0.2,
    fail=1.0,
)
def image_age(subject: CheckedEpisode) -> Iterator[Found]:
    """The images that a frame holds were taken at about its time."""
    columns = subject.columns
    for camera, numbers in columns.images.items():
        frames = np.flatnonzero(numbers != NO_IMAGE)
        yield worst_frame(np.abs(columns.image_age_ns(camera)) / _NANOSECONDS, f"camera {camera}", frames=frames)


@external_check(
    group="images",
    measures="the share of frames that have no image of a camera",
    fail=0.5,
)
def missing_images(subject: CheckedEpisode) -> Iterator[Found]:
    """Every frame has an image of every camera."""
    for camera, numbers in subject.columns.images.items():
        without = np.flatnonzero(numbers == NO_IMAGE)
        if len(numbers):
            first = int(without[0]) if len(without) else None
            text = f"camera {camera}: {len(without)} of {len(numbers)} frames"
            yield Measurement(value=len(without) / len(numbers), frame=first, detail=text)
