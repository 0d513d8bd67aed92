"""A mapping from what is in a bag: the likely choices made, the doubtful ones commented out, everything listed.

What a topic's words say of its numbers, and what is taken of them, is in `candidates`. A topic whose words say
neither what the robot does nor what it shall do is not guessed at, unless it is the only one.
"""

from __future__ import annotations

import json
import math
import re
from array import array
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from demorec.episode.info import DEPTH_UNITS
from demorec.mcap.cdr import Values
from demorec.mcap.limits import SpentError
from demorec.mcap.scan import ScannedMessage
from demorec.sources.bag import Bag, open_bag
from demorec.sources.bag_files import BagError
from demorec.sources.candidates import Vector, choose_features, transforms_of, vectors_of
from demorec.sources.clock import NS, SKEW_S
from demorec.sources.decoding import BagDecoder, UnknownEncodingError
from demorec.sources.fields import FieldError, follow, stamp_of
from demorec.sources.image_messages import ImageHead, image_head
from demorec.sources.mapping import Clock
from demorec.sources.words import SHOWN, first_numbers, quoted, task_in_name, unique_name

_KEPT = 64
"""Messages of a topic that are looked into."""
_MAX_PUBLISHERS = 64
"""Of a topic, by the names in their messages."""
_MAX_OFFERED = 24
"""Sources that are commented out."""
_TASK = re.compile(r"(?<!sub)(?<!sub[_/-])task|instruction|prompt")
_STOP_WORDS = {"camera", "cam", "color", "image", "raw", "rect", "compressed", "rgb", "cameras", "images", "video"}
_DEPTH_WORDS = {"depth", "aligned", "to", "compresseddepth", "registered"}
_LOG = 'stamp = "log"  # its headers have no time'
_TIMES = ("header", "ts", "timestamp", "stamp")
_CAMERA_WORD = re.compile(r"[^a-z0-9]+")


@dataclass(kw_only=True, eq=False)
class _Topic:
    """What a topic has shown.

    Attributes:
        count: Of its messages.
        first_ns, last_ns: When they were recorded.
        values: Of the first ones.
        vectors: Numbers in them that a feature may be made of.
        publishers: Names of joints in a message -> when such messages were recorded, nanoseconds; () where none are.
        has_stamp: Whether these have headers with a time.
        stamps_ns: Of the headers of those that were looked into.
        skew_ns: By which the first was recorded after the time of its header.
        problem: Why none can be read; "".
    """

    type: str
    count: int = 0
    first_ns: int = 0
    last_ns: int = 0
    values: list[Values] = field(default_factory=list)
    vectors: list[Vector] = field(default_factory=list)
    publishers: dict[tuple[str, ...], array[int]] = field(default_factory=dict)
    has_stamp: bool = True
    stamps_ns: array[int] = field(default_factory=lambda: array("q"))
    skew_ns: int = 0
    problem: str = ""

    @property
    def head(self) -> ImageHead | None:
        """Of its first image; None where its messages are none."""
        return _head(self.values[0]) if self.values else None

    @property
    def rate_hz(self) -> float:
        """Of its messages, on average."""
        seconds = (self.last_ns - self.first_ns) / NS
        return (self.count - 1) / seconds if self.count > 1 and seconds > 0 else 0.0

    def rate_by(self, stamp: str) -> float:
        """Its usual rate by the times that rows follow; simulated time is slower, or faster, than that of recording."""
        if stamp == "log" or not self.has_stamp or len(self.stamps_ns) < 3:
            return self.rate_hz
        steps = np.diff(np.unique(self.stamps_ns))
        usual = steps[np.abs(steps - np.median(steps)) <= 0.5 * np.median(steps)]  # without pauses
        return NS / float(usual.mean()) if len(usual) else self.rate_hz


