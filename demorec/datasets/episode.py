"""An episode as every exporter writes it: which frames, which numbers, which images, whoever recorded it.

`exported(recording, options)` gives one; the formats ask it and never what kind of recording it comes from.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from demorec.core.errors import ConfigError, ExportError
from demorec.core.registry import nearest_match
from demorec.datasets.options import CommonOptions
from demorec.episode.episode import SimulatedColumns
from demorec.episode.features import (
    ENVIRONMENT_STATE,
    IMAGE_PREFIX,
)
from demorec.mcap import AnyRecording, SimulatedRecording

REWARD, DONE, SUCCESS = "next.reward", "next.done", "next.success"
INTERVENTION = "intervention"
"""As LeRobot's DAgger calls it: whether the expert acts in an episode that a policy began."""
SCALARS: Mapping[str, Literal["float32", "bool"]] = {
    INTERVENTION: "bool",
    REWARD: "float32",
    DONE: "bool",
    SUCCESS: "bool",
}
"""Features of one number a frame, and their type."""


@dataclass(frozen=True, kw_only=True)
class ExportCamera:
    """A stream of images of the dataset.

    Attributes:
        name: Of the camera in the recording.
        feature: What the dataset calls it.
        is_depth: Whether its images are distances.
    """

    name: str
    feature: str
    is_depth: bool = False


class Simulated:
    """What only an episode has that demorec simulated: its recording with all that is known of it, and its numbers.

    Args:
        recording: Open.
    """

    def __init__(self, recording: SimulatedRecording) -> None:
        self.recording = recording

    @cached_property
    def columns(self) -> SimulatedColumns:
        """All numbers, every frame; RecordingError for damage."""
        return self.recording.columns()


