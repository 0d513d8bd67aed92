"""Which numbers in a topic's messages may say what a robot does, or shall do, and which of them a mapping takes.

The words that people give topics, types and fields are what there is to go by: a follower, a puppet and a measured
state are what the robot does, a leader, a master and a command what it shall do; `q` and `position` are positions.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from demorec.mcap.cdr import Values
from demorec.sources.fields import SourceReader, follow, numbers_in, parse_path, reader_of
from demorec.sources.mapping import MAX_ELEMENTS, Source
from demorec.sources.words import first_numbers

Kind = Literal["arm", "gripper", "base", "pose", "twist", "numbers"]
_LEADER = r"leader|master|gello|teleop|(?<![a-z])(?:lead|haptic|spacemouse|operator|vr|oculus)(?![a-z])"
_ACTION = re.compile(
    rf"{_LEADER}|command|cmd|target|desired|goal|setpoint|(?<![a-z])(?:actions?|ref|reference)(?![a-z])"
)
_STATE = re.compile(r"follower|puppet|measured|actual|feedback|lowstate|(?<![a-z])(?:joint|robot)?states?(?![a-z])")
_COMMAND_TYPE = re.compile(r"(Cmds?|Commands?|Goal|Target|Jog|Action|JointTrajectory)$")
_STATE_TYPE = re.compile(r"(?<!^Joint)(States?|StateList|StateRTMsg)$")
_GRIPPER = re.compile(r"gripper|finger|jaw|claw|knuckle|(?<![a-z])(?:hand(?!le|eye|held)|robotiq)")
_WHEEL = re.compile(r"wheel|caster|steer")
_BASE = re.compile(rf"{_WHEEL.pattern}|(?<![a-z])(hip|knee|thigh|calf|ankle|foot|hx|hy|kn)(?![a-z])")
_ROBOT_POSE = re.compile(
    r"odom|end_effector|(?<![a-z])(ee|eef|tcp|tool\d*|flange|hand|gripper|current|robot|arm|cartesian)(?![a-z])"
)
_OTHER_NUMBERS = re.compile(
    r"force|wrench|torque|effort|velocit|tactile|temperature|imu|(?<![a-z])(vel|current)(?![a-z])"
)
_CARTESIAN = re.compile(r"cartesian|(?<![a-z])(?:tcp|ee|eef|pose)(?![a-z])")
_WORD = re.compile(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])")
_POSITION = {"q", "qpos", "position", "positions", "pos", "joint", "joints", "angle", "angles"}
_DESIRED = {"desired", "target", "command", "commanded", "cmd", "goal", "reference", "ref", "setpoint", "d", "des"}
_MEASURED = {"measured", "actual", "present", "feedback", "follower", "puppet"}
_LEADING = {"leader", "master"}
_SIDES = {"left", "right", "l", "r"}
_PARTS = _SIDES | {"state", "states", "arm", "robot", "gripper", "hand", "finger", "fingers", "current", "rad"}
_GRIPPER_FIELD = _SIDES | {"gripper", "finger", "hand", "width", "opening"} | _LEADING | _MEASURED
_ANY_COMMAND = {"cmd", "command", "commands", "action", "actions", "values", "joint", "velocity", "velocities"}
"""Words of a field that is a command though it holds no positions."""
_QUANTITIES = {"joint", "joints", "position", "positions", "pos", "velocity", "velocities"}
_QUANTITIES |= {"cartesian", "torque", "pose"}
_TIMES = {"header", "timestamp", "stamp", "ts", "time"}
_MAX_NESTED, _MAX_FIELDS = 4, 100
_MAX_UNKNOWN = 3
"""Fields that are offered of a message whose topic or type says what it is for, but none of whose fields does."""


@dataclass(frozen=True, kw_only=True)
class Vector:
    """Numbers of a topic that could be part of a feature.

    Attributes:
        topic, type: Where they are.
        field: As of a source.
        reader: Of its numbers.
        kind: Of what: joints of an arm, a gripper or a base (wheels, legs), a pose, a velocity in space, or others.
        role: state, action, or "" where no word says which.
        is_sure: Whether nothing in the message suits that role better.
        names: Of the elements, where neither the message nor the field has a good one.
        prefix: In front of each name.
        first: The first numbers.
        rate_hz: Of the messages that hold it; 0 for fewer than two.
        has_stamp: Whether the headers of its messages have a time.
        age_s: How old a message may have to be for a row to have one, where that is more than usual; 0 elsewhere.
    """

    topic: str
    type: str
    field: str
    reader: SourceReader
    kind: Kind
    role: str
    is_sure: bool = True
    names: tuple[str, ...] = ()
    prefix: str = ""
    first: str = ""
    rate_hz: float = 0.0
    has_stamp: bool = True
    age_s: float = 0.0

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of its elements without a prefix for the topic."""
        return tuple(self.prefix + name for name in self.names or self.reader.names)

    @property
    def words(self) -> list[str]:
        """Of its topic."""
        return _split(self.topic)

    @property
    def place(self) -> list[str]:
        """The words of its topic and field."""
        return [*self.words, *_split(self.field)]

    @property
    def is_leader(self) -> bool:
        """Whether its topic is that of an arm that a person moves."""
        return re.search(_LEADER, self.topic.lower()) is not None

    @property
    def is_robot(self) -> bool:
        """Whether its topic is, for a pose, that of the robot, and not that of a thing or a tag."""
        return _ROBOT_POSE.search(self.topic.lower()) is not None

    def of_joints(self, joints: Sequence[str], messages: Iterable[Values]) -> Vector:
        """A part of it, which some of the messages may hold."""
        leads = self.role == "state" and all(re.search(_LEADER, joint.lower()) for joint in joints)
        role = "action" if leads else self.role
        source = replace(self.reader.source, joints=tuple(joints))
        reader, first = replace(self.reader, source=source, names=tuple(joints), joints=tuple(joints)), ""
        for values in messages:
            with suppress(ValueError):
                first = first_numbers(reader.read(values))
                break
        return replace(self, reader=reader, kind=_kind_of(joints), role=role, first=first)


