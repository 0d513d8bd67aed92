"""The numbers of a recording as columns.

In a simulated episode all messages are at the times of the frames. In any other one `/frames` lists the samples and
images of each frame.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from demorec.core.errors import RecordingError
from demorec.episode.episode import NO_IMAGE, Table, Trajectory
from demorec.episode.info import EpisodeInfo
from demorec.mcap import messages
from demorec.mcap.channels import DELIBERATE_MISS, EVENTS, PHASE
from demorec.mcap.container import Container
from demorec.mcap.streams import FrameStream, frame_topic

_TABLE_BYTES = 1 << 20
"""Size of chunks that are decoded together: decoding takes several times as much memory."""

TimedMessages = list[tuple[int, bytes]]
"""(time_ns, data) of messages that are not sent at each frame."""


def read_columns(
    container: Container,
    info: EpisodeInfo,
    streams: Sequence[FrameStream],
    due_ns: NDArray[np.int64] | None,
    image_topics: Mapping[str, str],
) -> tuple[Table | Trajectory, TimedMessages]:
    """Read all streams in one pass, and the messages of events, which are stored among them.

    Args:
        due_ns: (T,) times of the frames of a simulation; None for any other episode.
        image_topics: Recorded camera -> topic of its images, in the order of the description.

    Raises:
        RecordingError: A stream is not at the times of the frames, or a frame shows an unknown image.
    """
    others: dict[str, TimedMessages] = {} if due_ns is None else {PHASE: [], DELIBERATE_MISS: [], EVENTS: []}
    times = defaultdict[str, list[NDArray[np.int64]]](list)
    values = defaultdict[str, list[NDArray[Any]]](list)
    topics = (*(stream.topic for stream in streams), *others)
    for blocks in container.blocks_by_chunk(topics, num_bytes=_TABLE_BYTES):
        for stream in streams:
            block = blocks[stream.topic]
            if stream.is_dense and due_ns is not None:
                block = block.select(np.isin(block.time_ns, due_ns))
            times[stream.topic].append(block.time_ns)
            values[stream.topic].append(stream.layout.decode(block.rows(len(stream.layout.constant))))
        for topic, timed in others.items():
            timed += zip(blocks[topic].time_ns.tolist(), blocks[topic].messages(), strict=True)
    time_ns = np.concatenate(times[frame_topic(info)]) if due_ns is None else due_ns
    if len(time_ns) > 1 and int(np.diff(time_ns).min()) <= 0:
        raise RecordingError(f"The frames of the recording are not in chronological order: {container.path}")
    kinds = ("features", "stamps", "images") if due_ns is None else ("sensed", "object_poses", "world_from_camera")
    columns: dict[str, Any] = {"time_ns": time_ns, **{kind: {} for kind in kinds}}
    for stream in streams:
        at = np.concatenate(times[stream.topic])
        if not np.array_equal(at, time_ns):
            raise RecordingError(
                f"The recording has {len(at)} messages on {stream.topic}, not one at the time of each of its "
                f"{len(time_ns)} frames: {container.path}"
            )
        stream.add_columns(np.concatenate(values[stream.topic]), columns)
    if due_ns is None:
        stamps = _image_stamps(container, image_topics)
        _check_images(columns["images"], stamps, container)
        return Table(**columns, image_stamps=stamps), []
    poses = columns.pop("world_from_camera")
    misses = _lasting(others[DELIBERATE_MISS], messages.read_boolean, due_ns, False)
    trajectory = Trajectory(
        **columns,
        world_from_camera={name: poses[name] for name in image_topics},
        phase=tuple(_lasting(others[PHASE], messages.read_string, due_ns, "")),
        is_deliberate_miss=np.array(misses, dtype=np.bool_),
    )
    return trajectory, others[EVENTS]


def _lasting[V](found: TimedMessages, read: Callable[[bytes], V], times: NDArray[np.int64], first: V) -> list[V]:
    """Compute the value at each time, given the messages that report its changes."""
    values = [first, *(read(data) for _, data in found)]
    changes = np.array([time_ns for time_ns, _ in found], dtype=np.int64)
    numbers = np.searchsorted(np.maximum.accumulate(changes), times, side="right")
    return [values[number] for number in numbers.tolist()]


def _image_stamps(container: Container, topics: Mapping[str, str]) -> dict[str, NDArray[np.int64]]:
    """Read camera -> (P,) timestamps of its images, one chunk at a time: all images may take gigabytes."""
    found = defaultdict[str, list[NDArray[np.int64]]](list)
    for blocks in container.blocks_by_chunk(topics.values()):
        for name, topic in topics.items():
            found[name].append(blocks[topic].time_ns)
    return {name: np.concatenate(times) for name, times in found.items()}


def _check_images(
    shown: Mapping[str, NDArray[np.int64]], stamps: Mapping[str, NDArray[np.int64]], container: Container
) -> None:
    for name, numbers in shown.items():
        count = len(stamps[name])
        if len(numbers) and not NO_IMAGE <= int(numbers.min()) <= int(numbers.max()) < count:
            raise RecordingError(
                f"A frame refers to an image of the camera {name!r} outside its {count}: {container.path}"
            )
