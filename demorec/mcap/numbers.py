"""Reads the numbers of an episode as columns, by the layout that its recording has.

A simulated episode has the streams of `frame_streams`, one message of each at the time of each frame. Any other has a
topic for each feature, and `/frames`, which says which samples and images a frame holds.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from demorec.core.errors import RecordingError
from demorec.episode.episode import NO_PICTURE, Columns
from demorec.episode.info import EpisodeInfo
from demorec.mcap import channels, messages
from demorec.mcap.chunks import Block
from demorec.mcap.container import Container, damage_as_recording_error
from demorec.mcap.streams import (
    FRAMES,
    ColumnArrays,
    FrameStream,
    feature_streams,
    frame_streams,
    frames_layout,
    merged_columns,
)

_TABLE_BYTES = 1 << 20
"""Of chunks whose numbers are taken out together: taking out takes several times as much memory as they have."""


def frame_times(num_frames: int, fps: int) -> NDArray[np.int64]:
    """(T,) `frame_time_ns` of every frame."""
    return (np.arange(num_frames, dtype=np.int64) * 2_000_000_000 + fps) // (2 * fps)


def simulated_columns(
    container: Container, info: EpisodeInfo, num_frames: int, cameras: Sequence[str]
) -> tuple[Columns, Block]:
    """The columns of a simulated episode, and its events, which lie among the numbers in the file.

    Args:
        container: The open file.
        info: Of the episode.
        num_frames: T.
        cameras: Those that were recorded: before the first frame nobody knows which there are.

    Raises:
        RecordingError: A stream is damaged, or not at the times of the frames.
    """
    streams, times = frame_streams(info), frame_times(num_frames, info.fps)
    topics = [stream.topic for stream in streams]
    blocks = container.blocks((*topics, channels.PHASE, channels.DELIBERATE_MISS, channels.EVENTS))
    joint_states = blocks[channels.JOINT_STATES]  # there may be more of these between the frames
    blocks[channels.JOINT_STATES] = joint_states.select(np.isin(joint_states.time_ns, times))
    with damage_as_recording_error(container.path):
        columns = merged_columns(_columns_of(container, stream, blocks[stream.topic], times) for stream in streams)
        phases = _held(blocks[channels.PHASE], messages.read_string, times, "")
        misses = _held(blocks[channels.DELIBERATE_MISS], messages.read_boolean, times, False)
    columns["world_from_camera"] = {name: columns["world_from_camera"][name] for name in cameras}
    columns["pictures"] = dict.fromkeys(cameras, np.arange(num_frames, dtype=np.int64))
    columns["picture_stamps"] = dict.fromkeys(cameras, times)
    is_miss = np.array(misses, dtype=np.bool_)
    return Columns(time_ns=times, phase=tuple(phases), is_deliberate_miss=is_miss, **columns), blocks[channels.EVENTS]


def _columns_of(container: Container, stream: FrameStream, block: Block, times: NDArray[np.int64]) -> ColumnArrays:
    """The columns of a stream, which must have one message at each of `times` (T,)."""
    if not np.array_equal(block.time_ns, times):
        raise RecordingError(
            f"The recording has {len(block)} messages on {stream.topic} at other times than its "
            f"{len(times)} frames: {container.path}"
        )
    return stream.columns(stream.layout.decode_rows(block.rows(len(stream.layout.constant))))


def _held[V](block: Block, read: Callable[[bytes], V], times: NDArray[np.int64], first: V) -> list[V]:
    """The value that holds at each time, given the messages that tell its changes."""
    values = [first, *map(read, block.messages())]
    numbers = np.searchsorted(np.maximum.accumulate(block.time_ns), times, side="right")
    return [values[number] for number in numbers.tolist()]


class _Table:
    """The numbers of a topic, while the chunks that hold them are read.

    Args:
        length: Of each message, bytes.
        decode: Of messages as rows of bytes: their numbers.
    """

    def __init__(self, length: int, decode: Callable[[NDArray[np.uint8]], NDArray[Any]]) -> None:
        self._length, self._decode = length, decode
        self._times: list[NDArray[np.int64]] = []
        self._values = [decode(np.empty((0, length), np.uint8))]  # states how many there are in a row

    def add(self, block: Block) -> None:
        """Take messages; ValueError for those of another layout."""
        self._times.append(block.time_ns)
        self._values.append(self._decode(block.rows(self._length)))

    def whole(self) -> tuple[NDArray[np.int64], NDArray[Any]]:
        """(N,) times and (N, D) numbers of all messages."""
        return np.concatenate([np.empty(0, np.int64), *self._times]), np.concatenate(self._values)


def external_columns(container: Container, info: EpisodeInfo, picture_topics: Mapping[str, str]) -> Columns:
    """The columns of an episode that demorec did not simulate.

    Args:
        container: The open file.
        info: Of the episode.
        picture_topics: Camera -> topic of its images, in the order of `info`.

    Raises:
        RecordingError: A stream is damaged, not at the times of the frames, or a frame holds an image that is none.
    """
    streams, layout = feature_streams(info), frames_layout(info)
    tables = {FRAMES: _Table(len(layout.constant), layout.decode_rows)}
    for stream in streams.values():
        tables[stream.topic] = _Table(len(stream.layout.constant), stream.decode_rows)
    with damage_as_recording_error(container.path):
        for blocks in container.blocks_by_chunk(tables, num_bytes=_TABLE_BYTES):
            for topic, table in tables.items():
                table.add(blocks[topic])
    time_ns, rows = tables[FRAMES].whole()
    if len(time_ns) > 1 and int(np.diff(time_ns).min()) <= 0:
        raise RecordingError(f"The frames of the recording are not in the order of their times: {container.path}")
    features = {}
    for name, stream in streams.items():
        times, features[name] = tables.pop(stream.topic).whole()
        if not np.array_equal(times, time_ns):
            raise RecordingError(
                f"The recording has {len(times)} messages on {stream.topic} at other times than its "
                f"{len(time_ns)} frames: {container.path}"
            )
    pictures = {name: rows[:, len(streams) + index].copy() for index, name in enumerate(picture_topics)}
    picture_stamps = {name: _stamps(container, topic) for name, topic in picture_topics.items()}
    for name, numbers in pictures.items():
        count = len(picture_stamps[name])
        if len(numbers) and not NO_PICTURE <= int(numbers.min()) <= int(numbers.max()) < count:
            raise RecordingError(
                f"A frame holds an image of the camera {name!r} that is none of its {count}: {container.path}"
            )
    return Columns(
        time_ns=time_ns,
        features=features,
        stamps={name: rows[:, index].copy() for index, name in enumerate(streams)},
        pictures=pictures,
        picture_stamps=picture_stamps,
    )


def _stamps(container: Container, topic: str) -> NDArray[np.int64]:
    """(N,) of the messages of a topic, one chunk of them in memory at a time: images may take gigabytes."""
    return np.fromiter((message.time_ns for message in container.messages((topic,))), dtype=np.int64)