def vectors_of(topic: str, type_name: str, values: Values) -> Iterator[Vector]:
    """What a message holds, the likeliest joint positions first."""
    if "/_action/" in topic or topic.endswith("/tf_static"):
        return
    empty = Vector(topic=topic, type=type_name, field="", reader=_NOTHING, kind="numbers", role=_role(topic, type_name))
    found = [*_positions(empty, values)]
    if not found and empty.role == "action":
        found = [*_any_command(empty, values)][:1]
    seen: set[tuple[bool, str, frozenset[str]]] = set()
    for vector in sorted(found, key=_doubt):
        place = (vector.kind == "gripper", vector.role, frozenset(_words(vector.field) & _SIDES))
        yield replace(vector, is_sure=vector.is_sure and place not in seen)
        seen.add(place)
    others = [*_in_space(empty, values), *_plain(empty, values)]
    if not found and not others and empty.role:
        paths = [path for path, size in _numbers(values) if size > 1 or empty.role == "action"]
        others = [vector for path in paths[:_MAX_UNKNOWN] for vector in _made(empty, values, path)]
    yield from (replace(vector, is_sure=not found) for vector in others)


def transforms_of(topic: str, type_name: str, messages: Iterable[Values]) -> Iterator[Vector]:
    """The frames of a topic like /tf, each once."""
    seen: set[str] = set()
    for values in messages:
        items = values.get("transforms")
        for item in items if isinstance(items, list) and not topic.endswith("/tf_static") else ():
            key = next((key for key in ("child_frame_id", "child_frame") if isinstance(item, dict) and key in item), "")
            frame = str(item[key]) if key else ""
            if not frame or frame in seen or "]" in frame:
                continue
            seen.add(frame)
            inner = f"transforms[{key}={frame}]" + (".transform" if "transform" in item else "")
            empty = Vector(topic=topic, type=type_name, field="", reader=_NOTHING, kind="numbers", role="")
            yield from _made(empty, values, inner, prefix=f"{frame}.")


