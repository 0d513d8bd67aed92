"""What every exporter writes of a collected episode: its frames as they came, and whole pictures."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from demorec.errors import ConfigError, ExportError
from demorec.export.columns import DONE, check_feature_names
from demorec.export.options import CommonOptions
from demorec.recording import CollectedRecording
from demorec.scene.collected import NO_PICTURE, CollectedColumns
from demorec.scene.features import IMAGE_PREFIX

_NANOSECONDS = 1_000_000_000


@dataclass(frozen=True, kw_only=True, eq=False)
class CollectedData:
    """What a dataset has of one collected episode.

    Attributes:
        recorded: All of its numbers.
        features: Feature -> (T, D) in its own dtype; (T,) bool for DONE.
        pictures: Camera, depth cameras included -> (T,) numbers of the pictures that the frames show.
    """

    recorded: CollectedColumns
    features: Mapping[str, NDArray[np.generic]]
    pictures: Mapping[str, NDArray[np.int64]]


def wanted_cameras(recording: CollectedRecording, options: CommonOptions) -> list[str]:
    """The cameras that the dataset shall have."""
    return [name for name in recording.cameras if options.takes(IMAGE_PREFIX + name)]


def wanted_depth(recording: CollectedRecording, options: CommonOptions) -> list[str]:
    """The depth cameras that the dataset shall have: none unless depth is asked for."""
    return [name for name in recording.depth_cameras if options.depth and options.takes(IMAGE_PREFIX + name)]


def check_options(recording: CollectedRecording, options: CommonOptions) -> None:
    """Raise ConfigError for options that a collected episode cannot serve."""
    info = recording.info
    if options.action != "joint":
        raise ConfigError(
            f"action is {options.action!r}, but the actions of collected episodes are exported as they came: "
            f"{recording.path}"
        )
    if (state := getattr(options, "state", "joint")) != "joint":
        raise ConfigError(
            f"state is {state!r}, but observation.state of collected episodes is exported as it came: {recording.path}"
        )
    if options.depth and not recording.depth_cameras:
        raise ConfigError(f"depth is asked for, but no camera of the recording measures distances: {recording.path}")
    unknown = [kind for kind in getattr(options, "language", None) or () if kind != "subtask"]
    if unknown:
        raise ConfigError(
            f"language names {unknown[0]!r}, but of collected episodes nothing is known but the subtasks that somebody "
            f"said: {recording.path}"
        )
    for name in ("privileged", "progress", "boxes"):  # the last two of LeRobot datasets alone
        if getattr(options, name, None) not in (None, False):
            raise ConfigError(f"{name} is asked for, which collected episodes do not have: {recording.path}")
    if options.fps not in (None, info.fps):
        raise ConfigError(
            f"fps is {options.fps}, but the episode was collected at {info.fps}, and whether frames can be left out of "
            f"it depends on what its actions mean: {recording.path}"
        )
    offered = [*(feature.name for feature in info.features), DONE]
    cameras = [*recording.cameras, *(recording.depth_cameras if options.depth else ())]
    check_feature_names(options, [*offered, *(IMAGE_PREFIX + name for name in cameras)])


def collected_data(recording: CollectedRecording, options: CommonOptions) -> CollectedData:
    """The numbers of an episode, and which pictures its frames show.

    Raises:
        ConfigError: As `check_options`.
        ExportError: It has no frames, or frames without a picture.
        RecordingError: It is damaged.
    """
    check_options(recording, options)
    if recording.num_frames == 0:
        raise ExportError(f"The recording has no frames: {recording.path}")
    columns = recording.columns()
    features = {name: values for name, values in columns.features.items() if options.takes(name)}
    features[DONE] = np.arange(columns.num_frames) == columns.num_frames - 1
    return CollectedData(
        recorded=columns,
        features=features,
        pictures={
            camera: shown_pictures(recording, columns, camera, options)
            for camera in (*wanted_cameras(recording, options), *wanted_depth(recording, options))
        },
    )


def shown_pictures(
    recording: CollectedRecording, columns: CollectedColumns, camera: str, options: CommonOptions
) -> NDArray[np.int64]:
    """(T,) the picture of a camera that each frame shows: its own, or the camera's last one where that may be held.

    Raises:
        ExportError: A frame has none, and none before it may be held.
    """
    numbers = columns.pictures[camera].copy()
    stamps = columns.picture_stamps[camera]
    longest = round(options.hold_pictures * _NANOSECONDS)
    without = np.flatnonzero(numbers == NO_PICTURE)
    for frame in without.tolist():
        before = int(numbers[frame - 1]) if frame else NO_PICTURE
        age = int(columns.time_ns[frame] - stamps[before]) if before != NO_PICTURE else None
        if age is None or age > longest:
            last, hold = "none came before it", ""
            if age is not None:
                last = f"the last one is {age / _NANOSECONDS:.3g} s old"
                hold = "allow that one to be held (--hold-pictures SECONDS), or "
            raise ExportError(
                f"Frame {frame} has no picture of the camera {camera}, as {len(without)} of {len(numbers)} frames, and "
                f"{last}: {hold}leave the camera (--features) or the episode (--episodes) out: {recording.path}"
            )
        numbers[frame] = before
    return numbers


def shown(recording: CollectedRecording, camera: str, numbers: NDArray[np.int64]) -> Iterator[NDArray[Any]]:
    """The pictures that frames show, one a frame, of which `numbers` never decrease.

    They are (H, W, 3) uint8 RGB, of a depth camera (H, W) float32 metres.

    Raises:
        ExportError: They do.
    """
    if (np.diff(numbers) < 0).any():
        raise ExportError(f"The pictures of the camera {camera} are not in the order of the frames: {recording.path}")
    is_depth = camera in recording.depth_cameras
    found: Iterator[NDArray[Any]] = recording.depth(camera) if is_depth else recording.images(camera)
    pictures = enumerate(found)
    number, picture = next(pictures)
    for wanted in numbers.tolist():
        while number < wanted:
            number, picture = next(pictures)
        yield picture
