"""A mapping from what is in a bag: the likely choices made, the doubtful ones commented out, everything listed.

The words that people give their topics are what there is to go by: a follower, a puppet and a measured state are what
the robot does, a leader, a master and a command what it shall do. A topic that says neither is not guessed at.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from demorec.ingest.bag import Bag, open_bag
from demorec.ingest.channel import BagError, BagMessage
from demorec.ingest.clock import NS
from demorec.ingest.decoding import UnknownEncodingError
from demorec.ingest.fields import FieldError, OtherPublisherError, SourceLayout, follow, layout_of, stamp_of
from demorec.ingest.mapping import Source
from demorec.ingest.picture_messages import VIDEO_FORMATS, PictureHead, picture_head
from demorec.ingest.ros_types import Values
from demorec.ingest.streams import BagDecoder
from demorec.ingest.words import SHOWN, first_numbers, quoted, unique_name
from demorec.recording.limits import SpentError
from demorec.scene.collected import DEPTH_UNITS

_KEPT = 64
"""Messages of a topic that are looked into."""
_ACTION = re.compile(r"leader|master|gello|command|cmd|target|desired|goal|teleop|/action")
_STATE = re.compile(r"follower|puppet|measured|joint_states?$|joints/state$|robot_state")
_TASK = re.compile(r"(?<!sub)(?<!sub[_/-])task|instruction|prompt")
_POSE_TYPES = ("geometry_msgs/msg/PoseStamped", "geometry_msgs/PoseStamped", "foxglove.PoseInFrame")
_VECTOR_FIELDS = ("position", "positions", "joints.position", "points[0].positions", "data")
_STOP_WORDS = {"camera", "cam", "color", "image", "raw", "rect", "compressed", "rgb", "cameras", "images", "video"}
_DEPTH_WORDS = {"depth", "aligned", "to", "compresseddepth", "registered"}
_CAMERA_WORD = re.compile(r"[^a-z0-9]+")


@dataclass(kw_only=True, eq=False)
class _Topic:
    """What a topic has shown.

    Attributes:
        type: Of its messages.
        count: Of them.
        first_ns, last_ns: When they were recorded.
        values: Of the first ones.
        has_stamp: Whether these have headers with a time.
        problem: Why none can be read; "".
    """

    type: str
    count: int = 0
    first_ns: int = 0
    last_ns: int = 0
    values: list[Values] = field(default_factory=list)
    has_stamp: bool = True
    problem: str = ""

    @property
    def rate_hz(self) -> float:
        """Of its messages, on average."""
        seconds = (self.last_ns - self.first_ns) / NS
        return (self.count - 1) / seconds if self.count > 1 and seconds > 0 else 0.0


@dataclass(frozen=True, kw_only=True)
class _Vector:
    """A topic that could be part of a feature."""

    topic: str
    field: str
    layout: SourceLayout
    role: str
    rate_hz: float


def suggested_mapping(path: Path) -> list[str]:
    """The lines of a mapping for a bag, with what is in it as comments.

    Raises:
        ConfigError: There is no bag.
        BagError: It cannot be read, or holds no messages.
    """
    bag = open_bag(path)
    problems: list[str] = []
    topics = _topics(bag, problems)
    if not topics:
        raise BagError(f"The bag holds no messages: {path}")
    cameras = _cameras(topics)
    vectors = [vector for name, topic in sorted(topics.items()) for vector in _vectors(name, topic)]
    lines = [f"# A mapping for {path.name}, suggested from what is in it; docs/import.md explains every key.", "#"]
    lines += [f"# {problem}" for problem in problems[:5]]
    lines += list(_listed(topics))
    robot = re.sub(r"[^A-Za-z0-9_]+", "_", bag.name).strip("_") or "robot"
    model = next((name for name in sorted(topics) if name.endswith("robot_description")), "")
    lines += ["", "[robot]", f"name = {quoted(robot)}"]
    lines += [f"urdf_topic = {quoted(model)}" if model else '# urdf = "robot.urdf"']
    lines += ["", "[task]", *_task(topics, bag)]
    lines += ["", "[clock]", *_clock(topics, cameras, vectors)]
    lines += [*_services(topics), *_subtasks(topics), *_features(vectors), *_poses(topics)]
    for camera, topic in cameras.items():
        lines += ["", f"[cameras.{camera}]", f"topic = {quoted(topic)}", *_info_topic(topic, topics)]
    return lines


def _topics(bag: Bag, problems: list[str]) -> dict[str, _Topic]:
    topics: dict[str, _Topic] = {}
    decoder = BagDecoder(bag.num_bytes)
    for message in bag.messages(problems):
        topic = topics.setdefault(message.channel.topic, _Topic(type=message.channel.type, first_ns=message.log_ns))
        topic.count += 1
        topic.first_ns, topic.last_ns = min(topic.first_ns, message.log_ns), max(topic.last_ns, message.log_ns)
        if len(topic.values) < _KEPT and not topic.problem:
            _look_into(topic, message, decoder)
    return topics


def _look_into(topic: _Topic, message: BagMessage, decoder: BagDecoder) -> None:
    try:
        values = decoder.values(message)
    except (UnknownEncodingError, SpentError) as error:
        topic.problem = str(error)
        return
    except (ValueError, RecursionError, OverflowError, TypeError):
        return
    topic.has_stamp = topic.has_stamp and bool(stamp_of(values))
    if len(topic.values) < 2 or _head(values) is None:
        if decoder.may_keep(message):
            topic.values.append(values)
        elif not topic.values:
            topic.problem = "the bag holds too much to look into all of it"


def _head(values: Values) -> PictureHead | None:
    try:
        return picture_head(values)
    except FieldError:
        return None


def _listed(topics: Mapping[str, _Topic]) -> Iterator[str]:
    """Every topic with its type, rate, count and first values."""
    yield "# What is in it:"
    for name, topic in sorted(topics.items()):
        rate = f"{topic.rate_hz:.1f} Hz, " if topic.rate_hz else ""
        stamp = "" if topic.has_stamp else ", no times in its headers"
        yield f"#   {name}  {topic.type}, {rate}{topic.count} messages{stamp}"
        told = topic.problem or (_told(topic.values[0]) if topic.values else "none of its messages can be read")
        yield f"#     {told}"


def _told(values: Values) -> str:
    times = ("header", "ts", "timestamp", "stamp")
    return (
        "; ".join(f"{key}: {_short(value)}" for key, value in values.items() if key not in times)[:160] or "no fields"
    )


def _short(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return first_numbers(value)
    if isinstance(value, bytes):
        return f"{len(value)} bytes"
    if isinstance(value, list):
        return f"[{', '.join(_short(item) for item in value[:SHOWN])}{', ...' if len(value) > SHOWN else ''}]"
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{key}: {_short(item)}" for key, item in list(value.items())[:SHOWN]) + "}"
    return (
        json.dumps(value[:40]) if isinstance(value, str) else f"{value:.6g}" if isinstance(value, float) else str(value)
    )


def _vectors(name: str, topic: _Topic) -> Iterator[_Vector]:
    """The joint positions, or other numbers, that a topic holds."""
    if not topic.values or _head(topic.values[0]) is not None:
        return
    for path in _VECTOR_FIELDS:
        try:
            layout = layout_of(Source(topic=name, field=path), topic.values[0])
            found = follow(topic.values[0], layout.steps)
        except (FieldError, OtherPublisherError):
            continue
        if not isinstance(found, np.ndarray) or not len(found) or (path == "data" and not topic.rate_hz):
            continue
        lower = name.lower()
        role = "action" if _ACTION.search(lower) else "state" if _STATE.search(lower) else ""
        yield _Vector(topic=name, field=path, layout=layout, role=role, rate_hz=topic.rate_hz)
        return


def _cameras(topics: Mapping[str, _Topic]) -> dict[str, str]:
    """Name of each camera -> topic: of several topics of the same one, the coded one."""
    heads = {name: _head(topic.values[0]) for name, topic in topics.items() if topic.values}
    pictures = [name for name, head in heads.items() if head is not None]
    cameras: dict[str, str] = {}
    for name in sorted(pictures):
        if any(other != name and other.startswith(f"{name}/") for other in pictures):
            continue  # image_raw beside image_raw/compressed: the same pictures
        head = heads[name]
        is_depth = head is not None and head.encoding in DEPTH_UNITS
        ignored = _STOP_WORDS | _DEPTH_WORDS if is_depth else _STOP_WORDS
        words = [word for word in _CAMERA_WORD.split(name.lower()) if word and word not in ignored]
        camera = "_".join([*dict.fromkeys(words[-2:])] or ["camera"]) + ("_depth" if is_depth else "")
        camera = camera if camera[0].isalpha() else f"camera_{camera}"
        cameras[unique_name(camera, cameras)] = name
    return cameras


def _info_topic(topic: str, topics: Mapping[str, _Topic]) -> list[str]:
    base = topic.removesuffix("/compressed").removesuffix("/compressedDepth").rpartition("/")[0]
    name = f"{base}/camera_info"
    return [f"info_topic = {quoted(name)}"] if name in topics else []


def _task(topics: Mapping[str, _Topic], bag: Bag) -> list[str]:
    if told := _task_topics(topics):
        return [f"topic = {quoted(told[0])}"]
    return [f"text = {quoted(bag.name.replace('_', ' '))}  # what the robot was asked to do", "# file_name = true"]


def _task_topics(topics: Mapping[str, _Topic]) -> list[str]:
    return [name for name, topic in sorted(topics.items()) if _TASK.search(name.lower()) and _is_text(topic)]


def _subtasks(topics: Mapping[str, _Topic]) -> Iterator[str]:
    """Texts that may say what the robot does."""
    others = {*_task_topics(topics)[:1], *(name for name in topics if name.endswith("robot_description"))}
    for name in (name for name in sorted(topics) if name not in others and _is_text(topics[name])):
        yield from ("", "# [subtasks]", f"# topic = {quoted(name)}  # if its texts say what the robot does")


def _is_text(topic: _Topic) -> bool:
    return any(isinstance(values.get("data"), str) for values in topic.values)


def _clock(topics: Mapping[str, _Topic], cameras: Mapping[str, str], vectors: Sequence[_Vector]) -> list[str]:
    rates = {name: topics[topic].rate_hz for name, topic in cameras.items() if topics[topic].rate_hz}
    rate = min(rates.values(), default=min([30.0, *(vector.rate_hz for vector in vectors if vector.rate_hz)]))
    lines = [f"fps = {max(1, round(rate))}"]
    slowest = min(rates, key=lambda name: rates[name], default="")
    if slowest:
        head = _head(topics[cameras[slowest]].values[0])
        chosen = f"rows = {quoted(cameras[slowest])}  # a row for each of its pictures"
        lines.append(chosen if head is not None and head.format in VIDEO_FORMATS else f"# {chosen}")
    mapped = [*cameras.values(), *(vector.topic for vector in vectors if vector.role)]
    if any(not topics[name].has_stamp for name in mapped):
        lines.append('stamp = "log"  # not all headers have a time')
    return [*lines, 'when_old = "error"  # or "drop_episode"']


def _services(topics: Mapping[str, _Topic]) -> Iterator[str]:
    """Services whose calls may begin and end episodes."""
    for name in (name for name in sorted(topics) if name.endswith("/_service_event")):
        yield from ("", "# [episodes]", '# cut = "service"  # calls of it cut the bag, by a boolean in their requests')
        yield f"# topic = {quoted(name)}"


def _features(vectors: Sequence[_Vector]) -> Iterator[str]:
    states = [vector for vector in vectors if vector.role == "state"]
    actions = [vector for vector in vectors if vector.role == "action"]
    others = [vector for vector in vectors if not vector.role]
    if not states and len(others) == 1:
        states, others = others, []
    for name, chosen in (("observation.state", states), ("action", actions)):
        labels = [label for vector in chosen for label in vector.layout.names]
        are_double = len(set(labels)) < len(labels)
        for vector in chosen:
            yield from _source(name, vector, prefix=_prefix(vector, chosen) if are_double else "")
        if not chosen and name == "observation.state":
            yield from ("", "# No topic says that it is the robot's state: take one of those above.")
        elif not chosen:
            yield from ("", "# No topic says that it is a command, so the next state is the action.")
            yield from ("[[features.action]]", 'next = "observation.state"')
    for vector in others:
        for line in _source("observation.extra", vector, prefix=""):
            yield f"# {line}" if line else ""


def _prefix(vector: _Vector, chosen: Sequence[_Vector]) -> str:
    """The words of a topic that the others of the same feature do not have."""
    words = [word for word in re.split(r"[^A-Za-z0-9]+", vector.topic) if word]
    shared = set.intersection(*(set(re.split(r"[^A-Za-z0-9]+", other.topic)) for other in chosen))
    return "_".join(word for word in words if word not in shared) + "_"


def _source(feature: str, vector: _Vector, *, prefix: str) -> Iterator[str]:
    key = feature if "." not in feature else f'"{feature}"'
    yield from ("", f"[[features.{key}]]", f"topic = {quoted(vector.topic)}", f"field = {quoted(vector.field)}")
    if vector.layout.names_steps is not None:
        yield f"joints = [{', '.join(quoted(name) for name in vector.layout.names)}]"
    if prefix:
        yield f"prefix = {quoted(prefix)}"


def _poses(topics: Mapping[str, _Topic]) -> Iterator[str]:
    found = [name for name, topic in sorted(topics.items()) if topic.type in _POSE_TYPES and topic.values]
    is_sure = len(found) == 1 and topics[found[0]].rate_hz > 0
    for name in found:
        mark = "" if is_sure else "# "
        yield from ("", f'{mark}[[features."observation.ee_pose"]]', f"{mark}topic = {quoted(name)}")
        yield f'{mark}field = "pose"'