_NOTHING = SourceReader(source=Source())


def _made(empty: Vector, values: Values, path: str, **known: Any) -> Iterator[Vector]:
    """The vector of a path, if it is one, with what is known of it."""
    try:
        reader = reader_of(Source(topic=empty.topic, field=path), values)
        parts = [np.ravel(item) for _, item in numbers_in(follow(values, reader.steps))]
    except ValueError:  # it has none, or one of another shape
        return
    count = len(reader.names)
    known.setdefault("names", tuple(f"joint_{k}" for k in range(count)) if len(set(reader.names)) < count else ())
    yield replace(empty, field=path, reader=reader, first=first_numbers(np.concatenate(parts)), **known)


def _role(topic: str, type_name: str) -> str:
    lower, last = topic.lower(), re.split(r"[/.]", type_name)[-1]
    if _ACTION.search(lower):
        return "action"
    if _STATE_TYPE.search(last) or _STATE.search(lower):
        return "state"
    return "action" if _COMMAND_TYPE.search(last) else ""


def _kind_of(joints: Sequence[str]) -> Kind:
    if not joints:
        return "arm"
    if all(_GRIPPER.search(joint.lower()) for joint in joints):
        return "gripper"
    return "base" if all(_BASE.search(joint.lower()) for joint in joints) else "arm"


def _split(place: str) -> list[str]:
    return [word for word in re.split(r"[^A-Za-z0-9]+", place) if word]


def _words(path: str) -> set[str]:
    return {word.lower() for word in _WORD.findall(path)}


def _numbers(values: Mapping[str, Any], place: str = "") -> Iterator[tuple[str, int]]:
    """(path, how many) of the numbers in a message; of a list of messages, of the same field of each."""
    for key, item in list(values.items())[:_MAX_FIELDS]:
        path = f"{place}{key}"
        if key in _TIMES or not re.fullmatch(r"\w+", key) or isinstance(item, bool):
            continue
        if isinstance(item, int | float | np.ndarray) and 0 < np.size(item) <= MAX_ELEMENTS:
            yield path, np.size(item)
        elif isinstance(item, Mapping) and place.count(".") < _MAX_NESTED:
            if not {"x", "y"} & set(item) and all(isinstance(value, int | float) for value in item.values()):
                yield path, len(item)  # a field for each joint
            yield from _numbers(item, f"{path}.")
        elif isinstance(item, list) and 0 < len(item) <= MAX_ELEMENTS and isinstance(item[0], Mapping):
            for inner, value in item[0].items():
                if inner == "positions" and isinstance(value, np.ndarray) and value.size:
                    yield f"{path}[0].positions", value.size
                elif isinstance(value, int | float) and not isinstance(value, bool):
                    yield f"{path}.{inner}", len(item)


def _positions(empty: Vector, values: Values) -> Iterator[Vector]:
    """The fields whose words say that they hold positions of joints."""
    for path, size in _numbers(values):
        words = _words(path.rpartition(".")[2])
        beside = _words(path) - words
        is_position = words & _POSITION and not words - _POSITION - _DESIRED - _MEASURED - _LEADING - _PARTS
        is_position = is_position or (size == 1 and words & {"gripper", "width"} and words <= _GRIPPER_FIELD)
        if not is_position or beside & {"error", "cartesian", "tcp", "elbow", "imu", "pose"}:
            continue
        called = values.get("name")
        text = f"{empty.topic} {empty.type} {path} {called if isinstance(called, str) else ''}".lower()
        for vector in _made(empty, values, path):
            kind, role = _kind_of(vector.reader.joints), empty.role
            if not vector.reader.joints and _GRIPPER.search(text):
                kind, role = "gripper", empty.role or "state"
            elif not vector.reader.joints and size == 1:
                continue
            is_single = "[0]" not in path or len(follow(values, parse_path(path.partition("[0]")[0]))) == 1
            if (words | beside) & _MEASURED:
                role = "state"
            elif (words | beside) & (_DESIRED | _LEADING) and empty.role != "action":
                is_single = is_single and bool((words | beside) & _LEADING)
                role = "action"
            yield replace(vector, kind=kind, role=role, is_sure=is_single)