class ExportEpisode(ABC):
    """What a dataset has of one recording, with these options.

    Args:
        recording: Open.
        options: Of the export.

    Attributes:
        simulated: What only a simulated episode has; None for an external one.
        fps: Of the dataset.
        names: Vector feature -> names of its D elements, all that recording and options offer.
        scalars: Of `SCALARS`, all that they offer.
        cameras: Those that the dataset shall have, in its order.

    Raises:
        ConfigError: Options that the recording cannot serve.
    """

    simulated: Simulated | None
    fps: int
    names: Mapping[str, tuple[str, ...]]
    scalars: tuple[str, ...]
    cameras: tuple[ExportCamera, ...]

    def __init__(self, recording: AnyRecording, options: CommonOptions) -> None:
        self.recording = recording
        self.options = options

    def _settle(
        self, names: Mapping[str, tuple[str, ...]], scalars: tuple[str, ...], cameras: Collection[ExportCamera]
    ) -> None:
        """Take what is offered, and of the cameras those that are wanted."""
        offered = [*names, *(camera.feature for camera in cameras), *scalars]
        check_feature_names(self.options, [*offered, *(name for name in self.on_request if name not in offered)])
        self.names, self.scalars = names, scalars
        self.cameras = tuple(camera for camera in cameras if self.options.takes(camera.feature))

    @property
    def on_request(self) -> tuple[str, ...]:
        """Features that a dataset has only when they are named."""
        return ()

    @property
    def depth_left_out(self) -> tuple[str, ...]:
        """Depth cameras that were not asked for."""
        return ()

    @property
    def is_silent(self) -> bool:
        """Whether there is nothing that language could be made of."""
        return self.simulated is None and not self.subtasks

    @property
    def subtasks(self) -> tuple[tuple[int, str], ...]:
        """(frame, what is begun there) as an external source states it."""
        return ()

    @property
    @abstractmethod
    def origin(self) -> str:
        """Where the episode comes from: "" for a generated one, "replay of DIGEST", or JSON of imported files."""

    @property
    @abstractmethod
    def urdf(self) -> str:
        """The robot's URDF as text, "" where it is not known."""

    @property
    @abstractmethod
    def joints(self) -> Mapping[str, tuple[str, ...]]:
        """Feature -> for each element the joint of the URDF of which it is the position, "" for none."""

    @property
    @abstractmethod
    def units(self) -> Mapping[str, tuple[str, ...]]:
        """Feature of `joints` -> units of its elements, where they are known."""

    @abstractmethod
    def described_cameras(self) -> list[dict[str, Any]]:
        """What is known of each camera of the recording: name, width, height, intrinsics (K, row by row), mount,
        mount_from_camera and world_from_camera_start (position, quaternion xyzw); None for what is not."""

    @abstractmethod
    def traits(self) -> Iterator[tuple[str, str]]:
        """What all recordings of a dataset must have in common, as (what, value) in words."""

    def _camera_traits(self) -> Iterator[tuple[str, str]]:
        yield "cameras", " ".join(camera.feature.removeprefix(IMAGE_PREFIX) for camera in self.cameras) or "none"
        for name in dict.fromkeys(camera.name for camera in self.cameras):
            settings = self.recording.video_settings(name)
            yield f"size of camera {name}", f"{settings.width}x{settings.height}"
            yield f"codec of camera {name}", settings.codec

    @cached_property
    def rows(self) -> NDArray[np.intp]:
        """(T,) which frames of the recording the dataset has; ExportError where there are none."""
        if self.recording.num_frames == 0:
            raise ExportError(f"The recording has no frames: {self.recording.path}")
        return np.arange(0, self.recording.num_frames, self.recording.info.fps // self.fps)

    @cached_property
    def vectors(self) -> Mapping[str, NDArray[np.floating[Any]]]:
        """Feature of `names` that the dataset shall have -> (T, D), as precise as the recording has it.

        Raises:
            ExportError: The recording has no frames, or a number that is not finite.
            RecordingError: It is damaged.
        """
        vectors = {name: values for name, values in self._vectors().items() if self.options.takes(name)}
        for name, values in vectors.items():
            self._check_finite(name, values)
        return vectors

    @cached_property
    def singles(self) -> Mapping[str, NDArray[np.generic]]:
        """The same as float32, and (T,) of the scalars; ExportError for a number that float32 does not hold, too."""
        found: dict[str, NDArray[np.generic]] = {}
        for name, values in self.vectors.items():
            with np.errstate(over="ignore"):
                found[name] = single = values.astype(np.float32)
            self._check_finite(name, single)
        return found | {name: values for name, values in self.scalar_columns.items() if self.options.takes(name)}

    def _check_finite(self, name: str, values: NDArray[np.floating[Any]]) -> None:
        if len(wrong := np.flatnonzero(~np.isfinite(values).all(axis=1))):
            why = "too large for float32" if values.dtype == np.float32 else "not finite"
            raise ExportError(
                f"The feature {name} is {why} in frame {int(self.rows[wrong[0]])}, leave the recording out: "
                f"{self.recording.path}"
            )

    @abstractmethod
    def _vectors(self) -> Mapping[str, NDArray[np.floating[Any]]]:
        """Feature -> (T, D)."""

    @property
    @abstractmethod
    def scalar_columns(self) -> Mapping[str, NDArray[np.generic]]:
        """Feature of `scalars` -> (T,)."""

    @abstractmethod
    def numbers(self, camera: ExportCamera) -> NDArray[np.int64]:
        """(T,) which image of the camera each frame shows, of those that `recording.packets` gives.

        Raises:
            ConfigError: The recording has no such images.
            ExportError: A frame has none.
        """

    def images(self, camera: ExportCamera) -> Iterator[NDArray[Any]]:
        """What the frames show, one a frame: (H, W, 3) uint8 RGB, of a depth camera (H, W) float32 metres.

        Raises:
            ExportError: They show images in another order than that of the camera; and as `numbers`.
        """
        wanted = self.numbers(camera)
        if (np.diff(wanted) < 0).any():
            raise ExportError(
                f"The images of the camera {camera.name} are not in the order of the frames: {self.recording.path}"
            )
        recording = self.recording
        found: Iterator[NDArray[Any]] = (
            recording.depth(camera.name) if camera.is_depth else recording.images(camera.name)
        )
        images = enumerate(found)
        number, image = next(images)
        for due in wanted.tolist():
            while number < due:
                number, image = next(images)
            yield image


def frame_stride(recording_fps: int, fps: int | None) -> int:
    """How many frames of the recording make one of the dataset.

    Raises:
        ConfigError: The wanted fps does not divide that of the recording.
    """
    if fps is None:
        return 1
    if recording_fps % fps:
        divisors = [str(n) for n in range(1, recording_fps + 1) if recording_fps % n == 0]
        raise ConfigError(
            f"fps is {fps}, which does not divide the recordings' {recording_fps}: allowed are {', '.join(divisors)}."
        )
    return recording_fps // fps


def check_feature_names(options: CommonOptions, offered: Collection[str]) -> None:
    """Raise ConfigError when `options.features` names one that is not among the offered ones."""
    for name in options.features:
        if name == ENVIRONMENT_STATE and name not in offered:
            raise ConfigError(f"The feature {name} is named in --features, but only --privileged adds it.")
        if name not in offered:
            raise ConfigError(
                f"Unknown feature {name!r}.{nearest_match(name, offered)} The recordings and these options give: "
                f"{', '.join(offered)}."
            )
