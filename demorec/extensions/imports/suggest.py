"""Suggest a mapping from a bag's content: it lists every topic with its type and maps those of usual types and names.

Recognised are joint positions (JointState and similar types, JointTrajectory, number arrays with joint names in the
topic), a gripper's opening, and poses of the robot. A topic with a word such as leader or command is the action.
"""

from __future__ import annotations

import math
import re
from array import array
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from demorec.episode.info import DEPTH_UNITS
from demorec.extensions.imports.bag import NS, Bag, TopicSummary, bags_in, open_bag
from demorec.extensions.imports.bag_files import BagError
from demorec.extensions.imports.decoding import UnknownEncodingError, decode_message
from demorec.extensions.imports.fields import FieldError, follow, parse_path, reader_of, stamp_of
from demorec.extensions.imports.image_messages import ImageHead, NoColorError, image_head
from demorec.extensions.imports.mapping import MAX_FPS, Clock, Source
from demorec.extensions.imports.words import quoted, task_in_name, unique_name
from demorec.extensions.recovery.scan import ScannedMessage
from demorec.mcap.cdr import Values

_USUAL_FPS = 30
"""Suggested rate of a bag without a stream of known rate."""
_MAX_DECODED = 64
"""Maximum messages of a topic that are decoded."""
_MAX_PROBLEMS = 5
"""Maximum problems of a bag that are listed."""
_JOINT_FIELDS = ("position", "positions", "joints.position", "points[0].positions", "data")
_POSE_FIELDS = ("pose", "pose.pose")
_LEADER = re.compile(r"leader|master|gello|teleop|(?<![a-z])lead(?![a-z])")
_COMMAND = re.compile(r"command|cmd|target|desired|goal|setpoint|jointtrajectory$|(?<![a-z])(?:actions?|ref)(?![a-z])")
_JOINTS = re.compile(r"joint|follower|puppet|leader|master|(?<![a-z])(?:arm|qpos|q)(?![a-z])|command")
_NO_JOINTS = re.compile(r"velocit|effort|torque|force|wrench|cartesian|(?<![a-z])(?:vel|pose|tcp)(?![a-z])")
_GRIPPER = re.compile(r"gripper|finger|jaw|knuckle")
_ROBOT_POSE = re.compile(r"end_effector|(?<![a-z])(ee|eef|tcp|tool\d*|flange|hand|current|robot|arm)(?![a-z])")
_SIDE = re.compile(r"(?<![a-z])(left|right|l|r|\d+)(?![a-z])")
_CAMERA_WORD = re.compile(r"[^a-z0-9]+")
_STOP_WORDS = {"camera", "cam", "color", "image", "raw", "rect", "compressed", "rgb", "cameras", "images", "video"}
_DEPTH_WORDS = {"depth", "aligned", "to", "compresseddepth", "registered"}
Kind = Literal["joints", "gripper", "pose"]


@dataclass(frozen=True, kw_only=True)
class _Part:
    """Numbers of a topic that a feature may take.

    Attributes:
        topic, field: Source of the numbers.
        names: Names of the elements.
        joints: Names in the messages; empty if they have none.
        kind: Kind of the numbers.
        is_action: Whether the topic commands the robot, or belongs to a leader arm.
    """

    topic: str
    field: str
    names: tuple[str, ...]
    joints: tuple[str, ...]
    kind: Kind
    is_action: bool

    @property
    def words(self) -> list[str]:
        """Words in its topic."""
        return [word for word in re.split(r"[^A-Za-z0-9]+", self.topic) if word]

    def is_same(self, other: _Part) -> bool:
        """Whether both are probably the same joints published twice; left and right, 1 and 2 are two robots."""
        if self.topic == other.topic or _SIDE.sub("", self.topic.lower()) == _SIDE.sub("", other.topic.lower()):
            return False
        if self.kind != other.kind:
            return self.kind == "gripper" and any(_GRIPPER.search(name.lower()) for name in other.names)
        return not self.joints or not other.joints or not {*self.joints}.isdisjoint(other.joints)


def _part_of(topic: str, type_name: str, values: Values) -> _Part | None:
    """Joints, a gripper or a pose in a message; None if nothing is recognised."""
    place = topic.lower()
    is_action = bool(_LEADER.search(place) or _COMMAND.search(place) or _COMMAND.search(type_name.lower()))
    for name in (*_JOINT_FIELDS, *_POSE_FIELDS):
        try:
            found = follow(values, parse_path(name))
            reader = reader_of(Source(topic=topic, field=name), values)
        except ValueError:
            continue
        kind = _kind_of(found, name, place, type_name.lower(), reader.joints)
        if kind == "pose" and not is_action and not _ROBOT_POSE.search(place):
            return None  # of an object or a tag
        if kind:
            part = _Part(
                topic=topic, field=name, names=reader.names, joints=reader.joints, kind=kind, is_action=is_action
            )
            return replace(part, names=("_".join(part.words) or "data",)) if isinstance(found, float) else part
    return None