def _doubt(vector: Vector) -> tuple[bool, ...]:
    """What makes one field of positions less likely than another one of the same message."""
    words = _words(vector.field)
    is_few = len(vector.reader.names) < 3
    return (vector.kind == "gripper", is_few, "motor" in words, not words & _MEASURED, not vector.reader.joints)


def _any_command(empty: Vector, values: Values) -> Iterator[Vector]:
    called = values.get("name")
    text = f"{empty.topic} {called if isinstance(called, str) else ''}".lower()
    for path, size in _numbers(values):
        if _words(path) <= _ANY_COMMAND and (size > 1 or _GRIPPER.search(text)):
            kind: Kind = "gripper" if _GRIPPER.search(text) else "arm"
            yield from _made(empty, values, path, kind=kind)


def _plain(empty: Vector, values: Values) -> Iterator[Vector]:
    """The numbers of std_msgs: what they are, the topic alone says."""
    data, lower = values.get("data"), empty.topic.lower()
    is_vector = isinstance(data, np.ndarray) and data.dtype.kind == "f"
    is_gripper = bool(_GRIPPER.search(lower)) and not _OTHER_NUMBERS.search(lower)
    if "encoding" in values or "format" in values:
        return
    if not (is_vector or isinstance(data, float) or (is_gripper and isinstance(data, int))):  # or a boolean
        return
    may_be_joints = not _OTHER_NUMBERS.search(lower) and not _CARTESIAN.search(lower)
    says_joints = empty.role or _words(empty.topic) & _POSITION
    are_joints = is_vector and (empty.role == "action" or (may_be_joints and says_joints))
    kind: Kind = "gripper" if is_gripper else "arm" if are_joints else "numbers"
    role = empty.role or ("state" if is_gripper else "")
    names = () if is_vector else ("_".join(empty.words) or "data",)
    yield from _made(empty, values, "data", kind=kind, role=role, names=names)


def _in_space(empty: Vector, values: Values) -> Iterator[Vector]:
    """The first pose and the first velocity in space."""
    first: dict[Kind, tuple[str, tuple[str, str]]] = {}
    for kind, place, pair in _pairs(values, ""):
        first.setdefault(kind, (place, pair))
    for kind, (place, pair) in first.items():
        fields = [place] if place else pair
        for field in fields:
            yield from _made(empty, values, field, kind=kind, prefix="" if place else f"{field}.")


def _pairs(values: Mapping[str, Any], place: str) -> Iterator[tuple[Kind, str, tuple[str, str]]]:
    pairs: dict[tuple[str, str], Kind] = {
        ("position", "orientation"): "pose",
        ("translation", "rotation"): "pose",
        ("linear", "angular"): "twist",
    }
    for pair, kind in pairs.items():
        if all(isinstance(values.get(name), Mapping) for name in pair):
            yield kind, place, pair
            return
    for key, item in values.items():
        if isinstance(item, Mapping) and key not in _TIMES and place.count(".") < 1 and re.fullmatch(r"\w+", key):
            yield from _pairs(item, f"{place}.{key}" if place else key)


