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
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

from demorec.core.plain import digest
from demorec.core.registry import nearest_match
from demorec.episode.validity import MAX_CAMERAS, MAX_FEATURES

SourceKind = Literal["bag", "hdf5"]
Unit = Literal["", "rad", "degree", "percent", "m", "mm"]
Sampling = Literal["latest", "nearest", "linear"]
Stamp = Literal["header", "log"]
STATE = "observation.state"
ACTION = "action"
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
    topic: str = dataclasses.field(default="", metadata=_BAG)
    field: str = dataclasses.field(default="", metadata=_BAG)
    joints: tuple[str, ...] = dataclasses.field(default=(), metadata=_BAG)
    names_field: str = dataclasses.field(default="", metadata=_BAG)
    stamp: Stamp | None = dataclasses.field(default=None, metadata=_BAG)
    sample: Sampling | None = dataclasses.field(default=None, metadata=_BAG)
    max_age_s: float | None = dataclasses.field(default=None, metadata=_BAG)
    dataset: str = dataclasses.field(default="", metadata=_HDF5)

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

    topic: str = dataclasses.field(default="", metadata=_BAG)
    info_topic: str = dataclasses.field(default="", metadata=_BAG)
    stamp: Stamp | None = dataclasses.field(default=None, metadata=_BAG)
    sample: Literal["latest", "nearest"] | None = dataclasses.field(default=None, metadata=_BAG)
    max_age_s: float | None = dataclasses.field(default=None, metadata=_BAG)
    dataset: str = dataclasses.field(default="", metadata=_HDF5)
    colors: Literal["rgb", "bgr"] = dataclasses.field(default="rgb", metadata=_HDF5)


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
    urdf_topic: str = dataclasses.field(default="", metadata=_BAG)
    urdf_attribute: str = dataclasses.field(default="", metadata=_HDF5)


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
    topic: str = dataclasses.field(default="", metadata=_BAG)
    field: str = dataclasses.field(default="data", metadata=_BAG)
    attribute: str = dataclasses.field(default="", metadata=_HDF5)
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
    rows: str = dataclasses.field(default="camera", metadata=_BAG)
    stamp: Stamp = dataclasses.field(default="header", metadata=_BAG)
    sample: Sampling = dataclasses.field(default="latest", metadata=_BAG)
    max_age_s: float = dataclasses.field(default=0.2, metadata=_BAG)
    when_old: Literal["error", "drop_episode"] = dataclasses.field(default="error", metadata=_BAG)
    max_trim_s: float = dataclasses.field(default=1.0, metadata=_BAG)


