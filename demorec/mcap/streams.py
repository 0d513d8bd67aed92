"""Streams with one message at each frame, and how their messages become columns.

`demorec.mcap.simulated_streams` and `demorec.mcap.sampled_streams` list them; writer, reader, recovery and checks use
these lists.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from demorec.core.errors import RecordingError
from demorec.core.geometry import Array
from demorec.mcap import messages
from demorec.mcap.cdr import Layout, Slot, layout
from demorec.mcap.container import Container, damage_as_recording_error

_TABLE_BYTES = 1 << 20
"""Size of chunks that are decoded together: decoding takes several times as much memory."""

ColumnArrays = dict[str, NDArray[Any] | dict[str, NDArray[Any]]]
"""Field of `Trajectory` or `Table` -> its rows, or name -> rows if the field is a mapping."""

TimedMessages = list[tuple[int, bytes]]
"""(time_ns, data) of messages that are not sent at each frame."""


@dataclass(frozen=True, eq=False)
class FrameStream:
    """Stream with one message at each frame.

    Attributes:
        topic: Topic.
        schema: ROS 2 type.
        layout: Layout of the messages, with K values each.
        rows: Values (N, K) of N frames (`FrameValues` of a simulation, `SampledFrame` of any other episode).
        columns: The values (T, K) of T messages as columns.
        stamp_ns: Stamp in the header of a frame's message; None for the frame's time.
        is_dense: Whether there may be messages between the frames.
    """

    topic: str
    schema: str
    layout: Layout
    rows: Callable[[Sequence[Any]], NDArray[Any]]
    columns: Callable[[NDArray[Any]], ColumnArrays]
    stamp_ns: Callable[[Any], int] | None = None
    is_dense: bool = False

    def encode(self, frames: Sequence[Any], time_ns: Sequence[int]) -> list[bytes]:
        """Encode one message for each frame, at its time."""
        stamps = time_ns if self.stamp_ns is None else list(map(self.stamp_ns, frames))
        return self.layout.encode(np.array(stamps, dtype=np.int64), self.rows(frames))


def concatenated(parts: Callable[[Any], Sequence[Array]]) -> Callable[[Sequence[Any]], Array]:
    """Build the `rows` of a stream from the parts of a frame that its message concatenates."""

    def rows(frames: Sequence[Any]) -> Array:
        pieces = [piece for frame in frames for piece in parts(frame)]
        return np.concatenate(pieces).reshape(len(frames), -1)

    return rows


def array_layout(schema: str, columns: Sequence[str]) -> Layout:
    """Lay out std_msgs/Float64MultiArray or Int64MultiArray, with a label that names the columns."""
    count = len(columns)
    dimension = (",".join(columns), count, count)
    return layout(schema, ((dimension,), 0), (Slot.VALUE,) * count)


def joint_layout(names: Sequence[str], *, only_positions: bool = False) -> Layout:
    """Lay out sensor_msgs/JointState: position, velocity and effort."""
    slots = (Slot.VALUE,) * len(names)
    others = () if only_positions else slots
    return layout(messages.JOINT_STATE, (Slot.TIME, ""), tuple(names), slots, others, others)


def frame_times(num_frames: int, fps: int) -> NDArray[np.int64]:
    """Compute (T,) `frame_time_ns` of every frame."""
    return (np.arange(num_frames, dtype=np.int64) * 2_000_000_000 + fps) // (2 * fps)


def read_columns(
    container: Container,
    streams: Sequence[FrameStream],
    *,
    due_ns: NDArray[np.int64] | None = None,
    frame_topic: str,
    others: Sequence[str] = (),
) -> tuple[dict[str, Any], dict[str, TimedMessages]]:
    """Read all streams in one pass.

    Args:
        container: The open file.
        streams: Streams to read.
        due_ns: (T,) times of the frames; None for those of the messages on `frame_topic`.
        frame_topic: Topic of one of the streams.
        others: Topics to return as undecoded messages.

    Returns:
        Field of `Trajectory` or `Table` -> rows, with `time_ns`; and the messages of `others`.

    Raises:
        RecordingError: A stream is damaged, or not at the times of the frames.
    """
    found: dict[str, TimedMessages] = {topic: [] for topic in others}
    times = defaultdict[str, list[NDArray[np.int64]]](list)
    values = defaultdict[str, list[NDArray[Any]]](list)
    topics = (*(stream.topic for stream in streams), *others)
    with damage_as_recording_error(container.path):
        for blocks in container.blocks_by_chunk(topics, num_bytes=_TABLE_BYTES):
            for stream in streams:
                block = blocks[stream.topic]
                if stream.is_dense and due_ns is not None:
                    block = block.select(np.isin(block.time_ns, due_ns))
                times[stream.topic].append(block.time_ns)
                values[stream.topic].append(stream.layout.decode_rows(block.rows(len(stream.layout.constant))))
            for topic, timed in found.items():
                timed += zip(blocks[topic].time_ns.tolist(), blocks[topic].messages(), strict=True)
    time_ns = np.concatenate(times[frame_topic]) if due_ns is None else due_ns
    if len(time_ns) > 1 and int(np.diff(time_ns).min()) <= 0:
        raise RecordingError(f"The frames of the recording are not in chronological order: {container.path}")
    columns: dict[str, Any] = {"time_ns": time_ns}
    for stream in streams:
        at = np.concatenate(times[stream.topic])
        if not np.array_equal(at, time_ns):
            raise RecordingError(
                f"The recording has {len(at)} messages on {stream.topic} at other times than its {len(time_ns)} "
                f"frames: {container.path}"
            )
        for name, rows in stream.columns(np.concatenate(values[stream.topic])).items():
            columns[name] = columns.get(name, {}) | rows if isinstance(rows, Mapping) else rows
    return columns, found
