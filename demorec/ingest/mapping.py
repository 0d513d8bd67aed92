"""What of a bag becomes what of an episode: the user's own words, from a TOML file (docs/import.md).

[[features."observation.state"]]      a feature is one source or several, one behind the other
topic = "/joint_states"
field = "position"
joints = ["fr3_joint1", "fr3_joint2"]
"""

from __future__ import annotations

import dataclasses
import math
import tomllib
import typing
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from demorec.errors import ConfigError
from demorec.plain import digest, from_plain
from demorec.registry import nearest_match
from demorec.safety.files import read_text_limited

Sampling = Literal["latest", "nearest", "linear"]
Unit = Literal["", "rad", "degree", "percent", "m", "mm"]
STATE = "observation.state"
ACTION = "action"
MAX_FPS = 1000
_MAX_FILE_BYTES = 1 << 20


@dataclass(frozen=True, kw_only=True)
class Source:
    """A part of a feature: numbers of one topic.

    Attributes:
        topic: Where they are.
        field: Path of the numbers in a message: "position", "pose.orientation", "transforms[child_frame_id=hand]".
        joints: Elements by name, in this order, where the message names them.
        names_field: Where it names them (auto: "name" or "joint_names" beside the field).
        elements: Elements by number, in this order, where it does not.
        names: Of the elements in the feature (auto: the joints', or those of the fields).
        prefix: In front of each name, for two arms with the same names.
        unit: Of the bag.
        to: Unit of the feature (auto: the bag's, so that no bit changes).
        limits: [lowest, highest] of each element in the unit `to`, which -100..100 ("percent") stands for.
        sample: As `Clock.sample`, for this source.
        max_age_s: As `Clock.max_age_s`, for this source.
        next: In place of a topic: the feature whose value at the next row this one has.
    """

    topic: str = ""
    field: str = ""
    joints: tuple[str, ...] = ()
    names_field: str = ""
    elements: tuple[int, ...] = ()
    names: tuple[str, ...] = ()
    prefix: str = ""
    unit: Unit = ""
    to: Unit = ""
    limits: tuple[tuple[float, float], ...] = ()
    sample: Sampling | None = None
    max_age_s: float | None = None
    next: str = ""


@dataclass(frozen=True, kw_only=True)
class CameraSource:
    """A camera's pictures.

    Attributes:
        topic: Of its pictures: sensor_msgs Image or CompressedImage, foxglove RawImage, CompressedImage or
            CompressedVideo.
        info_topic: Of its calibration (CameraInfo, CameraCalibration).
        sample: As `Clock.sample`; pictures are never mixed.
        max_age_s: As `Clock.max_age_s`, for this camera.
    """

    topic: str
    info_topic: str = ""
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
class Clock:
    """When rows are, and which messages they hold.

    Attributes:
        fps: Rows a second; that of the dataset.
        rows: "grid": evenly spaced; or a topic: a row for each of its messages.
        stamp: Whether a message's time is that of its header, or when it was recorded.
        sample: The last message before the row, the nearest one, or the straight line between its neighbours.
        max_age_s: How far from the row a message may be.
        when_old: What to do where it is farther, or missing.
        max_trim_s: How much of the bag's beginning and end may be left out because a stream starts late or ends early.
    """

    fps: int
    rows: str = "grid"
    stamp: Literal["header", "log"] = "header"
    sample: Sampling = "latest"
    max_age_s: float = 0.2
    when_old: Literal["error", "drop_episode"] = "error"
    max_trim_s: float = 1.0


@dataclass(frozen=True, kw_only=True)
class Episodes:
    """Where one episode ends and another begins.

    Attributes:
        cut: A bag is an episode; or markers, a gap in the rows' streams, or a list of times cut it.
        topic: Of the markers.
        field: Of the text, number or boolean in a marker.
        start, stop: Texts of markers that begin and end an episode (text only; a boolean does both).
        success, failure: Texts of markers that say how it ended.
        gap_s: A pause of all streams longer than that ends an episode.
        times_s: [begin, end] of each episode, seconds from the bag's first message.
    """

    cut: Literal["file", "marker", "gap", "times"] = "file"
    topic: str = ""
    field: str = "data"
    start: str = "start"
    stop: str = "stop"
    success: str = "success"
    failure: str = "failure"
    gap_s: float = 5.0
    times_s: tuple[tuple[float, float], ...] = ()