@dataclass(frozen=True, kw_only=True)
class Episodes:
    """Where one episode ends and another begins.

    Attributes:
        cut: A bag is an episode; or markers, calls of a service, a gap in the rows' streams, or a list of times cut it.
        topic: Of the markers, or of the service's events: "/record/_service_event".
        field: Of the text, number or boolean in a marker, or in the request of a call.
        start_topic, stop_topic: In place of topic: of the events of two services, a call of one beginning an episode
            and a call of the other ending it.
        start, stop: Texts of markers that begin and end an episode (text only; a boolean does both).
        success, failure: Texts of markers that say how it ended. Of an HDF5 file, success is an attribute of the
            episode that says whether it is one, or a dataset whose last row is above 0 then.
        discard: Texts of markers that leave out the episode under way, or else the one before.
        ignore: Texts of markers that mean nothing here; any other text is an error.
        gap_s: A pause of all streams longer than that ends an episode.
        group: Of which every group in an HDF5 file is an episode; "" where the file itself is one.
        mask: Only those that the dataset of that name in `mask` lists.
        times_s: [begin, end] of each episode, seconds from the bag's first message.
    """

    cut: Literal["file", "marker", "service", "gap", "times"] = dataclasses.field(default="file", metadata=_BAG)
    topic: str = dataclasses.field(default="", metadata=_BAG)
    field: str = dataclasses.field(default="data", metadata=_BAG)
    start_topic: str = dataclasses.field(default="", metadata=_BAG)
    stop_topic: str = dataclasses.field(default="", metadata=_BAG)
    start: str = dataclasses.field(default="start", metadata=_BAG)
    stop: str = dataclasses.field(default="stop", metadata=_BAG)
    success: str = "success"
    failure: str = dataclasses.field(default="failure", metadata=_BAG)
    discard: tuple[str, ...] = dataclasses.field(default=("discard",), metadata=_BAG)
    ignore: tuple[str, ...] = dataclasses.field(default=(), metadata=_BAG)
    gap_s: float = dataclasses.field(default=5.0, metadata=_BAG)
    times_s: tuple[tuple[float, float], ...] = dataclasses.field(default=(), metadata=_BAG)
    group: str = dataclasses.field(default="", metadata=_HDF5)
    mask: str = dataclasses.field(default="", metadata=_HDF5)

    @property
    def services(self) -> frozenset[str]:
        """Topics of the events of services that cut."""
        return frozenset({self.topic, self.start_topic, self.stop_topic} - {""} if self.cut == "service" else ())


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
    leave_out: tuple[str, ...] = dataclasses.field(default=(), metadata=_HDF5)

    @cached_property
    def digest(self) -> str:
        """16 hex digits of all that it says of its kind of source."""
        said = _said(self, self.kind)
        del said[KIND]
        said["clock"]["fps"] = self.clock.fps or None  # as it was when runs were begun that may be continued
        return digest(said)

    @property
    def topics(self) -> frozenset[str]:
        """All of a bag that it names."""
        named = {source.topic for sources in self.features.values() for source in sources}
        named |= {topic for camera in self.cameras.values() for topic in (camera.topic, camera.info_topic)}
        named |= {
            self.task.topic,
            self.subtasks.topic,
            self.robot.urdf_topic,
            "" if self.clock.rows in ROWS else self.clock.rows,
        }
        if self.episodes.cut == "marker":
            named.add(self.episodes.topic)
        return frozenset(named - {""}) | self.episodes.services

    def leaves_out(self, dataset: str) -> bool:
        """Whether it says that a dataset, or a group that holds it, shall not be imported."""
        return any(f"{dataset}/".startswith(f"{name.strip('/')}/") for name in self.leave_out)

    @property
    def datasets(self) -> frozenset[str]:
        """All that it names below an episode's group."""
        parts = {part.dataset for parts in self.features.values() for part in parts}
        named = parts | {camera.dataset for camera in self.cameras.values()} | {self.episodes.success}
        return frozenset(name.strip("/") for name in named)

    def problems(self) -> Iterator[str]:
        """What is impossible in it, whatever the bag or file."""
        yield from self._feature_problems()
        if ACTION not in self.features:
            what = "topic" if self.kind == "bag" else "dataset"
            yield f"there is no feature 'action': name its {what}, or next = \"observation.state\""
        yield from self._camera_problems()
        if not self.robot.name.strip():
            yield "robot.name is empty"
        task, clock = self.task, self.clock
        elsewhere = "topic" if self.kind == "bag" else "attribute"
        if (bool(task.text.strip()) + bool(task.topic or task.attribute) + task.file_name) != 1:
            yield f"[task] needs one of text, {elsewhere} and file_name"
        if self.robot.urdf and (self.robot.urdf_topic or self.robot.urdf_attribute):
            yield f"robot.urdf and robot.urdf_{elsewhere} are both given, one is enough"
        if not (clock.fps == 0 and self.kind == "hdf5") and not 1 <= clock.fps <= MAX_FPS:
            yield f"clock.fps is {clock.fps}, allowed are 1 to {MAX_FPS}"
        if self.kind == "bag":
            yield from self._bag_problems()
            return
        for name in sorted(filter(self.leaves_out, self.datasets)):
            yield f"leave_out leaves out {name!r}, which the mapping names"
        if self.episodes.mask and not self.episodes.group:
            yield "episodes.mask chooses among the episodes of a group, but episodes.group is empty"

    def _feature_problems(self) -> Iterator[str]:
        if len(self.features) > MAX_FEATURES:
            yield f"there are {len(self.features):,} features, allowed are up to {MAX_FEATURES}"
            return
        if STATE not in self.features:
            yield f'there is no feature {STATE!r}: write [[features."{STATE}"]] and what it is taken from'
        for name, sources in self.features.items():
            if "/" in name or not name or name.startswith("observation.images"):
                yield f"a feature cannot be called {name!r}"
            if not sources:
                yield f"the feature {name!r} has no source"
            for source in sources:
                yield from _element_problems(f"the feature {name!r}", source)
                yield from self._next_problems(name, source)
                yield from _place_problems(f"the feature {name!r}", source, self.kind)

    def _next_problems(self, name: str, source: Source) -> Iterator[str]:
        if not source.next:
            return
        place, known = f"the feature {name!r}", [other for other in self.features if other != name]
        if len(self.features[name]) > 1:
            yield f"{place} has other sources beside next"
        if source.next == STATE and STATE not in self.features:
            return  # said already
        if source.next not in known:
            yield f"{place} follows {source.next!r}, which is no feature.{nearest_match(source.next, known)}".rstrip(
                "."
            )
        elif any(other.next for other in self.features[source.next]):
            yield f"{place} follows {source.next!r}, which follows another feature itself"

    def _camera_problems(self) -> Iterator[str]:
        if len(self.cameras) > MAX_CAMERAS:
            yield f"there are {len(self.cameras):,} cameras, allowed are up to {MAX_CAMERAS}"
            return
        for name, camera in self.cameras.items():
            if not name.isidentifier():
                yield f"a camera cannot be called {name!r}: letters, digits and underscores are allowed"
            if not (camera.topic or camera.dataset):
                yield f"cameras.{name} needs a {'topic' if self.kind == 'bag' else 'dataset'}"
            yield from _age_problems(f"cameras.{name}", camera.max_age_s)

    def _bag_problems(self) -> Iterator[str]:
        task, clock, episodes = self.task, self.clock, self.episodes
        yield from _age_problems("clock", clock.max_age_s)
        fields = {task.topic: task.field, **({episodes.topic: episodes.field} if episodes.cut == "marker" else {})}
        if self.subtasks.topic and fields.get(self.subtasks.topic, self.subtasks.field) != self.subtasks.field:
            yield f"subtasks.field is {self.subtasks.field!r}, but another field of the same topic is taken for texts"
        if episodes.cut == "marker" and not episodes.topic:
            yield 'episodes.cut = "marker" needs episodes.topic'
        given = (bool(episodes.topic), bool(episodes.start_topic), bool(episodes.stop_topic))
        if episodes.cut == "service" and given not in ((True, False, False), (False, True, True)):
            yield 'episodes.cut = "service" needs either episodes.topic, or start_topic and stop_topic'
        if episodes.cut != "service" and any(given[1:]):
            yield 'episodes.start_topic and stop_topic are for episodes.cut = "service" alone'
        if episodes.cut == "times" and not episodes.times_s:
            yield 'episodes.cut = "times" needs episodes.times_s'
        if any(not begin < end for begin, end in episodes.times_s):
            yield "episodes.times_s has an episode that ends before it begins"
        if not 0 < episodes.gap_s <= MAX_SECONDS:
            yield f"episodes.gap_s is {episodes.gap_s:g}, it must be above 0 and at most {MAX_SECONDS:g}"
        if not 0 <= clock.max_trim_s <= MAX_SECONDS:
            yield f"clock.max_trim_s is {clock.max_trim_s:g}, it must be 0 to {MAX_SECONDS:g}"
        if any(not -MAX_SECONDS <= time <= MAX_SECONDS for times in episodes.times_s for time in times):
            yield f"episodes.times_s has a time beyond {MAX_SECONDS:g} s"


