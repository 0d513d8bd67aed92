"""The numbers of an episode: read as columns, by the streams that its recording has; and columns as frames."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from demorec.core.errors import RecordingError
from demorec.core.geometry import Array, Pose
from demorec.episode.episode import NO_IMAGE, Action, Event, Frame, JointSample, Observation, Table, Trajectory
from demorec.episode.info import EpisodeInfo
from demorec.mcap import channels, messages
from demorec.mcap.container import Container, damage_as_recording_error
from demorec.mcap.streams import FRAMES, FrameStream, frame_streams

_TABLE_BYTES = 1 << 20
"""Of chunks whose numbers are taken out together: taking out takes several times as much memory as they have."""

Said = list[tuple[int, bytes]]
"""When, and what: messages that do not come at each frame."""
_Parts = Mapping[str, list[NDArray[Any]]]
"""Topic -> its rows, chunk by chunk."""


def frame_times(num_frames: int, fps: int) -> NDArray[np.int64]:
    """(T,) `frame_time_ns` of every frame."""
    return (np.arange(num_frames, dtype=np.int64) * 2_000_000_000 + fps) // (2 * fps)


def read_numbers(
    container: Container, info: EpisodeInfo, num_frames: int, image_topics: Mapping[str, str]
) -> tuple[Table | Trajectory, Said]:
    """Read the numbers of an episode, and its events, which lie among the numbers in the file.

    Args:
        container: The open file.
        info: Of the episode.
        num_frames: T.
        image_topics: Recorded camera -> topic of its images, in the order of `info`.

    Returns:
        A trajectory of a simulated episode, the table of any other; and the messages of the events.

    Raises:
        RecordingError: A stream is damaged, not at the times of the frames, or a frame holds an image that is none.
    """
    is_simulated, streams = info.simulation is not None, frame_streams(info)
    said: dict[str, Said] = {
        topic: [] for topic in (channels.PHASE, channels.DELIBERATE_MISS, channels.EVENTS) if is_simulated
    }
    due = frame_times(num_frames, info.fps)
    times, values = defaultdict[str, list[NDArray[Any]]](list), defaultdict[str, list[NDArray[Any]]](list)
    with damage_as_recording_error(container.path):
        for blocks in container.blocks_by_chunk((*(row.topic for row in streams), *said), num_bytes=_TABLE_BYTES):
            for stream in streams:
                block = blocks[stream.topic]
                if is_simulated and stream.topic == channels.JOINT_STATES:  # there may be more of these between frames
                    block = block.select(np.isin(block.time_ns, due))
                times[stream.topic].append(block.time_ns)
                values[stream.topic].append(stream.layout.decode_rows(block.rows(len(stream.layout.constant))))
            for topic, found in said.items():
                found += zip(blocks[topic].time_ns.tolist(), blocks[topic].messages(), strict=True)
        time_ns = due if is_simulated else np.concatenate(times[FRAMES])
        if len(time_ns) > 1 and int(np.diff(time_ns).min()) <= 0:
            raise RecordingError(f"The frames of the recording are not in the order of their times: {container.path}")
        columns = _merged(streams, times, values, time_ns, container)
        if is_simulated:
            columns["phase"] = tuple(_held(said[channels.PHASE], messages.read_string, time_ns, ""))
            misses = _held(said[channels.DELIBERATE_MISS], messages.read_boolean, time_ns, False)
            columns["is_deliberate_miss"] = np.array(misses, dtype=np.bool_)
    if is_simulated:
        columns |= {name: columns.get(name, {}) for name in ("sensed", "object_poses", "world_from_camera")}
        columns["world_from_camera"] = {name: columns["world_from_camera"][name] for name in image_topics}
        return Trajectory(time_ns=time_ns, **columns), said[channels.EVENTS]
    columns |= {name: columns.get(name, {}) for name in ("features", "stamps", "images")}
    columns["image_stamps"] = _stamps(container, image_topics)
    for name, numbers in columns["images"].items():
        count = len(columns["image_stamps"][name])
        if len(numbers) and not NO_IMAGE <= int(numbers.min()) <= int(numbers.max()) < count:
            raise RecordingError(
                f"A frame holds an image of the camera {name!r} that is none of its {count}: {container.path}"
            )
    return Table(time_ns=time_ns, **columns), []


def _merged(
    streams: tuple[FrameStream, ...], times: _Parts, values: _Parts, time_ns: NDArray[np.int64], container: Container
) -> dict[str, Any]:
    """Convert messages to arguments of `Trajectory` or `Table`; RecordingError unless each stream has one a frame."""
    merged: dict[str, Any] = {}
    for stream in streams:
        found = np.concatenate(times[stream.topic])
        if not np.array_equal(found, time_ns):
            raise RecordingError(
                f"The recording has {len(found)} messages on {stream.topic} at other times than its {len(time_ns)} "
                f"frames: {container.path}"
            )
        for name, rows in stream.columns(np.concatenate(values[stream.topic])).items():
            merged[name] = merged.get(name, {}) | rows if isinstance(rows, Mapping) else rows
    return merged


def _held[V](said: Said, read: Callable[[bytes], V], times: NDArray[np.int64], first: V) -> list[V]:
    """The value that holds at each time, given the messages that tell its changes."""
    values = [first, *(read(data) for _, data in said)]
    changes = np.array([time_ns for time_ns, _ in said], dtype=np.int64)
    numbers = np.searchsorted(np.maximum.accumulate(changes), times, side="right")
    return [values[number] for number in numbers.tolist()]


def _stamps(container: Container, topics: Mapping[str, str]) -> dict[str, NDArray[np.int64]]:
    """Name -> (N,) of the messages of its topic, one chunk of them in memory at a time: images may take gigabytes."""
    found = defaultdict[str, list[NDArray[np.int64]]](list)
    for blocks in container.blocks_by_chunk(topics.values()):
        for name, topic in topics.items():
            found[name].append(blocks[topic].time_ns)
    return {name: np.concatenate(times) for name, times in found.items()}


# -------------------------------------------------------------------------------------------- trajectories as frames


def pose_of(row: Array) -> Pose:
    """The pose of a row (7,): position, quaternion xyzw."""
    return Pose(position=row[:3], quat_xyzw=row[3:])


def observation_at(trajectory: Trajectory, frame: int) -> Observation:
    """The observation of a frame, bit-exact."""
    return Observation(
        joint_position=trajectory.joint_position[frame].copy(),
        joint_velocity=trajectory.joint_velocity[frame].copy(),
        joint_effort=trajectory.joint_effort[frame].copy(),
        gripper_width=float(trajectory.gripper_width[frame]),
        base_from_tcp=pose_of(trajectory.base_from_tcp[frame]),
        object_poses={name: pose_of(rows[frame]) for name, rows in trajectory.object_poses.items()},
        contact_force=float(trajectory.contact_force[frame]),
        sensed={name: values[frame].copy() for name, values in trajectory.sensed.items()},
    )


def action_at(trajectory: Trajectory, frame: int, kind: Literal["action", "command"]) -> Action:
    """What the expert wanted at a frame, or the command that was sent to the motors."""
    return Action(
        joint_target=getattr(trajectory, f"{kind}_joint_target")[frame].copy(),
        gripper_target=float(getattr(trajectory, f"{kind}_gripper")[frame]),
        base_from_tcp_target=pose_of(getattr(trajectory, f"{kind}_base_from_tcp")[frame]),
    )


def frames_of(
    trajectory: Trajectory, events: Iterable[tuple[int, Event]], joint_samples: Iterable[JointSample]
) -> Iterator[Frame]:
    """Every frame without its images, bit-exact: numbers, phase, events, and the joint samples before it.

    Args:
        trajectory: Of a recording.
        events: Its events, each with its time_ns.
        joint_samples: Its joint states, those of the frames too.
    """
    times = trajectory.time_ns.tolist()
    found: dict[int, list[Event]] = {}
    for time_ns, event in events:
        frame = max(int(np.searchsorted(trajectory.time_ns, time_ns, side="right")) - 1, 0)
        found.setdefault(frame, []).append(event)
    samples = _samples_before_frames(joint_samples, times)
    for index, time_ns in enumerate(times):
        yield Frame(
            frame_index=index,
            time_ns=time_ns,
            observation=observation_at(trajectory, index),
            action=action_at(trajectory, index, "action"),
            command=action_at(trajectory, index, "command"),
            phase=trajectory.phase[index],
            events=tuple(found.get(index, ())),
            joint_samples=samples.get(index, ()),
            is_deliberate_miss=bool(trajectory.is_deliberate_miss[index]),
        )


def _samples_before_frames(samples: Iterable[JointSample], times: list[int]) -> dict[int, tuple[JointSample, ...]]:
    number = {time_ns: index for index, time_ns in enumerate(times)}
    result: dict[int, tuple[JointSample, ...]] = {}
    waiting: list[JointSample] = []
    for sample in samples:
        if sample.time_ns in number:
            if waiting:
                result[number[sample.time_ns]] = tuple(waiting)
            waiting = []
        else:
            waiting.append(sample)
    return result
