"""Do all streams tell the same time, and every frame its own."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from demorec.check.base import Found, Measurement, time_check, worst_frame
from demorec.check.episode import CheckedEpisode
from demorec.mcap import channels
from demorec.mcap.streams import frame_streams


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
