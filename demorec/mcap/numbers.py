"""Reads the numbers of an episode as columns, by the streams that its recording has."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from demorec.core.errors import RecordingError
from demorec.episode.episode import NO_IMAGE, Columns
from demorec.episode.info import EpisodeInfo
from demorec.mcap import channels, messages
from demorec.mcap.chunks import Block
from demorec.mcap.container import Container, damage_as_recording_error
from demorec.mcap.streams import FRAMES, ColumnArrays, FrameStream, frame_streams, merged_columns

_TABLE_BYTES = 1 << 20
"""Of chunks whose numbers are taken out together: taking out takes several times as much memory as they have."""

Said = list[tuple[int, bytes]]
"""When, and what: messages that do not come at each frame."""


def frame_times(num_frames: int, fps: int) -> NDArray[np.int64]:
    """(T,) `frame_time_ns` of every frame."""
    return (np.arange(num_frames, dtype=np.int64) * 2_000_000_000 + fps) // (2 * fps)


class _Table:
    """The numbers of a stream, while the chunks that hold them are read."""

    def __init__(self, stream: FrameStream) -> None:
        self._stream, layout = stream, stream.layout
        self._length, self._decode = len(layout.constant), layout.decode_rows
        self._times: list[NDArray[np.int64]] = [np.empty(0, np.int64)]
        self._values = [self._decode(np.empty((0, self._length), np.uint8))]  # states how many there are in a row

    def add(self, block: Block) -> None:
        """Take messages; ValueError for those of another layout."""
        self._times.append(block.time_ns)
        self._values.append(self._decode(block.rows(self._length)))

    @property
    def times(self) -> NDArray[np.int64]:
        """(N,) of all messages."""
        return np.concatenate(self._times)

    def columns(self, time_ns: NDArray[np.int64], container: Container) -> ColumnArrays:
        """What the messages become; RecordingError unless there is one at each of `time_ns` (T,)."""
        if not np.array_equal(times := self.times, time_ns):
            raise RecordingError(
                f"The recording has {len(times)} messages on {self._stream.topic} at other times than its "
                f"{len(time_ns)} frames: {container.path}"
            )
        return self._stream.columns(np.concatenate(self._values))


def read_columns(
    container: Container, info: EpisodeInfo, num_frames: int, image_topics: Mapping[str, str]
) -> tuple[Columns, Said]:
    """The columns of an episode, and its events, which lie among the numbers in the file.

    Args:
        container: The open file.
        info: Of the episode.
        num_frames: T.
        image_topics: Recorded camera -> topic of its images, in the order of `info`.

    Raises:
        RecordingError: A stream is damaged, not at the times of the frames, or a frame holds an image that is none.
    """
    is_simulated = info.simulation is not None
    tables = {stream.topic: _Table(stream) for stream in frame_streams(info)}
    said: dict[str, Said] = {
        topic: [] for topic in (channels.PHASE, channels.DELIBERATE_MISS, channels.EVENTS) if is_simulated
    }
    due = frame_times(num_frames, info.fps)
    with damage_as_recording_error(container.path):
        for blocks in container.blocks_by_chunk((*tables, *said), num_bytes=_TABLE_BYTES):
            for topic, table in tables.items():
                block = blocks[topic]
                if is_simulated and topic == channels.JOINT_STATES:  # there may be more of these between the frames
                    block = block.select(np.isin(block.time_ns, due))
                table.add(block)
            for topic, found in said.items():
                found += zip(blocks[topic].time_ns.tolist(), blocks[topic].messages(), strict=True)
        time_ns = due if is_simulated else tables[FRAMES].times
        if len(time_ns) > 1 and int(np.diff(time_ns).min()) <= 0:
            raise RecordingError(f"The frames of the recording are not in the order of their times: {container.path}")
        columns = merged_columns(table.columns(time_ns, container) for table in tables.values())
        if is_simulated:
            columns["phase"] = tuple(_held(said[channels.PHASE], messages.read_string, time_ns, ""))
            misses = _held(said[channels.DELIBERATE_MISS], messages.read_boolean, time_ns, False)
            columns["is_deliberate_miss"] = np.array(misses, dtype=np.bool_)
    if is_simulated:
        columns["world_from_camera"] = {name: columns["world_from_camera"][name] for name in image_topics}
        columns["images"] = dict.fromkeys(image_topics, np.arange(num_frames, dtype=np.int64))
        columns["image_stamps"] = dict.fromkeys(image_topics, time_ns)
    else:
        columns["image_stamps"] = _stamps(container, image_topics)
        _check_images(columns["images"], columns["image_stamps"], container)
    return Columns(time_ns=time_ns, **columns), said.get(channels.EVENTS, [])


def _held[V](said: Said, read: Callable[[bytes], V], times: NDArray[np.int64], first: V) -> list[V]:
    """The value that holds at each time, given the messages that tell its changes."""
    values = [first, *(read(data) for _, data in said)]
    changes = np.array([time_ns for time_ns, _ in said], dtype=np.int64)
    numbers = np.searchsorted(np.maximum.accumulate(changes), times, side="right")
    return [values[number] for number in numbers.tolist()]


def _check_images(
    images: Mapping[str, NDArray[np.int64]], stamps: Mapping[str, Sequence[int]], container: Container
) -> None:
    """Raise RecordingError when a frame holds an image that is not there."""
    for name, numbers in images.items():
        count = len(stamps[name])
        if len(numbers) and not NO_IMAGE <= int(numbers.min()) <= int(numbers.max()) < count:
            raise RecordingError(
                f"A frame holds an image of the camera {name!r} that is none of its {count}: {container.path}"
            )


def _stamps(container: Container, topics: Mapping[str, str]) -> dict[str, NDArray[np.int64]]:
    """Name -> (N,) of the messages of its topic, one chunk of them in memory at a time: images may take gigabytes."""
    found: dict[str, list[NDArray[np.int64]]] = {name: [np.empty(0, np.int64)] for name in topics}
    for blocks in container.blocks_by_chunk(set(topics.values())):
        for name, topic in topics.items():
            found[name].append(blocks[topic].time_ns)
    return {name: np.concatenate(times) for name, times in found.items()}
