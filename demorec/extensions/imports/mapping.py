"""What of a bag or an HDF5 file becomes what of an episode: the user's own words, from a TOML file (docs/import.md).

[[features."observation.state"]]      a feature is one source or several, one behind the other
topic = "/joint_states"               of a bag; of an HDF5 file: dataset = "obs/robot0_joint_pos"
field = "position"
joints = ["fr3_joint1", "fr3_joint2"]

Most keys mean the same for both; those of one kind alone are marked, and refused in a mapping of the other.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

from demorec.core.plain import digest

SourceKind = Literal["bag", "hdf5"]
Unit = Literal["", "rad", "degree", "percent", "m", "mm"]
Sampling = Literal["latest", "nearest", "linear"]
Stamp = Literal["header", "log"]
MAX_FPS = 1000
MAX_ELEMENTS = 4096
"""Of a source: more is an image or a point cloud, not a vector."""
MAX_SECONDS = 1e9
"""Of any time in a mapping: beyond it nanoseconds are no numbers of 64 bits."""
ROWS = ("camera", "grid")
"""Values of `Clock.rows` that are no topic."""
KIND = "kind"
"""In a field's metadata: the kind of source to which it belongs alone."""

_BAG, _HDF5 = {KIND: "bag"}, {KIND: "hdf5"}
"""Metadata of keys that only mappings of that kind have."""


def _bag(default: Any) -> Any:
    """A key that only mappings of bags have."""
    return dataclasses.field(default=default, metadata=_BAG)


def _hdf5(default: Any) -> Any:
    """A key that only mappings of HDF5 files have."""
    return dataclasses.field(default=default, metadata=_HDF5)


@dataclass(frozen=True, kw_only=True)
class Source:
    """A part of a feature: numbers of one topic, or of one dataset.

    Attributes:
        topic: Of a bag: where they are.
        field: Path of the numbers in a message: "position", "pose.orientation", "transforms[child_frame_id=hand]".
        joints: Elements by name, in this order, where the message names them.
        names_field: Where it names them (auto: "name" or "joint_names" beside the field).
        stamp: As `Clock.stamp`, for this source.
        sample: As `Clock.sample`, for this source.
        max_age_s: As `Clock.max_age_s`, for this source.
        dataset: Of an HDF5 file: where they are, below the episode's group: (T, D) or (T,).
        elements: By number, in this order (auto: all).
        names: Of the elements in the feature (auto: as the source calls them).
        prefix: In front of each name, for two arms with the same names.
        unit: Of the source.
        to: Unit of the feature (auto: the source's, so that no bit changes).
        limits: [lowest, highest] of each element in the unit `to`, which -100..100 ("percent") stands for.
        next: In place of a source: the feature whose value at the next row this one has.
    """

    elements: tuple[int, ...] = ()
    names: tuple[str, ...] = ()
    prefix: str = ""
    unit: Unit = ""
    to: Unit = ""
    limits: tuple[tuple[float, float], ...] = ()
    next: str = ""
    topic: str = _bag("")
    field: str = _bag("")
    joints: tuple[str, ...] = _bag(())
    names_field: str = _bag("")
    stamp: Stamp | None = _bag(None)
    sample: Sampling | None = _bag(None)
    max_age_s: float | None = _bag(None)
    dataset: str = _hdf5("")

    @property
    def place(self) -> str:
        """Where its numbers are, for people."""
        return f"the next {self.next}" if self.next else self.dataset or f"{self.topic} {self.field}"


@dataclass(frozen=True, kw_only=True)
class CameraSource:
    """A camera's images.

    Attributes:
        topic: Of a bag: sensor_msgs Image or CompressedImage, foxglove RawImage, CompressedImage or CompressedVideo.
        info_topic: Of its calibration (CameraInfo, CameraCalibration).
        stamp: As `Clock.stamp`, for this camera.
        sample: As `Clock.sample`; images are never mixed.
        max_age_s: As `Clock.max_age_s`, for this camera.
        dataset: Of an HDF5 file, below the episode's group: (T, H, W, 3) or (T, 3, H, W), uint8 or floats from 0 to 1
            or to 255; or a JPEG file in each row, (T, N) uint8 padded with zeros or (T,) of variable length; of a depth
            camera (T, H, W) or (T, H, W, 1), uint16 mm or float32 m.
        colors: Order of the colours there; in JPEG files it is red first by the format itself, but OpenCV writes them
            of pixels that it takes to have blue first.
    """

    topic: str = _bag("")
    info_topic: str = _bag("")
    stamp: Stamp | None = _bag(None)
    sample: Literal["latest", "nearest"] | None = _bag(None)
    max_age_s: float | None = _bag(None)
    dataset: str = _hdf5("")
    colors: Literal["rgb", "bgr"] = _hdf5("rgb")


@dataclass(frozen=True, kw_only=True)
class Robot:
    """Which robot it was.

    Attributes:
        name: Free to choose; all datasets that shall be merged need the same.
        urdf: File of its model, relative to the mapping's.
        urdf_topic: Where the bag holds its model: "/robot_description".
        urdf_attribute: Of the HDF5 file's episode, which holds its model.
    """

    name: str
    urdf: str = ""
    urdf_topic: str = _bag("")
    urdf_attribute: str = _hdf5("")


@dataclass(frozen=True, kw_only=True)
class TaskText:
    """What the robot was asked to do; one of text, topic or attribute, and file_name.

    Attributes:
        text: The same for all episodes.
        topic: Of texts; the last one before the episode's end holds.
        field: Of the text in that topic's messages.
        attribute: Of the HDF5 file's episode, or of a group above it; "ep_meta.lang" is the value `lang` of the JSON in
            `ep_meta`.
        file_name: Take the file's name, "stack_the_cups_003" being "stack the cups".
    """

    text: str = ""
    topic: str = _bag("")
    field: str = _bag("data")
    attribute: str = _hdf5("")
    file_name: bool = False


