"""What of a bag or an HDF5 file becomes what of an episode: the user's own words, from a TOML file (docs/import.md).

[[features."observation.state"]]      a feature is one source or several, one behind the other
topic = "/joint_states"               of a bag; of an HDF5 file: dataset = "obs/robot0_joint_pos"
field = "position"
joints = ["fr3_joint1", "fr3_joint2"]"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from demorec.sources.mapping_file import (
    ACTION,
    MAX_FPS,
    MAX_SECONDS,
    AnyMapping,
    Part,
    camera_name_problems,
    feature_problems,
    read_mapping_file,
)

Sampling = Literal["latest", "nearest", "linear"]
Stamp = Literal["header", "log"]
ROWS = ("camera", "grid")
"""Values of `Clock.rows` that are no topic."""


@dataclass(frozen=True, kw_only=True)
class Source(Part):
    """A part of a feature: numbers of one topic. Attributes as of `Part`, and:

    Attributes:
        topic: Where they are.
        field: Path of the numbers in a message: "position", "pose.orientation", "transforms[child_frame_id=hand]".
        joints: Elements by name, in this order, where the message names them.
        names_field: Where it names them (auto: "name" or "joint_names" beside the field).
        stamp: As `Clock.stamp`, for this source.
        sample: As `Clock.sample`, for this source.
        max_age_s: As `Clock.max_age_s`, for this source.
    """

    topic: str = ""
    field: str = ""
    joints: tuple[str, ...] = ()
    names_field: str = ""
    stamp: Stamp | None = None
    sample: Sampling | None = None
    max_age_s: float | None = None


@dataclass(frozen=True, kw_only=True)
class CameraSource:
    """A camera's pictures.

    Attributes:
        topic: Of its pictures: sensor_msgs Image or CompressedImage, foxglove RawImage, CompressedImage or
            CompressedVideo.
        info_topic: Of its calibration (CameraInfo, CameraCalibration).
        stamp: As `Clock.stamp`, for this camera.
        sample: As `Clock.sample`; pictures are never mixed.
        max_age_s: As `Clock.max_age_s`, for this camera.
    """

    topic: str
    info_topic: str = ""
    stamp: Stamp | None = None
    sample: Literal["latest", "nearest"] | None = None
    max_age_s: float | None = None


@dataclass(frozen=True, kw_only=True)
class Robot:
    """Which robot it was.

    Attributes:
        name: Free to choose; all datasets that shall be merged need the same.
        urdf: File of its model, relative to the mapping's.
        urdf_topic: Where the bag holds its model: "/robot_description".
    """

    name: str
    urdf: str = ""
    urdf_topic: str = ""


@dataclass(frozen=True, kw_only=True)
class TaskText:
    """What the robot was asked to do; one of the three.

    Attributes:
        text: The same for all episodes.
        topic: Of texts; the last one before the episode's end holds.
        field: Of the text in that topic's messages.
        file_name: Take the bag's name, "stack_the_cups_003" being "stack the cups".
    """

    text: str = ""
    topic: str = ""
    field: str = "data"
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
        fps: Rows a second; that of the dataset.
        rows: "camera": a row for each image of the slowest camera of those that give `fps` images a second (where none
            does, a grid); "grid": evenly spaced; or a topic: a row for each of its messages.
        stamp: Whether a message's time is that of its header, or when it was recorded.
        sample: The last message before the row, the nearest one, or the straight line between its neighbours.
        max_age_s: How far from the row a message may be.
        when_old: What to do where it is farther, or missing.
        max_trim_s: How much of the bag's beginning and end may be left out because a stream starts late or ends early.
    """

    fps: int
    rows: str = "camera"
    stamp: Stamp = "header"
    sample: Sampling = "latest"
    max_age_s: float = 0.2
    when_old: Literal["error", "drop_episode"] = "error"
    max_trim_s: float = 1.0


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
        success, failure: Texts of markers that say how it ended.
        discard: Texts of markers that leave out the episode under way, or else the one before.
        ignore: Texts of markers that mean nothing here; any other text is an error.
        gap_s: A pause of all streams longer than that ends an episode.
        times_s: [begin, end] of each episode, seconds from the bag's first message.
    """

    cut: Literal["file", "marker", "service", "gap", "times"] = "file"
    topic: str = ""
    field: str = "data"
    start_topic: str = ""
    stop_topic: str = ""
    start: str = "start"
    stop: str = "stop"
    success: str = "success"
    failure: str = "failure"
    discard: tuple[str, ...] = ("discard",)
    ignore: tuple[str, ...] = ()
    gap_s: float = 5.0
    times_s: tuple[tuple[float, float], ...] = ()

    @property
    def services(self) -> frozenset[str]:
        """Topics of the events of services that cut."""
        return frozenset({self.topic, self.start_topic, self.stop_topic} - {""} if self.cut == "service" else ())


@dataclass(frozen=True, kw_only=True)
class BagMapping(AnyMapping):
    """A whole mapping.

    Attributes:
        robot, task, subtasks, clock, episodes: As described there.
        features: Name of a feature -> its sources, in order.
        cameras: Name of a camera -> its pictures.
    """

    robot: Robot
    task: TaskText
    subtasks: Subtasks = field(default_factory=Subtasks)
    clock: Clock
    episodes: Episodes = field(default_factory=Episodes)
    features: Mapping[str, tuple[Source, ...]] = field(default_factory=dict)
    cameras: Mapping[str, CameraSource] = field(default_factory=dict)

    @property
    def topics(self) -> frozenset[str]:
        """All that it names."""
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

    def problems(self) -> Iterator[str]:
        """What is impossible in it, whatever the bag."""
        yield from feature_problems(self.features)
        for name, sources in self.features.items():
            for source in sources:
                yield from _source_problems(name, source)
        if ACTION not in self.features:
            yield "there is no feature 'action': name its topic, or next = \"observation.state\""
        yield from camera_name_problems(self.cameras)
        for name, camera in self.cameras.items():
            yield from _age_problems(f"cameras.{name}", camera.max_age_s)
        yield from self._table_problems()

    def _table_problems(self) -> Iterator[str]:
        task, clock, episodes = self.task, self.clock, self.episodes
        if (bool(task.text.strip()) + bool(task.topic) + task.file_name) != 1:
            yield "[task] needs one of text, topic and file_name"
        if not 1 <= clock.fps <= MAX_FPS:
            yield f"clock.fps is {clock.fps}, allowed are 1 to {MAX_FPS}"
        yield from _age_problems("clock", clock.max_age_s)
        fields = {task.topic: task.field, **({episodes.topic: episodes.field} if episodes.cut == "marker" else {})}
        if self.subtasks.topic and fields.get(self.subtasks.topic, self.subtasks.field) != self.subtasks.field:
            yield f"subtasks.field is {self.subtasks.field!r}, but another field of the same topic is taken for texts"
        if not self.robot.name.strip():
            yield "robot.name is empty"
        if self.robot.urdf and self.robot.urdf_topic:
            yield "robot.urdf and robot.urdf_topic are both given, one is enough"
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


def _source_problems(name: str, source: Source) -> Iterator[str]:
    place = f"the feature {name!r}"
    if bool(source.topic) == bool(source.next):
        yield f"{place} needs either a topic or next in each of its sources"
    if source.topic and not source.field:
        yield f"{place} needs the field of {source.topic}"
    if source.joints and source.elements:
        yield f"{place} picks elements of {source.topic} both by joints and by elements"
    if len(set(source.joints)) != len(source.joints):
        yield f"{place} names a joint of {source.topic} twice"
    yield from _age_problems(place, source.max_age_s)


def read_mapping(path: Path) -> BagMapping:
    """A mapping of bags from its file; ConfigError tells all that is wrong with it at once."""
    return read_mapping_file(path, BagMapping)


@dataclass(frozen=True, kw_only=True)
class DatasetPart(Part):
    """A part of a feature: numbers of one dataset. Attributes as of `Part`, and:

    Attributes:
        dataset: Where they are, below the episode's group: (T, D) or (T,).
    """

    dataset: str = ""


@dataclass(frozen=True, kw_only=True)
class CameraDataset:
    """A camera's pictures.

    Attributes:
        dataset: Where they are, below the episode's group: (T, H, W, 3) or (T, 3, H, W), uint8 or floats from 0 to 1 or
            to 255; or a JPEG file in each row, (T, N) uint8 padded with zeros or (T,) of variable length; of a depth
            camera (T, H, W) or (T, H, W, 1), uint16 mm or float32 m.
        colors: Order of the colours; in JPEG files it is red first by the format itself, but OpenCV writes them of
            pixels that it takes to have blue first.
    """

    dataset: str
    colors: Literal["rgb", "bgr"] = "rgb"


@dataclass(frozen=True, kw_only=True)
class Hdf5Robot:
    """Which robot it was.

    Attributes:
        name: Free to choose; all datasets that shall be merged need the same.
        urdf: File of its model, relative to the mapping's.
        urdf_attribute: Of the episode, which holds its model.
    """

    name: str
    urdf: str = ""
    urdf_attribute: str = ""


@dataclass(frozen=True, kw_only=True)
class Hdf5Task:
    """What the robot was asked to do; one of the three.

    Attributes:
        text: The same for all episodes.
        attribute: Of the episode's group, or of one above it; "ep_meta.lang" is the value `lang` of the JSON in
            `ep_meta`.
        file_name: Take the file's name, "stack_the_cups_003" being "stack the cups".
    """

    text: str = ""
    attribute: str = ""
    file_name: bool = False


@dataclass(frozen=True, kw_only=True)
class Hdf5Clock:
    """When rows were.

    Attributes:
        fps: Rows a second (auto: as the file's attributes say, where they do).
    """

    fps: int | None = None


@dataclass(frozen=True, kw_only=True)
class Hdf5Episodes:
    """Where the episodes are.

    Attributes:
        group: Of which every group is an episode; "" where the file itself is one.
        mask: Only those that the dataset of that name in `mask` lists.
        success: An attribute of the episode that says whether it is one, or a dataset whose last row is above 0 then.
    """

    group: str = ""
    mask: str = ""
    success: str = ""


@dataclass(frozen=True, kw_only=True)
class Hdf5Mapping(AnyMapping):
    """A whole mapping.

    Attributes:
        robot, task, clock, episodes: As described there.
        features: Name of a feature -> its parts, in order.
        cameras: Name of a camera -> its pictures.
        leave_out: Datasets, or groups of them, whose pictures shall not be imported.
    """

    robot: Hdf5Robot
    task: Hdf5Task
    clock: Hdf5Clock = field(default_factory=Hdf5Clock)
    episodes: Hdf5Episodes = field(default_factory=Hdf5Episodes)
    features: Mapping[str, tuple[DatasetPart, ...]]
    cameras: Mapping[str, CameraDataset] = field(default_factory=dict)
    leave_out: tuple[str, ...] = ()

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
        """What is impossible in it, whatever the file."""
        yield from feature_problems(self.features)
        for name, parts in self.features.items():
            if any(bool(part.dataset) == bool(part.next) for part in parts):
                yield f"the feature {name!r} needs either a dataset or next in each of its parts"
        if ACTION not in self.features:
            yield "there is no feature 'action': name its dataset, or next = \"observation.state\""
        yield from camera_name_problems(self.cameras)
        for name in sorted(filter(self.leaves_out, self.datasets)):
            yield f"leave_out leaves out {name!r}, which the mapping names"
        task = self.task
        if (bool(task.text.strip()) + bool(task.attribute) + task.file_name) != 1:
            yield "[task] needs one of text, attribute and file_name"
        if self.clock.fps is not None and not 1 <= self.clock.fps <= MAX_FPS:
            yield f"clock.fps is {self.clock.fps}, allowed are 1 to {MAX_FPS}"
        if not self.robot.name.strip():
            yield "robot.name is empty"
        if self.robot.urdf and self.robot.urdf_attribute:
            yield "robot.urdf and robot.urdf_attribute are both given, one is enough"
        if self.episodes.mask and not self.episodes.group:
            yield "episodes.mask chooses among the episodes of a group, but episodes.group is empty"
