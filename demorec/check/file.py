"""Checks of a recording's file: index, checksums, topics, messages, and the times of every stream.

External recordings have a separate clock for each stream.
"""

from __future__ import annotations

import struct
from collections import defaultdict, deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from demorec.check.base import Fault, Form, NotApplicableError, check, listed
from demorec.core.errors import RecordingError
from demorec.episode.episode import NO_IMAGE
from demorec.mcap import Recording, channels, messages
from demorec.mcap.container import Container
from demorec.mcap.streams import frame_times as nominal_times

MAX_MISSING_RATIO = 0.5
"""Maximum ratio of frames without an image: a camera that is missing more often shows nothing."""

_STAMP_FIRST = {
    "sensor_msgs/msg/JointState",
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/WrenchStamped",
    "sensor_msgs/msg/CompressedImage",
    "sensor_msgs/msg/Image",
    "foxglove_msgs/msg/CompressedVideo",
    "rcl_interfaces/msg/Log",
}
"""Types whose first field is a timestamp, alone or in a header."""
_STAMP = struct.Struct("<iI")
_STAMP_OFFSET = 4
"""Size of the CDR header before the first field, in bytes."""


@dataclass(frozen=True, kw_only=True, eq=False)
class TopicScan:
    """Messages of one topic, in file order."""

    schema: str
    time_ns: NDArray[np.int64]  # (N,)
    stamp_ns: NDArray[np.int64] | None  # (N,) timestamp inside each message; None for types without one


class CheckedEpisode(ExitStack):
    """One recording, closed at the end of a `with`. Properties raise RecordingError for missing data.

    The image check decodes colour images, too, unless `colours` is false.
    """

    def __init__(self, path: Path, *, colours: bool = True) -> None:
        super().__init__()
        self.path = path
        self.colours = colours

    def __exit__(self, *error: Any) -> bool | None:
        """Free everything: parts that refer to the whole would keep its images until the next garbage collection."""
        result = super().__exit__(*error)
        vars(self).clear()
        return result

    @cached_property
    def recording(self) -> Recording:
        """The open recording."""
        return self.enter_context(Recording(self.path))

    @cached_property
    def form(self) -> Form:
        """Simulated if there is a scene; a recording that cannot be opened counts as simulated."""
        with suppress(RecordingError):
            return "simulated" if self.recording.info.simulation is not None else "external"
        return "simulated"

    @cached_property
    def frame_times(self) -> NDArray[np.int64]:
        """(T,) nominal time of each frame, ns."""
        return nominal_times(self.recording.num_frames, self.recording.info.fps)

    @cached_property
    def scan(self) -> dict[str, TopicScan]:
        """Every message of every topic, read once; this verifies the checksum of every chunk."""
        with closing(Container(self.path)) as container:
            return _scan_topics(container)


def _scan_topics(container: Container) -> dict[str, TopicScan]:
    schemas = {name: container.schemas[channel.schema_id].name for name, channel in container.channels.items()}
    times: dict[str, list[int]] = defaultdict(list)
    stamps: dict[str, list[int]] = defaultdict(list)
    for topic, time_ns, data in container.messages(list(schemas)):
        times[topic].append(time_ns)
        if schemas[topic] in _STAMP_FIRST:
            stamps[topic].append(_stamp_ns(data))
    return {
        topic: TopicScan(
            schema=schema,
            time_ns=np.array(times[topic], dtype=np.int64),
            stamp_ns=np.array(stamps[topic], dtype=np.int64) if schema in _STAMP_FIRST else None,
        )
        for topic, schema in schemas.items()
    }


def _stamp_ns(data: bytes) -> int:
    """First field of a message; -1 for a message that is too short."""
    if len(data) < _STAMP_OFFSET + _STAMP.size:
        return -1
    seconds, nanoseconds = _STAMP.unpack_from(data, _STAMP_OFFSET)
    return int(seconds) * 1_000_000_000 + int(nanoseconds)


file_check = partial(
    check,
    family="files",
    on=("simulated", "external"),
    needs="a recording",
    why="The recording is damaged or incomplete.",
    do="demorec recover {path}, or record it again",
)
stream_check = partial(
    check,
    family="files",
    on=("simulated",),
    needs="a simulated scene",
    why="Streams and frames do not match.",
    do="record it again: the file was changed, or written wrongly",
)


@file_check(measures="recordings that cannot be opened")
def opens(episode: CheckedEpisode) -> Iterator[Fault]:
    """Verify the checksums of index and metadata, and the format version."""
    Recording(episode.path).close()
    return iter(())


@file_check(measures="damaged chunks, and messages that differ from the index")
def checksums(episode: CheckedEpisode) -> Iterator[Fault]:
    """Verify the checksum of every chunk, and the counts of the index."""
    counts = {topic: len(scan.time_ns) for topic, scan in episode.scan.items()}
    return listed(
        [
            f"{topic}: {counts[topic]}, the index has {count}"
            for topic, (_, count) in episode.recording.topics.items()
            if counts[topic] != count
        ]
    )


@stream_check(measures="topics that are missing or of another type")
def topics(episode: CheckedEpisode) -> Iterator[Fault]:
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
    return listed(wrong)


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


