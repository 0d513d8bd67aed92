"""The interface of every recorded episode: a recording, or an episode of a LeRobot dataset."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from demorec.core.geometry import Array
from demorec.episode.episode import Event, Outcome, Table
from demorec.episode.info import EpisodeInfo

if TYPE_CHECKING:
    from demorec.mcap.video import Rgb, VideoPacket, VideoSettings


@dataclass(frozen=True, kw_only=True, eq=False)
class SceneMotion:
    """The motion of a robot, its scene and its cameras over T frames; unknown parts are empty."""

    joint_position: Mapping[str, Array] = field(default_factory=dict)  # joint of the URDF -> (T,) rad or m
    base_from_tcp: Array | None = None  # (T, 7), None if unknown
    object_poses: Mapping[str, Array] = field(default_factory=dict)  # name -> (T, 7), world_from_object
    world_from_camera: Mapping[str, Array] = field(default_factory=dict)  # name -> (T, 7)


class Episode(Protocol):
    """An open episode of any source; unknown parts are absent.

    Methods and properties raise DemorecError if the files cannot be read. A body returns the value of an unknown part.
    """

    path: Path  # file, or folder of the dataset
    num_frames: int

    @property
    def info(self) -> EpisodeInfo:
        """Description: instruction, robot, rate, features, cameras, origin."""

    @property
    def outcome(self) -> Outcome | None:
        """Outcome of the episode; None if a crash cut it off."""

    @property
    def time_ns(self) -> NDArray[np.int64]:
        """(T,) timestamps of the frames."""

    @property
    def phases(self) -> tuple[str, ...]:
        """T phases of the motion; empty if unknown."""
        return ()

    @property
    def subtasks(self) -> tuple[tuple[int, str], ...]:
        """(frame, subtask that begins there) in order."""

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the colour cameras."""

    @property
    def depth_cameras(self) -> tuple[str, ...]:
        """Names of the cameras with distances."""

    def events(self) -> Iterator[tuple[int, Event]]:
        """Yield (time_ns, event) in order of time."""
        return iter(())

    def table(self) -> Table:
        """Read the features of every frame, and which images the frames show."""

    def motion(self) -> SceneMotion:
        """Read the motion of the robot, its scene and its cameras."""

    def description(self, body: str = "") -> str:
        """Read the URDF of the robot, or of a body; "" if unknown."""

    def images(self, camera: str) -> Iterator[Rgb]:
        """Yield the decoded images of a camera in order, (H, W, 3) uint8 RGB."""

    def images_at(self, camera: str, frames: Sequence[int]) -> Iterator[Rgb]:
        """Yield the images of a camera at some frames, in increasing order, (H, W, 3) uint8 RGB."""

    def video_settings(self, camera: str) -> VideoSettings:
        """Return the encoding settings of a camera's images."""

    def packets(self, camera: str) -> Iterator[VideoPacket]:
        """Yield the encoded images of a camera in order."""

    def distances(self, camera: str) -> Iterator[NDArray[Any]]:
        """Yield the images of a depth camera in order, (H, W) uint16 millimetres or float32 metres."""

    def has_segmentation(self, camera: str) -> bool:
        """Check whether a camera has segmentation images."""
        return False

    def segmentation(self, camera: str) -> Iterator[NDArray[np.int32]]:
        """Yield the segmentation images of a camera in order, (H, W) int32."""
        return iter(())

    def segment_names(self) -> Mapping[int, str]:
        """Read the names of the segments: number -> name."""
        return {}