def choose_features(vectors: Sequence[Vector]) -> tuple[list[Vector], list[Vector], list[Vector], str]:
    """The parts of the state and of the action: joints if there are any, otherwise poses and velocities in space.

    Returns:
        The state, the action (empty: it is the next state), all other vectors, and a warning that the robot's arm is
        not among the parts, "" where it is.
    """
    usable = [vector for vector in vectors if vector.is_sure and vector.rate_hz and vector.kind != "numbers"]
    measured = [vector for vector in usable if vector.role != "action"]
    commands = [vector for vector in usable if vector.role == "action"]
    state = _joints([vector for vector in measured if vector.role == "state"])
    unsaid = [vector for vector in measured if vector.kind == "arm" and not vector.role]
    robots = {tuple(word for word in vector.words if word not in _SIDES) for vector in unsaid}
    if len(robots) == 1 and not _has(state, "arm"):
        state = [*unsaid, *state]
    has_arm = _has(state, "arm")
    bodies = [vector for vector in state if vector.kind != "gripper"]
    if all(_WHEEL.search(label.lower()) for vector in bodies for label in vector.labels):
        state = sorted([*state, *_of_robot(measured)], key=lambda vector: vector.kind == "gripper")
    action = _joints(commands)
    if not has_arm and not _has(action, "arm"):
        action = [*(vector for vector in commands if vector.kind in ("pose", "twist")), *action]
    warning = ""
    if all(vector.kind == "gripper" for vector in state):
        warning = _lacking(state, vectors)
        state = []
    elif all(vector.kind == "gripper" for vector in action):
        action = []  # the arm's command is missing, and the next state has the gripper's opening as well
    taken = {id(vector) for vector in (*state, *action)}
    return state, action, [vector for vector in vectors if id(vector) not in taken], warning


def _lacking(grippers: Sequence[Vector], vectors: Sequence[Vector]) -> str:
    found = "no topic is known to say what the robot does"
    if grippers:
        labels = [label for vector in grippers for label in vector.labels]
        found = f"the only joints that are known to be measured are a gripper's ({', '.join(labels[:4])})"
    advice = (
        "take the topics that do from the lines that are commented out" if vectors else "the bag has none of numbers"
    )
    return f"The arm is left out: {found}. The import refuses this mapping as it is: {advice}."


def _has(vectors: Iterable[Vector], kind: str) -> bool:
    return any(vector.kind == kind for vector in vectors)


def _joints(vectors: Sequence[Vector]) -> list[Vector]:
    """The joints among them, none twice: those of arms and bases, then those of grippers."""
    bodies = _distinct([vector for vector in vectors if vector.kind in ("arm", "base")])
    grippers = [vector for vector in vectors if vector.kind == "gripper"]
    if any(_GRIPPER.search(label.lower()) for vector in bodies for label in vector.labels):
        known = {label for vector in bodies for label in vector.labels}
        grippers = [vector for vector in grippers if vector.reader.joints and not known & set(vector.labels)]
    return [*bodies, *_distinct(grippers)]


def _distinct(vectors: Sequence[Vector]) -> list[Vector]:
    """Those that say something else than the others, in the order given."""
    chosen: list[Vector] = []
    for vector in sorted(vectors, key=_rank):
        if not any(_are_same(vector, other) for other in chosen):
            chosen.append(vector)
    return sorted(chosen, key=vectors.index)


def _rank(vector: Vector) -> tuple[bool, bool, bool, int, int]:
    is_other = any(words.search(vector.topic.lower()) for words in (_CARTESIAN, _OTHER_NUMBERS))
    return not vector.is_leader, not vector.reader.joints, is_other, -len(vector.labels), len(vector.words)


def _are_same(one: Vector, other: Vector) -> bool:
    """Whether two vectors are likely the same joints sent twice: a relay, a merged topic, a driver's own message."""
    if one.topic == other.topic:
        return False
    joints, others = set(one.reader.joints), set(other.reader.joints)
    if joints and others and not joints & others:
        return False
    # Two arms have topics of the same kind that differ by a word each: left and right, 1 and 2; so do two quantities.
    only, only_other = {*one.words} - {*other.words}, {*other.words} - {*one.words}
    are_pair = bool(only and only_other) and not (only | only_other) & _QUANTITIES
    are_alike = (one.type, one.field, one.is_leader, joints) == (other.type, other.field, other.is_leader, others)
    return not (are_pair and are_alike)


def _of_robot(measured: Sequence[Vector]) -> list[Vector]:
    """Poses and velocities of a robot, or the only ones that there are."""
    found = [vector for vector in measured if vector.kind in ("pose", "twist")]
    named = [vector for vector in found if vector.is_robot]
    return named or (found if len({vector.topic for vector in found}) == 1 else [])