@dataclass(frozen=True, kw_only=True)
class BagMapping:
    """A whole mapping.

    Attributes:
        robot, task, clock, episodes: As described there.
        features: Name of a feature -> its sources, in order.
        cameras: Name of a camera -> its pictures.
    """

    robot: Robot
    task: TaskText
    clock: Clock
    episodes: Episodes = field(default_factory=Episodes)
    features: Mapping[str, tuple[Source, ...]]
    cameras: Mapping[str, CameraSource] = field(default_factory=dict)

    @property
    def digest(self) -> str:
        """16 hex digits of all it says."""
        return digest(self)

    @property
    def topics(self) -> frozenset[str]:
        """All that it names."""
        named = {source.topic for sources in self.features.values() for source in sources}
        named |= {topic for camera in self.cameras.values() for topic in (camera.topic, camera.info_topic)}
        named |= {self.task.topic, self.robot.urdf_topic, "" if self.clock.rows == "grid" else self.clock.rows}
        if self.episodes.cut == "marker":
            named.add(self.episodes.topic)
        return frozenset(named - {""})

    def problems(self) -> Iterator[str]:
        """What is impossible in it, whatever the bag."""
        if STATE not in self.features:
            yield f"there is no feature {STATE!r}"
        for name, sources in self.features.items():
            if "/" in name or not name or name.startswith("observation.images"):
                yield f"a feature cannot be called {name!r}"
            if not sources:
                yield f"the feature {name!r} has no source"
            for source in sources:
                yield from _source_problems(name, source, self)
        if ACTION not in self.features:
            yield "there is no feature 'action': name its topic, or next = \"observation.state\""
        for name, camera in self.cameras.items():
            if not name.isidentifier():
                yield f"a camera cannot be called {name!r}: letters, digits and underscores are allowed"
            yield from _age_problems(f"cameras.{name}", camera.max_age_s)
        yield from self._table_problems()

    def _table_problems(self) -> Iterator[str]:
        task, clock, episodes = self.task, self.clock, self.episodes
        if (bool(task.text.strip()) + bool(task.topic) + task.file_name) != 1:
            yield "[task] needs one of text, topic and file_name"
        if not 1 <= clock.fps <= MAX_FPS:
            yield f"clock.fps is {clock.fps}, allowed are 1 to {MAX_FPS}"
        yield from _age_problems("clock", clock.max_age_s)
        if not self.robot.name.strip():
            yield "robot.name is empty"
        if self.robot.urdf and self.robot.urdf_topic:
            yield "robot.urdf and robot.urdf_topic are both given, one is enough"
        if episodes.cut == "marker" and not episodes.topic:
            yield 'episodes.cut = "marker" needs episodes.topic'
        if episodes.cut == "times" and not episodes.times_s:
            yield 'episodes.cut = "times" needs episodes.times_s'
        if any(not begin < end for begin, end in episodes.times_s):
            yield "episodes.times_s has an episode that ends before it begins"
        if episodes.gap_s <= 0:
            yield f"episodes.gap_s is {episodes.gap_s:g}, it must be above 0"


def _age_problems(place: str, age: float | None) -> Iterator[str]:
    if age is not None and not age > 0:
        yield f"{place}.max_age_s is {age:g}, it must be above 0"