@file_check(measures="streams that do not decode into numbers")
def readable(episode: CheckedEpisode) -> Iterator[Fault]:
    """Decode every message by the layout in the metadata, at its frame's time."""
    list(episode.recording.events())
    list(episode.recording.subtasks)
    episode.recording.table()
    return iter(())


@file_check(measures="recordings that a crash cut off")
def complete(episode: CheckedEpisode) -> Iterator[Fault]:
    """Check for the outcome at the end of a recording."""
    if episode.recording.outcome is None:
        yield Fault(severity="look", message="recovered from a crash, no outcome")


@stream_check(measures="messages away from their frame's time", unit="ms")
def frame_times(episode: CheckedEpisode) -> Iterator[Fault]:
    """Compare the times of every stream of numbers with multiples of 1 / fps."""
    expected = episode.frame_times
    for topic in (stream.topic for stream in episode.recording.streams if stream.topic in episode.scan):
        times = episode.scan[topic].time_ns
        if topic == channels.JOINT_STATES and len(times) != len(expected):
            times = times[np.isin(times, expected)]  # the others are between frames
        count = min(len(times), len(expected))
        error_ns = np.abs(times[:count] - expected[:count])
        if error_ns.any():
            yield _late(topic, error_ns, int(np.argmax(error_ns)), "its frame")


@stream_check(measures="header timestamps that differ from the log time", unit="ms")
def stamps(episode: CheckedEpisode) -> Iterator[Fault]:
    """Compare the timestamp in each message's header, which ROS tools use, with its log time."""
    for topic, scan in episode.scan.items():
        if scan.stamp_ns is None or not len(scan.time_ns):
            continue
        error_ns = np.abs(scan.stamp_ns - scan.time_ns)
        if error_ns.any():
            time_ns = scan.time_ns[int(np.argmax(error_ns))]
            frame = max(int(np.searchsorted(episode.frame_times, time_ns, side="right")) - 1, 0)
            yield _late(topic, error_ns, frame, "its header's timestamp")


def _late(topic: str, error_ns: NDArray[np.int64], frame: int, reference: str) -> Fault:
    error = f"{error_ns.max() / 1e6:.4g} ms"
    return Fault(
        severity="broken", frames=(frame, frame), value=error, message=f"{topic} is up to {error} off {reference}"
    )


@stream_check(measures="images that are missing or far from a keyframe")
def video_frames(episode: CheckedEpisode) -> Iterator[Fault]:
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
            frame = int(off[0]) if len(off) else count
            yield Fault(
                severity="broken",
                frames=(frame, frame),
                value=f"{abs(len(times) - len(expected)) + len(off)} images",
                message=f"camera {camera.name}: {len(times)} images for {len(expected)} frames",
            )
            continue
        keyframes = episode.recording.keyframes(camera.name).tolist()
        gaps = np.diff([*keyframes, len(expected)]) if keyframes else np.array([len(expected)])
        if keyframes[:1] != [0] or (gaps > settings.gop).any():
            frame = keyframes[int(np.argmax(gaps))] if keyframes else 0
            yield Fault(
                severity="broken",
                frames=(frame, frame),
                message=f"camera {camera.name}: {len(keyframes)} keyframes, GOP {settings.gop}",
            )


@check(
    family="files",
    on=("external",),
    needs="a timestamp for each sample",
    measures="frames without an image of a camera",
    unit="% of frames",
    why="Images are missing.",
    do="record it again, or leave it out",
)
def missing_images(subject: CheckedEpisode) -> Iterator[Fault]:
    """Count the frames of each camera without an image."""
    for camera, numbers in subject.recording.table().images.items():
        without = np.flatnonzero(numbers == NO_IMAGE)
        if len(without):
            share = len(without) / len(numbers)
            yield Fault(
                severity="broken" if share > MAX_MISSING_RATIO else "look",
                frames=(int(without[0]), int(without[-1])),
                value=f"{share:.0%} of frames",
                message=f"camera {camera}: {len(without)} of {len(numbers)} frames have no image",
            )


@check(
    family="files",
    on=("simulated", "external"),
    measures="cameras whose images do not all decode",
    needs="images",
    why="Images are missing or damaged.",
    do="record it again, or leave it out",
    needs_images=True,
)
def images_decode(subject: CheckedEpisode) -> Iterator[Fault]:
    """Decode every image: colour, depth and labels."""
    recording = subject.recording
    streams: list[tuple[str, Callable[[str], Iterator[Any]]]] = []
    if subject.colours:
        shown = recording.table().images
        streams += [(camera, recording.images) for camera in recording.cameras if camera in shown]
    streams += [(camera, recording.distances) for camera in recording.depth_cameras]
    streams += [(camera, recording.segmentation) for camera in recording.cameras if recording.has_segmentation(camera)]
    if not streams:
        raise NotApplicableError("the recording has no images")
    wrong = []
    for camera, read in streams:
        try:
            deque(read(camera), maxlen=0)
        except RecordingError as error:
            wrong.append(f"{camera}: {error}")
    return listed(wrong)
