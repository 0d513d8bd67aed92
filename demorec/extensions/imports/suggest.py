"""Suggest a mapping from a bag's content: it lists every topic with its type and maps the recognised ones."""

from __future__ import annotations

import json
import math
import re
from array import array
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from demorec.episode.info import DEPTH_UNITS
from demorec.extensions.imports.bag import Bag, TopicSummary, bags_in, open_bag
from demorec.extensions.imports.bag_files import BagError
from demorec.extensions.imports.candidates import Candidate, Choice, candidates_of, choose_features, of_publishers
from demorec.extensions.imports.clock import NS, SKEW_S
from demorec.extensions.imports.decoding import BagDecoder, UnknownEncodingError
from demorec.extensions.imports.fields import FieldError, follow, stamp_of
from demorec.extensions.imports.image_messages import ImageHead, NoColorError, image_head
from demorec.extensions.imports.mapping import MAX_FPS, Clock
from demorec.extensions.imports.words import SHOWN, first_numbers, quoted, task_in_name, unique_name
from demorec.mcap.cdr import Values
from demorec.mcap.scan import ScannedMessage

_USUAL_FPS = 30
"""Suggested rate of a bag without a stream of known rate."""
_MIN_GRID_RATIO = 0.995
"""Minimum rate of rows, relative to that of a stream of which they hold nearly every message."""
_MAX_DECODED = 64
"""Maximum messages of a topic that are decoded."""
_TASK = re.compile(r"(?<!sub)(?<!sub[_/-])task|instruction|prompt")
_STOP_WORDS = {"camera", "cam", "color", "image", "raw", "rect", "compressed", "rgb", "cameras", "images", "video"}
_DEPTH_WORDS = {"depth", "aligned", "to", "compresseddepth", "registered"}
_LOG = 'stamp = "log"  # its headers have no time'
_TIMES = ("header", "ts", "timestamp", "stamp")
_CAMERA_WORD = re.compile(r"[^a-z0-9]+")


@dataclass(kw_only=True, eq=False)
class _Topic(TopicSummary):
    """Content of a topic.

    Attributes:
        first: First message; None if none can be read.
        head: Head of its first image; None if its messages are not images.
        candidates: Numbers in it that may belong to a feature.
        publishers: Joint names in its messages, each list once.
        stamps_ns: Header times of the decoded messages.
        has_stamp: Whether headers have a time.
        skew_ns: Log time minus header time of the first message.
        problem: Reason why no message can be read; "" otherwise.
        stamp: Times that rows use, "header" or "log".
    """

    name: str
    first: Values | None = None
    head: ImageHead | None = None
    candidates: list[Candidate] = field(default_factory=list)
    publishers: dict[tuple[str, ...], None] = field(default_factory=dict)
    stamps_ns: array[int] = field(default_factory=lambda: array("q"))
    has_stamp: bool = True
    skew_ns: int = 0
    problem: str = ""
    stamp: str = "header"

    @property
    def is_text(self) -> bool:
        """Whether its messages are texts."""
        return self.first is not None and self.head is None and isinstance(self.first.get("data"), str)

    @property
    def row_rate_hz(self) -> float:
        """Rate by the times that rows use; simulated time runs slower or faster than log time."""
        if self.stamp == "log" or not self.has_stamp or len(self.stamps_ns) < 3:
            return self.rate_hz
        steps = np.diff(np.unique(self.stamps_ns))
        usual = steps[np.abs(steps - np.median(steps)) <= 0.5 * np.median(steps)]  # without pauses
        return NS / float(usual.mean()) if len(usual) else self.rate_hz