def _source_problems(name: str, source: Source, mapping: BagMapping) -> Iterator[str]:
    place = f"the feature {name!r}"
    if bool(source.topic) == bool(source.next):
        yield f"{place} needs either a topic or next in each of its sources"
    if source.next and len(mapping.features[name]) > 1:
        yield f"{place} has other sources beside next"
    if source.next:
        known = [other for other in mapping.features if other != name]
        if source.next not in known:
            yield f"{place} follows {source.next!r}, which is no feature.{nearest_match(source.next, known)}".rstrip(
                "."
            )
        elif any(other.next for other in mapping.features[source.next]):
            yield f"{place} follows {source.next!r}, which follows another feature itself"
    elif not source.field:
        yield f"{place} needs the field of {source.topic}"
    if source.joints and source.elements:
        yield f"{place} picks elements of {source.topic} both by joints and by elements"
    for what, items in (("joint", source.joints), ("element", source.elements)):
        if len(set(items)) != len(items):
            yield f"{place} names a {what} of {source.topic} twice"
    pair = (source.unit, source.to or source.unit)
    if pair not in _CONVERSIONS and pair[0] != pair[1]:
        yield f"{place} cannot turn {source.unit or 'no unit'} into {source.to}"
    if "percent" in pair and pair[0] != pair[1] and not source.limits:
        yield f"{place} needs limits, since -100..100 stands for each joint's own range"
    if any(not low < high for low, high in source.limits):
        yield f"{place} has limits that are not [lowest, highest]"
    yield from _age_problems(place, source.max_age_s)


_CONVERSIONS: Mapping[tuple[str, str], float] = {
    ("degree", "rad"): math.pi / 180,
    ("rad", "degree"): 180 / math.pi,
    ("mm", "m"): 1e-3,
    ("m", "mm"): 1e3,
    ("percent", "rad"): math.nan,
    ("percent", "degree"): math.nan,
    ("percent", "m"): math.nan,
}
"""(unit of the bag, unit of the feature) -> factor; NaN where each element has its own."""


def conversion_factor(unit: str, to: str) -> float | None:
    """What numbers are multiplied with; None for not at all, NaN where `Source.limits` say it for each element."""
    return _CONVERSIONS.get((unit, to or unit))


def read_mapping(path: Path) -> BagMapping:
    """A mapping from its file; ConfigError tells all that is wrong with it at once."""
    try:
        data = tomllib.loads(read_text_limited(path, _MAX_FILE_BYTES))
    except OSError as error:
        raise ConfigError(f"The mapping cannot be read ({error.strerror}): {path}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ConfigError(f"The mapping is no valid TOML ({error}): {path}") from error
    unknown = list(_unknown_keys(data, BagMapping, ""))
    if unknown:
        raise ConfigError(f"The mapping cannot be used: {'; '.join(unknown)}: {path}")
    try:
        mapping = from_plain(_whole_numbers_as_floats(data, BagMapping), BagMapping)
    except ValueError as error:
        raise ConfigError(f"The mapping cannot be used: {error}: {path}") from error
    if problems := list(mapping.problems()):
        raise ConfigError(f"The mapping cannot be used: {'; '.join(problems)}: {path}")
    return mapping


def _children(value: Any, kind: Any) -> Iterator[tuple[str, Any, Any]]:
    """(key, value, type) of what is in a table or list that a type describes."""
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if dataclasses.is_dataclass(kind) and isinstance(value, dict):
        hints = typing.get_type_hints(kind)
        for key, item in value.items():
            if key in hints:
                yield key, item, hints[key]
    elif origin is not None and isinstance(value, dict) and len(arguments) == 2:
        for key, item in value.items():
            yield key, item, arguments[1]
    elif origin is tuple and isinstance(value, list):
        for item in value:
            yield "", item, arguments[0]


def _unknown_keys(value: Any, kind: Any, place: str) -> Iterator[str]:
    if dataclasses.is_dataclass(kind) and isinstance(value, dict):
        known = [row.name for row in dataclasses.fields(kind)]
        where = f" in {place}" if place else ""
        for key in value:
            if key not in known:
                yield f"unknown key {key!r}{where}.{nearest_match(key, known)}".rstrip(".")
    for key, item, child in _children(value, kind):
        yield from _unknown_keys(item, child, f"{place}.{key}".strip("."))


def _whole_numbers_as_floats(value: Any, kind: Any) -> Any:
    """The same, with `max_age_s = 1` as 1.0, which people write and the strict reader of dataclasses refuses."""
    if isinstance(value, int) and not isinstance(value, bool) and float in (kind, *typing.get_args(kind)):
        return float(value)
    if isinstance(value, list) and typing.get_origin(kind) is tuple:
        arguments = typing.get_args(kind)
        return [_whole_numbers_as_floats(item, arguments[0]) for item in value]
    if isinstance(value, dict):
        return value | {key: _whole_numbers_as_floats(item, child) for key, item, child in _children(value, kind)}
    return value
