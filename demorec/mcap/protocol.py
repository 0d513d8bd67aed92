"""The interface that every recorded episode has: a recording, and an episode of a LeRobot dataset."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from demorec.episode.episode import Event, Outcome, Table
from demorec.episode.info import EpisodeInfo
from demorec.mcap.video import Rgb, VideoPacket, VideoSettings


class Episode(Protocol):
    """An episode that can be read, whoever recorded it; what is not known is absent.

    Attributes:
        path: File, or folder of the dataset.
        num_frames: T.

    Methods and properties raise DemorecError if the files cannot be read.
    """

    path: Path
    num_frames: int

    @property
    def info(self) -> EpisodeInfo:
        """The description: instruction, robot, rate, features, cameras, origin."""

    @property
    def outcome(self) -> Outcome | None:
        """How the episode ended; None if a crash cut it off."""

    @property
    def time_ns(self) -> NDArray[np.int64]:
        """(T,) stamps of the frames."""

    @property
    def phases(self) -> tuple[str, ...]:
        """T phases of the motion; empty where none are stated."""

    @property
    def subtasks(self) -> tuple[tuple[int, str], ...]:
        """(frame, subtask that begins there) in order."""

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras with images in colour."""

    @property
    def depth_cameras(self) -> tuple[str, ...]:
        """Names of the cameras with distances."""

    def events(self) -> Iterator[tuple[int, Event]]:
        """Yield (time_ns, event) in order of time."""

    def table(self) -> Table:
        """Read the features of every frame, and which images the frames show."""

    def images(self, camera: str) -> Iterator[Rgb]:
        """Yield the decoded images of a camera in order, (H, W, 3) uint8 RGB."""

    def images_at(self, camera: str, frames: Sequence[int]) -> Iterator[Rgb]:
        """Yield what some frames, in rising order, show of a camera, (H, W, 3) uint8 RGB."""

    def video_settings(self, camera: str) -> VideoSettings:
        """Return how the images of a camera are encoded."""

    def packets(self, camera: str) -> Iterator[VideoPacket]:
        """Yield the encoded images of a camera in order."""

    def distances(self, camera: str) -> Iterator[NDArray[Any]]:
        """Yield the images of a depth camera in order, (H, W) uint16 millimetres or float32 metres."""