def suggested_mapping(path: Path, tell: Callable[[str], None]) -> list[str]:
    """The lines of a mapping for a bag, with what is in it as comments.

    Args:
        path: Of the bag.
        tell: Called with what the user has to decide before the mapping can be used.

    Raises:
        ConfigError: There is no bag.
        BagError: It cannot be read, or holds no messages.
    """
    bag = open_bag(path)
    problems: list[str] = []
    topics = _topics(bag, problems)
    if not topics:
        raise BagError(f"The bag holds no messages{f' ({problems[0]})' if problems else ''}: {path}")
    cameras = _cameras(topics)
    vectors = [
        replace(vector, has_stamp=topic.has_stamp)
        for name, topic in sorted(topics.items())
        for vector in _vectors(name, topic)
    ]
    state, action, others, warning = choose_features(vectors)
    lines = [f"# A mapping for {path.name}, suggested from what is in it; docs/import.md explains every key.", "#"]
    if warning:
        tell(warning)
        lines += [f"# ATTENTION: {warning}", "#"]
    lines += [f"# {problem}" for problem in problems[:5]]
    lines += list(_listed(topics))
    robot = re.sub(r"[^A-Za-z0-9_]+", "_", bag.name).strip("_") or "robot"
    models = (name for name in topics if name.endswith("robot_description"))
    model = min(models, key=lambda name: (name.count("/"), name), default="")  # those below may be of objects
    lines += ["", "[robot]", f"name = {quoted(robot)}"]
    lines += [f"urdf_topic = {quoted(model)}" if model else '# urdf = "robot.urdf"']
    lines += ["", "[task]", *_task(topics, bag)]
    lines += ["", "[clock]", *_clock(topics, cameras, [*state, *action])]
    lines += [*_subtasks(topics), *_features(state, action, others)]
    for camera, topic in cameras.items():
        lines += ["", f"[cameras.{camera}]", f"topic = {quoted(topic)}"]
        info = topic.removesuffix("/compressed").removesuffix("/compressedDepth").rpartition("/")[0] + "/camera_info"
        lines += [f"info_topic = {quoted(info)}"] if info in topics else []
        lines += [] if topics[topic].has_stamp else [_LOG]
    return lines


def _topics(bag: Bag, problems: list[str]) -> dict[str, _Topic]:
    topics: dict[str, _Topic] = {}
    decoder = BagDecoder(bag.num_bytes)
    for message in bag.messages(problems):
        topic = topics.setdefault(message.channel.topic, _Topic(type=message.channel.type, first_ns=message.log_ns))
        topic.count += 1
        topic.first_ns, topic.last_ns = min(topic.first_ns, message.log_ns), max(topic.last_ns, message.log_ns)
        if (len(topic.values) < _KEPT or any(topic.publishers)) and not topic.problem:
            _look_into(topic, message, decoder)
        else:
            topic.publishers.setdefault((), array("q")).append(message.log_ns)
    return topics


def _look_into(topic: _Topic, message: ScannedMessage, decoder: BagDecoder) -> None:
    try:
        values = decoder.values(message)
    except (UnknownEncodingError, SpentError) as error:
        topic.problem = str(error)
        return
    except (ValueError, RecursionError, OverflowError, TypeError):
        return
    stamp = stamp_of(values)
    topic.has_stamp = bool(stamp or topic.stamps_ns)  # simulated time begins with 0, which looks like none
    if stamp and 0 < stamp < 2**63:
        topic.skew_ns = topic.skew_ns or message.log_ns - stamp
        topic.stamps_ns.append(stamp)
    if len(topic.values) < 2 or (len(topic.values) < _KEPT and _head(values) is None):
        if decoder.may_keep(message):
            topic.values.append(values)
        elif not topic.values:
            topic.problem = "the bag holds too much to look into all of it"
            return
        if not topic.vectors and _head(values) is None:
            topic.vectors = list(vectors_of(message.channel.topic, topic.type, values))
    names = next((names for vector in topic.vectors if (names := _names(vector, values))), ())
    if names in topic.publishers or len(topic.publishers) < _MAX_PUBLISHERS:
        topic.publishers.setdefault(names, array("q")).append(message.log_ns)


def _names(vector: Vector, values: Values) -> tuple[str, ...]:
    """Those of the joints in a message whose first fields hold them."""
    steps = vector.reader.names_steps
    if steps is None or (len(steps) > 1 and isinstance(values.get(str(steps[0])), Mapping)):
        return ()  # a robot's own message has one publisher
    try:
        names, count = follow(values, steps), np.size(follow(values, vector.reader.steps))
    except ValueError:
        return ()
    are_texts = isinstance(names, list) and all(isinstance(name, str) for name in names)
    return tuple(names) if are_texts and len(names) == count == len(set(names)) else ()


def _head(values: Values) -> ImageHead | None:
    try:
        return image_head(values)
    except FieldError:
        return None


def _listed(topics: Mapping[str, _Topic]) -> Iterator[str]:
    """Every topic with its type, rate, count and first values."""
    yield "# What is in it:"
    for name, topic in sorted(topics.items()):
        rate = f"{topic.rate_hz:.1f} Hz, " if topic.rate_hz else ""
        stamp = "" if topic.has_stamp else ", no times in its headers"
        yield f"#   {name}  {topic.type}, {rate}{topic.count} messages{stamp}"
        fields = [f"{key}: {_short(value)}" for key, value in (topic.values or [{}])[0].items() if key not in _TIMES]
        shown = "; ".join(fields)[:160] or ("no fields" if topic.values else "none of its messages can be read")
        yield f"#     {topic.problem or shown}"


