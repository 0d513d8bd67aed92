"""Do all streams tell the same time, and every frame its own."""

from __future__ import annotations

import numpy as np

from demorec.check.base import Measurement, check, worst
from demorec.check.episode import CheckedEpisode
from demorec.recording import channels
from demorec.recording.streams import frame_streams


def _once_a_frame(episode: CheckedEpisode) -> list[str]:
    topics = [stream.topic for stream in frame_streams(episode.info)]
    return [topic for topic in topics if topic in episode.scan]


@check(
    group="time",
    measures="largest distance of a message from its frame's time",
    unit="ms",
    warn=0,
    reads=("info.fps",),
)
def frame_times(episode: CheckedEpisode) -> Measurement | None:
    """Times rise in equal steps of 1 / fps from 0, the same on every stream of numbers."""
    expected = episode.frame_times
    found = []
    for topic in _once_a_frame(episode):
        times = episode.scan[topic].time_ns
        if topic == channels.JOINT_STATES and len(times) != len(expected):
            times = times[np.isin(times, expected)]  # states between the frames have check joint_sample_times
        count = min(len(times), len(expected))
        if count == 0:
            continue
        off = np.abs(times[:count] - expected[:count])
        frame = int(np.argmax(off))
        found.append(Measurement(value=float(off[frame]) / 1e6, frame=frame, detail=topic))
    return worst(*found)


@check(
    group="time",
    measures="joint states between frames that are out of order or off the physics clock",
    warn=0,
    reads=(
        "/joint_states",
        "info.physics_hz",
    ),
)
def joint_sample_times(episode: CheckedEpisode) -> Measurement | None:
    """Recorded at the physics rate, joint states rise in equal steps of 1 / physics_hz."""
    times = episode.scan[channels.JOINT_STATES].time_ns
    if len(times) == episode.num_frames:
        return None
    hz = episode.info.physics_hz
    expected = (np.arange(len(times), dtype=np.int64) * 2_000_000_000 + hz) // (2 * hz)
    wrong = np.flatnonzero(times != expected)
    frame = None if not len(wrong) else int(wrong[0] * episode.info.fps / hz)
    return Measurement(value=len(wrong), frame=frame, detail=f"{len(times)} joint states at {hz} Hz")


@check(
    group="time",
    measures="largest difference between a message's own stamp and its time",
    unit="ms",
    warn=0,
    reads=(
        "/joint_states",
        "/gripper",
        "/action",
        "/command",
        "/ee_pose",
        "/events",
        "/camera/{camera}/h264",
        "/camera/{camera}/video",
        "/camera/{camera}/depth",
        "/camera/{camera}/segmentation",
    ),
)
def stamps(episode: CheckedEpisode) -> Measurement | None:
    """The stamp in each message's header, which ROS tools go by, is the time at which it was logged."""
    found = []
    for topic, scan in episode.scan.items():
        if scan.stamp_ns is None or not len(scan.time_ns):
            continue
        off = np.abs(scan.stamp_ns - scan.time_ns)
        index = int(np.argmax(off))
        frame = int(np.searchsorted(episode.frame_times, scan.time_ns[index], side="right")) - 1
        found.append(Measurement(value=float(off[index]) / 1e6, frame=max(frame, 0), detail=topic))
    return worst(*found)


@check(
    group="time",
    measures="pictures missing, surplus, off their frame's time, or too far from a keyframe",
    warn=0,
    reads=(
        "/camera/{camera}/h264",
        "/camera/{camera}/video",
        "/camera/{camera}/image/compressed",
        "cameras.video.gop",
    ),
)
def video_frames(episode: CheckedEpisode) -> Measurement | None:
    """Each camera has one coded picture a frame at the frame's time, and a keyframe at least every GOP."""
    found = []
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
            detail = f"camera {camera.name}: {len(times)} pictures for {len(expected)} frames"
            found.append(Measurement(value=number, frame=frame, detail=detail))
            continue
        keyframes = [packet.frame_index for packet in episode.recording.packets(camera.name) if packet.is_keyframe]
        gaps = np.diff([*keyframes, len(expected)]) if keyframes else np.array([len(expected)])
        late = (0 if keyframes[:1] == [0] else 1) + int((gaps > settings.gop).sum())
        place = keyframes[int(np.argmax(gaps))] if late and keyframes else None
        detail = f"camera {camera.name}: {len(keyframes)} keyframes, GOP {settings.gop}"
        found.append(Measurement(value=late, frame=place, detail=detail))
    return worst(*found)