@dataclass(frozen=True, kw_only=True)
class Subtasks:
    """What the robot does at the moment, in words; each text holds from its message on.

    Attributes:
        topic: Of the texts, which may be that of the markers; "" where nobody says it.
        field: Of the text in that topic's messages.
    """

    topic: str = ""
    field: str = "data"


@dataclass(frozen=True, kw_only=True)
class Clock:
    """When rows are, and which messages they hold.

    Attributes:
        fps: Rows a second; that of the dataset. A bag needs it; 0 is what an HDF5 file says itself.
        rows: "camera": a row for each image of the slowest camera of those that give `fps` images a second (where none
            does, a grid); "grid": evenly spaced; or a topic: a row for each of its messages.
        stamp: Whether a message's time is that of its header, or when it was recorded.
        sample: The last message before the row, the nearest one, or the straight line between its neighbours.
        max_age_s: How far from the row a message may be.
        when_old: What to do where it is farther, or missing.
        max_trim_s: How much of the bag's beginning and end may be left out because a stream starts late or ends early.
    """

    fps: int = 0
    rows: str = _bag("camera")
    stamp: Stamp = _bag("header")
    sample: Sampling = _bag("latest")
    max_age_s: float = _bag(0.2)
    when_old: Literal["error", "drop_episode"] = _bag("error")
    max_trim_s: float = _bag(1.0)


@dataclass(frozen=True, kw_only=True)
class Episodes:
    """Where one episode ends and another begins.

    Attributes:
        cut: A bag is an episode; or markers, a gap in the rows' streams, or a list of times cut it.
        topic: Of the markers.
        field: Of the text, number or boolean in a marker.
        start, stop: Texts of markers that begin and end an episode (text only; a boolean does both).
        success, failure: Texts of markers that say how it ended. Of an HDF5 file, success is an attribute of the
            episode that says whether it is one, or a dataset whose last row is above 0 then.
        discard: Texts of markers that leave out the episode under way, or else the one before.
        ignore: Texts of markers that mean nothing here; any other text is an error.
        gap_s: A pause of all streams longer than that ends an episode.
        group: Of which every group in an HDF5 file is an episode, "/" for those at its root; "" where the file itself
            is one.
        mask: Only those that the dataset of that name in `mask` lists.
        times_s: [begin, end] of each episode, seconds from the bag's first message.
    """

    cut: Literal["file", "marker", "gap", "times"] = _bag("file")
    topic: str = _bag("")
    field: str = _bag("data")
    start: str = _bag("start")
    stop: str = _bag("stop")
    success: str = "success"
    failure: str = _bag("failure")
    discard: tuple[str, ...] = _bag(("discard",))
    ignore: tuple[str, ...] = _bag(())
    gap_s: float = _bag(5.0)
    times_s: tuple[tuple[float, float], ...] = _bag(())
    group: str = _hdf5("")
    mask: str = _hdf5("")


@dataclass(frozen=True, kw_only=True)
class SourceMapping:
    """A whole mapping.

    Attributes:
        kind: Of what.
        robot, task, subtasks, clock, episodes: As described there.
        features: Name of a feature -> its sources, in order.
        cameras: Name of a camera -> its images.
        leave_out: Datasets of an HDF5 file, or groups of them, whose images shall not be imported.
    """

    kind: SourceKind = "bag"
    robot: Robot
    task: TaskText
    subtasks: Subtasks = dataclasses.field(default_factory=Subtasks, metadata=_BAG)
    clock: Clock = dataclasses.field(default_factory=Clock)
    episodes: Episodes = dataclasses.field(default_factory=Episodes)
    features: Mapping[str, tuple[Source, ...]] = dataclasses.field(default_factory=dict)
    cameras: Mapping[str, CameraSource] = dataclasses.field(default_factory=dict)
    leave_out: tuple[str, ...] = _hdf5(())

    @cached_property
    def digest(self) -> str:
        """16 hex digits of all that it says of its kind of source."""
        return digest(_said(self, self.kind))

    def leaves_out(self, dataset: str) -> bool:
        """Whether it says that a dataset, or a group that holds it, shall not be imported."""
        return any(f"{dataset}/".startswith(f"{name.strip('/')}/") for name in self.leave_out)

    @property
    def datasets(self) -> frozenset[str]:
        """All that it names below an episode's group."""
        parts = {part.dataset for parts in self.features.values() for part in parts}
        named = parts | {camera.dataset for camera in self.cameras.values()} | {self.episodes.success}
        return frozenset(name.strip("/") for name in named)


def _said(value: Any, kind: SourceKind) -> Any:
    """Of a mapping as plain data what is for its kind of source."""
    if dataclasses.is_dataclass(value):
        own = [one.name for one in dataclasses.fields(value) if one.metadata.get(KIND, kind) == kind]
        return {name: _said(getattr(value, name), kind) for name in own}
    if isinstance(value, Mapping):
        return {key: _said(item, kind) for key, item in value.items()}
    return [_said(item, kind) for item in value] if isinstance(value, tuple) else value


CONVERSIONS: Mapping[tuple[str, str], float] = {
    ("degree", "rad"): math.pi / 180,
    ("rad", "degree"): 180 / math.pi,
    ("mm", "m"): 1e-3,
    ("m", "mm"): 1e3,
    ("percent", "rad"): math.nan,
    ("percent", "degree"): math.nan,
    ("percent", "m"): math.nan,
}
"""(unit of the source, unit of the feature) -> factor; NaN where each element has its own."""