def _kind_of(found: Any, name: str, topic: str, type_name: str, joints: Sequence[str]) -> Kind | None:
    """Kind of the numbers in a field of a message; None if they are not recognised."""
    if isinstance(found, dict):
        return "pose" if name in _POSE_FIELDS and {*found} == {"position", "orientation"} else None
    if not isinstance(found, float) and not (isinstance(found, np.ndarray) and found.dtype.kind == "f"):
        return None
    if all(_GRIPPER.search(joint.lower()) for joint in joints) if joints else _GRIPPER.search(topic):
        return "gripper"
    words = f"{topic} {type_name} {'' if name == 'data' else name}"
    is_array_of_joints = isinstance(found, np.ndarray) and _JOINTS.search(words) and not _NO_JOINTS.search(topic)
    return "joints" if joints or is_array_of_joints else None


def _chosen(parts: Sequence[_Part]) -> list[_Part]:
    """Sources of a feature: joints if there are any, otherwise poses; arms before grippers, each once.

    A gripper alone is not an arm: the arm's topic was not recognised.
    """
    of_kind = {kind: [part for part in parts if part.kind == kind] for kind in get_args(Kind)}
    arms = of_kind["joints"] or of_kind["pose"]
    found = [*arms, *of_kind["gripper"]] if arms else []
    chosen: list[_Part] = []
    # A leader comes before a command, and named joints before others.
    for part in sorted(found, key=lambda one: (one.kind == "gripper", not _LEADER.search(one.topic), not one.joints)):
        if not any(part.is_same(other) for other in chosen):
            chosen.append(part)
    return sorted(chosen, key=found.index)


@dataclass(kw_only=True, eq=False)
class _Topic(TopicSummary):
    """Content of a topic.

    Attributes:
        first: First message; None if none can be read.
        head: Head of its first image; None if its messages are not images.
        parts: Numbers in it that may belong to a feature, one for each set of joints in its messages.
        stamps_ns: Header times of the decoded messages.
        problem: Reason why no message can be read; "" otherwise.
    """

    name: str
    first: Values | None = None
    head: ImageHead | None = None
    parts: list[_Part] = field(default_factory=list)
    stamps_ns: array[int] = field(default_factory=lambda: array("q"))
    problem: str = ""

    @property
    def row_rate_hz(self) -> float:
        """Rate by header times, which rows use; simulated time runs slower or faster than log time."""
        if len(self.stamps_ns) < 3:
            return self.rate_hz
        steps = np.diff(np.unique(self.stamps_ns))
        usual = steps[np.abs(steps - np.median(steps)) <= 0.5 * np.median(steps)]  # without pauses
        return NS / float(usual.mean()) if len(usual) else self.rate_hz

    def look_into(self, message: ScannedMessage) -> None:
        """Examine one of the first messages."""
        try:
            values = decode_message(message)
        except UnknownEncodingError as error:
            self.problem = str(error)
            return
        except (ValueError, RecursionError, OverflowError, TypeError):
            return
        stamp = stamp_of(values)
        if stamp and 0 < stamp < 2**63:
            self.stamps_ns.append(stamp)
        if self.first is None:
            self.first = values
            try:
                self.head = image_head(values)
            except NoColorError as error:
                self.problem = str(error)
            except FieldError:
                pass  # not an image
        if self.head is None and not self.problem and (part := _part_of(self.name, self.type, values)):
            known = {joint for other in self.parts for joint in other.joints}
            if not self.parts or (part.joints and known.isdisjoint(part.joints)):
                self.parts.append(part)


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
    parts = [part for _, topic in sorted(topics.items()) for part in topic.parts]
    state = _chosen([part for part in parts if not part.is_action])
    action = _chosen([part for part in parts if part.is_action])
    lines = [f"# A mapping for {path.name}, suggested from its content; docs/import.md explains every key.", "#"]
    if not state:
        warning = (
            "No topic was recognised as the state of an arm: write its source from the topics that the mapping lists; "
            "the import refuses the mapping as it is."
        )
        tell(warning)
        lines += [f"# ATTENTION: {warning}", "#"]
    lines += [f"# {problem}" for problem in problems[:_MAX_PROBLEMS]]
    lines += _listed(topics)
    if not task_in_name(bag.name):
        tell("The name of the bag does not describe the task: write [task] text.")
    robot = re.sub(r"[^A-Za-z0-9_]+", "_", bag.name).strip("_") or "robot"
    models = (name for name in topics if name.endswith("robot_description"))
    model = min(models, key=lambda name: (name.count("/"), name), default="")  # nested ones may belong to objects
    lines += ["", "[robot]", f"name = {quoted(robot)}"]
    lines += [f"urdf_topic = {quoted(model)}" if model else '# urdf = "robot.urdf"']
    lines += ["", "[task]", *_task(bag)]
    lines += ["", "[clock]", *_clock(topics, cameras, [*state, *action])]
    lines += [*_sources("observation.state", state, topics), *_sources("action", action, topics)]
    if not action:
        lines += ["", "# No recognised topic is the command of this state, so the next state is the action."]
        lines += ["[[features.action]]", 'next = "observation.state"']
    poses = [part for part in parts if part.kind == "pose" and not part.is_action and part not in state]
    lines += _sources("observation.ee_pose", poses if state and len(poses) == 1 else [], topics)
    for camera, name in cameras.items():
        lines += ["", f"[cameras.{camera}]", f"topic = {quoted(name)}"]
        info = name.removesuffix("/compressed").removesuffix("/compressedDepth").rpartition("/")[0] + "/camera_info"
        lines += [f"info_topic = {quoted(info)}"] if info in topics else []
    return lines