def suggested_mapping(path: Path, tell: Callable[[str], None]) -> list[str]:
    """Return the lines of a mapping for a bag, with comments about its content.

    Args:
        path: The bag, or a folder of bags, of which the first is used.
        tell: Called with each decision that the user must make before using the mapping.

    Raises:
        ConfigError: The path holds no bag.
        BagError: It cannot be read, or has no messages.
    """
    path = bags_in(path)[0]
    bag = open_bag(path)
    problems: list[str] = []
    topics = _topics(bag, problems)
    if not topics:
        raise BagError(f"The bag holds no messages{f' ({problems[0]})' if problems else ''}: {path}")
    cameras = _cameras(topics)
    choice = choose_features(
        [
            candidate
            for _, topic in sorted(topics.items())
            for found in topic.candidates
            for candidate in of_publishers(found, list(topic.publishers))
        ]
    )
    lines = [f"# A mapping for {path.name}, suggested from its content; docs/import.md explains every key.", "#"]
    if not choice.state:
        warning = (
            "No topic was recognised as the state of an arm or a base: write its source from the topics that the "
            "mapping lists; the import refuses the mapping as it is."
        )
        tell(warning)
        lines += [f"# ATTENTION: {warning}", "#"]
    lines += [f"# {problem}" for problem in problems[:5]]
    lines += _listed(topics)
    robot = re.sub(r"[^A-Za-z0-9_]+", "_", bag.name).strip("_") or "robot"
    models = (name for name in topics if name.endswith("robot_description"))
    model = min(models, key=lambda name: (name.count("/"), name), default="")  # nested ones may belong to objects
    lines += ["", "[robot]", f"name = {quoted(robot)}"]
    lines += [f"urdf_topic = {quoted(model)}" if model else '# urdf = "robot.urdf"']
    lines += ["", "[task]", *_task(topics, bag)]
    parts = [*choice.state, *choice.action]
    is_mixed = _set_stamps(topics, {*cameras.values(), *(part.topic for part in parts)})
    lines += ["", "[clock]", *_clock(topics, cameras, parts, is_mixed=is_mixed)]
    lines += [*_subtasks(topics), *_features(choice, topics)]
    for camera, topic in cameras.items():
        lines += ["", f"[cameras.{camera}]", f"topic = {quoted(topic)}"]
        info = topic.removesuffix("/compressed").removesuffix("/compressedDepth").rpartition("/")[0] + "/camera_info"
        lines += [f"info_topic = {quoted(info)}"] if info in topics else []
        lines += [] if topics[topic].has_stamp else [_LOG]
    return lines


def _topics(bag: Bag, problems: list[str]) -> dict[str, _Topic]:
    """Read the topics of a bag."""
    topics: dict[str, _Topic] = {}
    decoder = BagDecoder()
    for message in bag.messages(problems):
        name, type_name = message.channel.topic, message.channel.type
        topic = topics.setdefault(name, _Topic(name=name, type=type_name))
        topic.add(message.log_ns)
        if topic.count <= _MAX_DECODED and not topic.problem:
            _look_into(topic, message, decoder)
    return topics


def _look_into(topic: _Topic, message: ScannedMessage, decoder: BagDecoder) -> None:
    try:
        values = decoder.values(message)
    except UnknownEncodingError as error:
        topic.problem = str(error)
        return
    except (ValueError, RecursionError, OverflowError, TypeError):
        return
    stamp = stamp_of(values)
    topic.has_stamp = bool(stamp or topic.stamps_ns)  # simulated time begins with 0, which looks like a missing time
    if stamp and 0 < stamp < 2**63:
        topic.skew_ns = topic.skew_ns or message.log_ns - stamp
        topic.stamps_ns.append(stamp)
    if topic.first is None:
        try:
            topic.first, topic.head = values, _head(values)
        except NoColorError as error:
            topic.problem = str(error)
            return
    if topic.head is None:
        topic.candidates = topic.candidates or candidates_of(topic.name, topic.type, values)
        for candidate in topic.candidates:
            topic.publishers |= dict.fromkeys([_names(candidate, values)])


def _names(candidate: Candidate, values: Values) -> tuple[str, ...]:
    """Joint names in a message; () if it has none, or not one per number."""
    steps = candidate.reader.names_steps
    if steps is None:
        return ()
    try:
        names, count = follow(values, steps), np.size(follow(values, candidate.reader.steps))
    except ValueError:
        return ()
    are_texts = isinstance(names, list) and all(isinstance(name, str) for name in names)
    return tuple(names) if are_texts and len(names) == count == len(set(names)) else ()


def _head(values: Values) -> ImageHead | None:
    """Head of an image; None for a message without one, NoColorError for an image without colour."""
    try:
        return image_head(values)
    except NoColorError:
        raise
    except FieldError:
        return None


def _listed(topics: Mapping[str, _Topic]) -> Iterator[str]:
    """Yield lines for every topic with its type, rate, count and first values."""
    yield "# Content:"
    for name, topic in sorted(topics.items()):
        rate = f"{topic.rate_hz:.1f} Hz, " if topic.rate_hz else ""
        stamp = "" if topic.has_stamp else ", no times in its headers"
        yield f"#   {name}  {topic.type}, {rate}{topic.count} messages{stamp}"
        fields = [f"{key}: {_short(value)}" for key, value in (topic.first or {}).items() if key not in _TIMES]
        shown = "; ".join(fields)[:160] or ("no fields" if topic.first else "none of its messages can be read")
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


def _cameras(topics: Mapping[str, _Topic]) -> dict[str, str]:
    """Camera name -> topic; among several topics of one camera, the encoded one."""
    heads = {name: head for name, topic in sorted(topics.items()) if (head := topic.head) is not None}
    cameras: dict[str, str] = {}
    for name, head in heads.items():
        if any(other != name and other.startswith(f"{name}/") for other in heads):
            continue  # image_raw next to image_raw/compressed: the same images
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
    return ["# Neither a topic nor a file name describes the task. Write it here:", text]