def _short(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return first_numbers(value)
    if isinstance(value, bytes):
        return f"{len(value)} bytes"
    if isinstance(value, list):
        return f"[{', '.join(_short(item) for item in value[:SHOWN])}{', ...' if len(value) > SHOWN else ''}]"
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{key}: {_short(item)}" for key, item in list(value.items())[:SHOWN]) + "}"
    if isinstance(value, str):
        return json.dumps(value[:40])
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _vectors(name: str, topic: _Topic) -> Iterator[Vector]:
    """The numbers of a topic, those of several publishers apart: joints that always come together stay together."""
    yield from transforms_of(name, topic.type, topic.values)
    for vector in topic.vectors:
        groups: dict[frozenset[int], list[str]] = {}
        if vector.reader.joints and any(topic.publishers):
            for joint in dict.fromkeys(joint for names in topic.publishers for joint in names):
                of = frozenset(place for place, names in enumerate(topic.publishers) if joint in names)
                groups.setdefault(of, []).append(joint)
        times = list(topic.publishers.values())
        for of, joints in groups.items():
            yield _timed(vector.of_joints(joints, topic.values), [times[place] for place in of])
        if not groups:
            yield _timed(vector, times)


def _timed(vector: Vector, parts: Sequence[Sequence[int]]) -> Vector:
    times = np.sort(np.concatenate([np.asarray(part) for part in parts]))
    steps = np.diff(times) / NS
    if not steps.any():
        return vector
    usual = float(np.median(steps))
    is_regular = np.mean((steps > 0.3 * usual) & (steps < 1.7 * usual)) > 0.6  # else it is sent when it changes
    needed = 2 * usual if is_regular else float(steps.max())
    age = math.ceil(needed * 10) / 10 if needed > Clock(fps=1).max_age_s else 0.0
    return replace(vector, rate_hz=len(steps) / float(steps.sum()), age_s=age)


def _cameras(topics: Mapping[str, _Topic]) -> dict[str, str]:
    """Name of each camera -> topic: of several topics of the same one, the encoded one."""
    heads = {name: head for name, topic in sorted(topics.items()) if (head := topic.head) is not None}
    cameras: dict[str, str] = {}
    for name, head in heads.items():
        if any(other != name and other.startswith(f"{name}/") for other in heads):
            continue  # image_raw beside image_raw/compressed: the same images
        is_depth = head.encoding in DEPTH_UNITS
        ignored = _STOP_WORDS | _DEPTH_WORDS if is_depth else _STOP_WORDS
        words = [word for word in _CAMERA_WORD.split(name.lower()) if word and word not in ignored]
        camera = "_".join([*dict.fromkeys(words[-2:])] or ["camera"]) + ("_depth" if is_depth else "")
        camera = camera if camera[0].isalpha() else f"camera_{camera}"
        cameras[unique_name(camera, cameras)] = name
    return cameras


def _task(topics: Mapping[str, _Topic], bag: Bag) -> list[str]:
    if found := _task_topics(topics):
        return [f"topic = {quoted(found[0])}"]
    text = f"# text = {quoted('what the robot was asked to do')}  # the same for all bags"
    if name := task_in_name(bag.name):
        return [f"file_name = true  # the name of each bag is its task, here {quoted(name)}; or write:", text]
    return ["# No topic and no name of a file says what the robot was asked to do. Write it here:", text]


def _task_topics(topics: Mapping[str, _Topic]) -> list[str]:
    return [name for name, topic in sorted(topics.items()) if _TASK.search(name.lower()) and _is_text(topic)]


def _subtasks(topics: Mapping[str, _Topic]) -> Iterator[str]:
    """Texts that may say what the robot does."""
    others = {*_task_topics(topics)[:1], *(name for name in topics if name.endswith("robot_description"))}
    for name in (name for name in sorted(topics) if name not in others and _is_text(topics[name])):
        yield from ("", "# [subtasks]", f"# topic = {quoted(name)}  # if its texts say what the robot does")


def _is_text(topic: _Topic) -> bool:
    return any(isinstance(values.get("data"), str) and _head(values) is None for values in topic.values)


