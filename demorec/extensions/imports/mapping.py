"""Mapping from a bag or an HDF5 file to an episode, which the user writes in TOML (docs/import.md).

[[features."observation.state"]]      a feature is one source or several, concatenated
topic = "/joint_states"               for a bag; for an HDF5 file: dataset = "obs/robot0_joint_pos"
field = "position"
joints = ["fr3_joint1", "fr3_joint2"]

Most keys apply to both; those of one kind are marked, and rejected in a mapping of the other.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

from demorec.core.plain import digest

SourceKind = Literal["bag", "hdf5"]
Unit = Literal["", "rad", "degree", "m", "mm"]
MAX_FPS = 1000
MAX_ELEMENTS = 4096
"""Maximum elements of a source: larger ones are images or point clouds, not vectors."""
MAX_SECONDS = 1e9
"""Maximum of any time in a mapping: larger ones exceed 64-bit nanoseconds."""
KIND = "kind"
"""Key in a field's metadata: the only kind of source with this field."""

_BAG, _HDF5 = {KIND: "bag"}, {KIND: "hdf5"}
"""Metadata of keys for only one kind of mapping."""


def _bag(default: Any) -> Any:
    """A key for mappings of bags only."""
    return dataclasses.field(default=default, metadata=_BAG)


def _hdf5(default: Any) -> Any:
    """A key for mappings of HDF5 files only."""
    return dataclasses.field(default=default, metadata=_HDF5)


@dataclass(frozen=True, kw_only=True)
class Source:
    """A part of a feature: numbers of one topic, or of one dataset.

    Attributes:
        topic: Topic of the numbers, for bags.
        field: Path of the numbers in a message: "position", "pose.orientation", "transforms[child_frame_id=hand]".
        joints: Elements by name, in this order, if the message names them.
        max_age_s: As `Clock.max_age_s`, for this source.
        dataset: Dataset of the numbers below the episode's group, for HDF5 files: (T, D) or (T,).
        elements: Elements by number, in this order (auto: all).
        names: Names of the elements in the feature (auto: the source's names).
        unit: Unit of the numbers, which stay bit-exact.
        next: Instead of a source: a feature to take from the next row.
    """

    elements: tuple[int, ...] = ()
    names: tuple[str, ...] = ()
    unit: Unit = ""
    next: str = ""
    topic: str = _bag("")
    field: str = _bag("")
    joints: tuple[str, ...] = _bag(())
    max_age_s: float | None = _bag(None)
    dataset: str = _hdf5("")


@dataclass(frozen=True, kw_only=True)
class CameraSource:
    """A camera's images.

    Attributes:
        topic: Topic of a bag: sensor_msgs Image or CompressedImage, foxglove RawImage, CompressedImage or
        CompressedVideo.
        info_topic: Topic of its calibration (CameraInfo, CameraCalibration).
        dataset: Dataset of an HDF5 file below the episode's group: (T, H, W, 3) or (T, 3, H, W) uint8; or a JPEG file
        in each row, (T, N) uint8 padded with zeros or (T,) of variable length; for a depth camera (T, H, W) or
        (T, H, W, 1), uint16 mm or float32 m.
        colors: Order of the colours; JPEG files are RGB by their format, but recorders may pass RGB pixels to OpenCV,
        which expects BGR.
    """

    topic: str = _bag("")
    info_topic: str = _bag("")
    dataset: str = _hdf5("")
    colors: Literal["rgb", "bgr"] = _hdf5("rgb")


@dataclass(frozen=True, kw_only=True)
class Robot:
    """Robot of the recording.

    Attributes:
        name: Any name; datasets to be merged need the same one.
        urdf: File of its URDF, relative to the mapping file.
        urdf_topic: Topic of its URDF in the bag: "/robot_description".
    """

    name: str
    urdf: str = ""
    urdf_topic: str = _bag("")


@dataclass(frozen=True, kw_only=True)
class TaskText:
    """Instruction of the task: one of text, attribute and file_name.

    Attributes:
        text: Instruction of all episodes.
        attribute: Attribute of the HDF5 file's episode, or of a group above it; "ep_meta.lang" is the value `lang` of
        the JSON in `ep_meta`.
        file_name: Use the file's name: "stack_the_cups_003" becomes "stack the cups".
    """

    text: str = ""
    attribute: str = _hdf5("")
    file_name: bool = False


@dataclass(frozen=True, kw_only=True)
class Clock:
    """Times of the rows, and the messages that they take.

    Attributes:
        fps: Rows per second, also of the dataset. A bag has a row for each image of the slowest camera among those with
        `fps` images per second; without any, evenly spaced rows. Required for bags; 0 uses the HDF5 file's own rate.
        stamp: Whether a message's time is its header time or its log time.
        max_age_s: Maximum age of a message at its row, which takes the last one before it.
        max_trim_s: Maximum time to leave out at the bag's beginning and end if a stream starts late or ends early.
    """

    fps: int = 0
    stamp: Literal["header", "log"] = _bag("header")
    max_age_s: float = _bag(0.2)
    max_trim_s: float = _bag(1.0)


@dataclass(frozen=True, kw_only=True)
class Episodes:
    """Episodes of an HDF5 file; a bag is one episode.

    Attributes:
        group: Group in which each group is an episode, "/" for the root; "" if the file itself is one.
        success: Boolean attribute of the episode, or a dataset with a last row above 0 for success; "" if unknown.
    """

    group: str = ""
    success: str = ""


@dataclass(frozen=True, kw_only=True)
class SourceMapping:
    """A complete mapping.

    Attributes:
        kind: Kind of its sources.
        robot, task, clock, episodes: See these classes.
        features: Name of a feature -> its sources, in order.
        cameras: Name of a camera -> its images.
    """

    kind: SourceKind = "bag"
    robot: Robot
    task: TaskText
    clock: Clock = dataclasses.field(default_factory=Clock)
    episodes: Episodes = dataclasses.field(default_factory=Episodes, metadata=_HDF5)
    features: Mapping[str, tuple[Source, ...]] = dataclasses.field(default_factory=dict)
    cameras: Mapping[str, CameraSource] = dataclasses.field(default_factory=dict)

    @cached_property
    def digest(self) -> str:
        """First 16 hex digits of the digest of all settings."""
        return digest(self)

    @property
    def datasets(self) -> frozenset[str]:
        """All datasets that it names below an episode's group."""
        parts = {part.dataset for parts in self.features.values() for part in parts}
        named = parts | {camera.dataset for camera in self.cameras.values()} | {self.episodes.success}
        return frozenset(name.strip("/") for name in named)