def _task_topics(topics: Mapping[str, _Topic]) -> list[str]:
    return [name for name, topic in sorted(topics.items()) if _TASK.search(name.lower()) and topic.is_text]


def _subtasks(topics: Mapping[str, _Topic]) -> Iterator[str]:
    """Texts that may describe the robot's current subtask."""
    others = {*_task_topics(topics)[:1], *(name for name in topics if name.endswith("robot_description"))}
    for name in (name for name in sorted(topics) if name not in others and topics[name].is_text):
        yield from ("", "# [subtasks]", f"# topic = {quoted(name)}  # if its texts describe the robot's actions")


def _set_stamps(topics: Mapping[str, _Topic], mapped: Collection[str]) -> bool:
    """Choose header or log times for all topics; return whether log times replace some headers."""
    skews = [topics[name].skew_ns for name in mapped if topics[name].has_stamp]
    # One clock for all if header times are far from log times and some topics have only the latter.
    is_mixed = 0 < len(skews) < len(mapped) and abs(float(np.median(skews))) > SKEW_S * NS
    for topic in topics.values():
        topic.stamp = "log" if is_mixed or not skews else "header"
    return is_mixed


def _clock(
    topics: Mapping[str, _Topic], cameras: Mapping[str, str], parts: Sequence[Candidate], *, is_mixed: bool
) -> list[str]:
    rates = {topic: topics[topic].row_rate_hz for topic in cameras.values() if topics[topic].rate_hz}
    heads = {topic: topics[topic].head for topic in rates}
    colour = {
        topic: rate for topic, rate in rates.items() if (head := heads[topic]) and head.encoding not in DEPTH_UNITS
    }
    colour = colour or rates
    slowest = min(colour, key=lambda topic: colour[topic], default="")
    part_rates = {part.topic: hz for part in parts if (hz := topics[part.topic].row_rate_hz)}
    rate = colour[slowest] if slowest else min(part_rates.values(), default=_USUAL_FPS)
    fps = max(1, round(rate))
    if not slowest:  # rows are on a grid, which loses no message if it is as fast
        fps = min(fps + (fps < _MIN_GRID_RATIO * rate), MAX_FPS)
    lines = [f"fps = {fps}"]
    if not slowest:
        for topic, hz in part_rates.items():
            if fps < _MIN_GRID_RATIO * hz:
                unused = f"{100 * (1 - fps / hz):.3g} % of its messages are in no row"
                lines.append(f"# {quoted(topic)} comes {hz:.1f} times a second: {unused}")
    if slowest:
        lines += [f'rows = "camera"  # a row for each image of the slowest, {quoted(slowest)}; or "grid", or a topic']
    if is_mixed:
        lines += ['stamp = "log"  # not all headers have a time, and those that do are of another clock']
    return [*lines, 'when_old = "error"  # or "drop_episode"']


def _features(choice: Choice, topics: Mapping[str, _Topic]) -> Iterator[str]:
    yield from _chosen("observation.state", choice.state, topics)
    yield from _chosen("action", choice.action, topics)
    if not choice.action:
        yield from ("", "# No recognised topic is the command of this state, so the next state is the action.")
        yield from ("[[features.action]]", 'next = "observation.state"')
    for pose in choice.poses:
        yield from _source("observation.ee_pose", pose, topics)


def _chosen(feature: str, parts: Sequence[Candidate], topics: Mapping[str, _Topic]) -> Iterator[str]:
    """Sources of a feature; if names clash, with prefixes from the words that distinguish their topics."""
    for number, part in enumerate(parts, 1):
        rivals = [other for other in parts if other is not part and {*part.labels} & {*other.labels}]
        own = [word for word in part.words if not all(word in rival.words for rival in rivals)]
        prefix = "_".join(own or [str(number)]) + "_" if rivals else ""
        yield from _source(feature, part, topics, prefix=prefix)


def _source(feature: str, part: Candidate, topics: Mapping[str, _Topic], *, prefix: str = "") -> Iterator[str]:
    key = feature if "." not in feature else quoted(feature)
    topic = topics[part.topic]
    yield from ("", f"[[features.{key}]]", f"topic = {quoted(part.topic)}")
    yield f"field = {quoted(part.reader.source.field)}"
    if part.reader.joints:
        yield f"joints = [{', '.join(map(quoted, part.reader.joints))}]"
    if part.name:
        yield f"names = [{quoted(part.name)}]"
    if prefix or part.prefix:
        yield f"prefix = {quoted(prefix + part.prefix)}"
    if topic.row_rate_hz and (age_s := 2 / topic.row_rate_hz) > Clock(fps=1).max_age_s:
        yield f"max_age_s = {math.ceil(age_s * 10) / 10:.1f}  # its messages are that far apart"
    if not topic.has_stamp:
        yield _LOG
