"""A recording's rows back into frames: for whoever looks at it, or writes a recording from it (re-render, replay)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from itertools import islice

import numpy as np

from demorec.episode.episode import CameraImages, Event, Frame, JointSample, SimulatedColumns
from demorec.mcap.reader import RecordingReader
from demorec.mcap.streams import action_at, observation_at, pose_of


def frames_of(recording: RecordingReader, columns: SimulatedColumns | None = None) -> Iterator[Frame]:
    """Every frame without its pictures: numbers, phase, events, and the joint samples before it.

    Args:
        recording: An open recording.
        columns: Its columns, where the caller has read (or changed) them already.
    """
    columns = recording.columns() if columns is None else columns
    times = columns.time_ns.tolist()
    events: dict[int, list[Event]] = {}
    for time_ns, event in recording.events():
        frame = max(int(np.searchsorted(columns.time_ns, time_ns, side="right")) - 1, 0)
        events.setdefault(frame, []).append(event)
    samples = _samples_before_frames(recording, times)
    for index, time_ns in enumerate(times):
        yield Frame(
            frame_index=index,
            time_ns=time_ns,
            observation=observation_at(columns, index),
            action=action_at(columns, index, "action"),
            command=action_at(columns, index, "command"),
            phase=columns.phase[index],
            events=tuple(events.get(index, ())),
            joint_samples=samples.get(index, ()),
            is_deliberate_miss=bool(columns.is_deliberate_miss[index]),
        )


def _samples_before_frames(recording: RecordingReader, times: list[int]) -> dict[int, tuple[JointSample, ...]]:
    number = {time_ns: index for index, time_ns in enumerate(times)}
    result: dict[int, tuple[JointSample, ...]] = {}
    waiting: list[JointSample] = []
    for sample in recording.joint_samples():
        if sample.time_ns in number:
            if waiting:
                result[number[sample.time_ns]] = tuple(waiting)
            waiting = []
        else:
            waiting.append(sample)
    return result


def decoded_images(recording: RecordingReader, columns: SimulatedColumns) -> Iterator[Mapping[str, CameraImages]]:
    """The recorded pictures of every frame, decoded (so not those that were coded), with the recorded camera poses."""
    streams = {
        name: (
            recording.images(name),
            recording.depth(name) if recording.has_depth(name) else None,
            recording.segmentation(name) if recording.has_segmentation(name) else None,
        )
        for name in recording.cameras
    }
    for index in range(columns.num_frames):
        yield {
            name: CameraImages(
                color=next(color),
                depth=None if depth is None else next(depth),
                segmentation=None if labels is None else next(labels),
                world_from_camera=pose_of(columns.world_from_camera[name][index]),
            )
            for name, (color, depth, labels) in streams.items()
        }


def frames_with_images(recording: RecordingReader) -> Iterator[Frame]:
    """Every frame with its decoded pictures, one after the other: a few pictures are in memory at a time."""
    columns = recording.columns()
    for frame, images in zip(frames_of(recording, columns), decoded_images(recording, columns), strict=True):
        yield replace(frame, images=images)


def images_at(recording: RecordingReader, columns: SimulatedColumns, frame: int) -> Mapping[str, CameraImages]:
    """The pictures of one frame; only those from the keyframe before it on are decoded."""

    def at[P](pictures: Callable[[str], Iterator[P]], camera: str) -> P:
        return next(islice(pictures(camera), frame, None))

    return {
        name: CameraImages(
            color=recording.image(name, frame),
            depth=at(recording.depth, name) if recording.has_depth(name) else None,
            segmentation=at(recording.segmentation, name) if recording.has_segmentation(name) else None,
            world_from_camera=pose_of(columns.world_from_camera[name][frame]),
        )
        for name in recording.cameras
    }