def _clock(topics: Mapping[str, _Topic], cameras: Mapping[str, str], vectors: Sequence[Vector]) -> list[str]:
    mapped = {*cameras.values(), *(vector.topic for vector in vectors)}
    skews = [topics[name].skew_ns for name in mapped if topics[name].has_stamp]
    # One clock for all where that of the headers is far from that of recording, which some topics have alone.
    is_mixed = 0 < len(skews) < len(mapped) and abs(float(np.median(skews))) > SKEW_S * NS
    stamp = "log" if is_mixed or not skews else "header"
    rates = {topic: topics[topic].rate_by(stamp) for topic in cameras.values() if topics[topic].rate_hz}
    heads = {topic: topics[topic].head for topic in rates}
    colour = {
        topic: rate for topic, rate in rates.items() if (head := heads[topic]) and head.encoding not in DEPTH_UNITS
    }
    colour = colour or rates
    slowest = min(colour, key=lambda topic: colour[topic], default="")
    rate = colour.get(slowest, min([30.0, *(vector.rate_hz for vector in vectors if vector.rate_hz)]))
    lines = [f"fps = {max(1, round(rate))}"]
    if slowest:
        lines += [f'rows = "camera"  # a row for each image of the slowest, {quoted(slowest)}; or "grid", or a topic']
    if is_mixed:
        lines += ['stamp = "log"  # not all headers have a time, and those that do are of another clock']
    return [*lines, 'when_old = "error"  # or "drop_episode"']


def _features(state: Sequence[Vector], action: Sequence[Vector], others: Sequence[Vector]) -> Iterator[str]:
    yield from _chosen("observation.state", state)
    if not state:
        yield from ("", "# No topic is known to hold the robot's state.")
    yield from _chosen("action", action)
    if not action:
        offers = any(vector.role == "action" for vector in others)
        found = (
            "No topic is sure to be the command (see those below)" if offers else "No topic says that it is a command"
        )
        yield from ("", f"# {found}, so the next state is the action.")
        yield from ("[[features.action]]", 'next = "observation.state"')
    poses = [vector for vector in others if vector.kind == "pose" and vector.role != "action"]
    poses = [vector for vector in poses if vector.is_robot] or poses
    is_sure = bool(state) and len({vector.topic for vector in poses}) == 1 and poses[0].field == "pose"
    for vector in poses if is_sure else ():
        yield from _source("observation.ee_pose", vector, prefix="")
    offered = [vector for vector in others if not (is_sure and vector in poses)]
    offered.sort(key=lambda vector: vector.field.startswith("transforms["))
    for vector in offered[:_MAX_OFFERED]:
        name = {"state": "observation.state", "action": "action"}.get(vector.role, "observation.extra")
        name = "observation.state" if not state and not vector.role else name
        for line in _source(name, vector, prefix=""):
            yield f"# {line}" if line else ""
    if len(offered) > _MAX_OFFERED:
        yield f"# and {len(offered) - _MAX_OFFERED} more"


def _chosen(feature: str, vectors: Sequence[Vector]) -> Iterator[str]:
    """The sources of a feature; where names clash, with words in front by which their topics and fields differ."""
    prefixes = []
    for vector in vectors:
        rivals = [set(other.place) for other in vectors if vector is not other and {*vector.labels} & {*other.labels}]
        own = [word for word in vector.place if word not in set.intersection(*rivals, set(vector.place))]
        prefixes.append("_".join(own) + "_" if rivals else "")
    names = [prefix + label for prefix, vector in zip(prefixes, vectors, strict=True) for label in vector.labels]
    for number, (prefix, vector) in enumerate(zip(prefixes, vectors, strict=True), 1):
        yield from _source(feature, vector, prefix=prefix if len(set(names)) == len(names) else f"{number}_")


def _source(feature: str, vector: Vector, *, prefix: str) -> Iterator[str]:
    key = feature if "." not in feature else quoted(feature)
    yield from ("", f"[[features.{key}]]", f"topic = {quoted(vector.topic)}")
    yield f"field = {quoted(vector.field)}" + (f"  # first: {vector.first}" if vector.first else "")
    if vector.reader.joints:
        yield f"joints = [{', '.join(map(quoted, vector.reader.joints))}]"
    if vector.names:
        yield f"names = [{', '.join(map(quoted, vector.names))}]"
    if prefix or vector.prefix:
        yield f"prefix = {quoted(prefix + vector.prefix)}"
    if vector.age_s:
        yield f"max_age_s = {vector.age_s:.1f}  # its messages are that far apart"
    if not vector.has_stamp:
        yield _LOG