def _age_problems(place: str, age: float | None) -> Iterator[str]:
    if age is not None and not 0 < age <= MAX_SECONDS:
        yield f"{place}.max_age_s is {age:g}, it must be above 0 and at most {MAX_SECONDS:g}"


def _place_problems(place: str, source: Source, kind: SourceKind) -> Iterator[str]:
    """What is impossible in where a source's numbers are."""
    what = "topic" if kind == "bag" else "dataset"
    if bool(source.topic or source.dataset) == bool(source.next):
        yield f"{place} needs either a {what} or next in each of its {'sources' if kind == 'bag' else 'parts'}"
    if source.topic and not source.field:
        yield f"{place} needs the field of {source.topic}"
    if source.joints and source.elements:
        yield f"{place} picks elements of {source.topic} both by joints and by elements"
    if len(set(source.joints)) != len(source.joints):
        yield f"{place} names a joint of {source.topic} twice"
    yield from _age_problems(place, source.max_age_s)


def _element_problems(place: str, source: Source) -> Iterator[str]:
    """What is impossible in which numbers are taken, and in their units."""
    if len(set(source.elements)) != len(source.elements):
        yield f"{place} names an element twice"
    if any(element < 0 for element in source.elements):
        yield f"{place} names an element below 0"
    pair = (source.unit, source.to or source.unit)
    if pair not in _CONVERSIONS and pair[0] != pair[1]:
        yield f"{place} cannot turn {source.unit or 'no unit'} into {source.to}"
    if "percent" in pair and pair[0] != pair[1] and not source.limits:
        yield f"{place} needs limits, since -100..100 stands for each joint's own range"
    if any(not low < high for low, high in source.limits):
        yield f"{place} has limits that are not [lowest, highest]"


def _said(value: Any, kind: SourceKind) -> Any:
    """Of a mapping as plain data what is for its kind of source."""
    if dataclasses.is_dataclass(value):
        own = [one.name for one in dataclasses.fields(value) if one.metadata.get(KIND, kind) == kind]
        return {name: _said(getattr(value, name), kind) for name in own}
    if isinstance(value, Mapping):
        return {key: _said(item, kind) for key, item in value.items()}
    return [_said(item, kind) for item in value] if isinstance(value, tuple) else value


_CONVERSIONS: Mapping[tuple[str, str], float] = {
    ("degree", "rad"): math.pi / 180,
    ("rad", "degree"): 180 / math.pi,
    ("mm", "m"): 1e-3,
    ("m", "mm"): 1e3,
    ("percent", "rad"): math.nan,
    ("percent", "degree"): math.nan,
    ("percent", "m"): math.nan,
}
"""(unit of the source, unit of the feature) -> factor; NaN where each element has its own."""


def conversion_factor(unit: str, to: str) -> float | None:
    """What numbers are multiplied with; None for not at all, NaN where `Source.limits` say it for each element."""
    return _CONVERSIONS.get((unit, to or unit))


def recorded_unit(unit: str) -> str:
    """What recordings call a unit."""
    return "deg" if unit == "degree" else unit