def _topics(bag: Bag, problems: list[str]) -> dict[str, _Topic]:
    """Read the topics of a bag."""
    topics: dict[str, _Topic] = {}
    for message in bag.messages(problems):
        name = message.channel.topic
        topic = topics.setdefault(name, _Topic(name=name, type=message.channel.type))
        topic.add(message.log_ns)
        if topic.count <= _MAX_DECODED and not topic.problem:
            topic.look_into(message)
    return topics


def _listed(topics: Mapping[str, _Topic]) -> Iterator[str]:
    """Yield lines for every topic with its type, rate, count and fields."""
    yield "# Content:"
    for name, topic in sorted(topics.items()):
        rate = f"{topic.rate_hz:.1f} Hz, " if topic.rate_hz else ""
        stamp = "" if topic.stamps_ns else ", no times in its headers"
        yield f"#   {name}  {topic.type}, {rate}{topic.count} messages{stamp}"
        fields = ", ".join(topic.first or ())[:160]
        yield f"#     {topic.problem or fields or 'none of its messages can be read'}"


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


def _task(bag: Bag) -> list[str]:
    text = f"# text = {quoted('what the robot was asked to do')}  # the same for all bags"
    if name := task_in_name(bag.name):
        return [f"file_name = true  # the name of each bag is its task, here {quoted(name)}; or write:", text]
    return ["# The name of the bag does not describe the task. Write it here:", text]


def _clock(topics: Mapping[str, _Topic], cameras: Mapping[str, str], parts: Sequence[_Part]) -> Iterator[str]:
    """Rate and rows: those of the slowest camera, or a grid as fast as the slowest source."""
    rates = {name: topics[name].row_rate_hz for name in cameras.values() if topics[name].rate_hz}
    colour = [name for name in rates if (head := topics[name].head) and head.encoding not in DEPTH_UNITS]
    slowest = min(colour or rates, key=lambda name: rates[name], default="")
    if not slowest:
        rates = {part.topic: rate for part in parts if (rate := topics[part.topic].row_rate_hz)}
    rate = rates[slowest] if slowest else min(rates.values(), default=_USUAL_FPS)
    yield f"fps = {min(max(1, round(rate)), MAX_FPS)}"
    if slowest:
        yield f"# There is a row for each image of the slowest camera, {quoted(slowest)}."


def _sources(feature: str, parts: Sequence[_Part], topics: Mapping[str, _Topic]) -> Iterator[str]:
    """Sources of a feature; if names clash, with names that begin with the words that distinguish their topics."""
    for number, part in enumerate(parts, 1):
        rivals = [other for other in parts if other is not part and {*part.names} & {*other.names}]
        own = [word for word in part.words if not all(word in rival.words for rival in rivals)]
        topic = topics[part.topic]
        yield from ("", f"[[features.{feature if '.' not in feature else quoted(feature)}]]")
        yield from (f"topic = {quoted(part.topic)}", f"field = {quoted(part.field)}")
        if part.joints:
            yield f"joints = [{', '.join(map(quoted, part.joints))}]"
        if rivals:
            names = ("_".join([*(own or [str(number)]), name]) for name in part.names)
            yield f"names = [{', '.join(map(quoted, names))}]"
        elif part.kind == "gripper" and not part.joints and len(part.names) == 1:
            yield f"names = [{quoted(part.names[0])}]"
        if topic.row_rate_hz and (age_s := 2 / topic.row_rate_hz) > Clock(fps=1).max_age_s:
            yield f"max_age_s = {math.ceil(age_s * 10) / 10:.1f}  # its messages are that far apart"
