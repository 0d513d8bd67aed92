"""Numbers of a topic that may belong to a robot's state or action, found by message types and usual names.

Recognises joint positions (JointState and similar types, JointTrajectory, number arrays with joint names in the topic),
a gripper's opening, poses and velocities in space. A topic with a word such as leader or command is the action.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from demorec.extensions.imports.fields import SourceReader, follow, parse_path, reader_of
from demorec.extensions.imports.mapping import Source
from demorec.mcap.cdr import Values

Kind = Literal["joints", "gripper", "pose", "twist"]
_JOINT_FIELDS = (
    "position", "positions", "joint_position", "joint_positions", "q", "qpos", "joints.position", "points[0].positions",
    "data",
)  # fmt: skip
_SPACE_FIELDS: tuple[tuple[Kind, tuple[str, ...]], ...] = (
    ("pose", ("pose.pose", "pose", "position", "orientation")),
    ("twist", ("twist.twist", "twist", "linear", "angular")),
)
"""Fields of a pose and of a velocity: one message, or the last two side by side."""
_LEADER = re.compile(r"leader|master|gello|teleop|(?<![a-z])lead(?![a-z])")
_COMMAND = re.compile(r"command|cmd|target|desired|goal|setpoint|(?<![a-z])(?:actions?|ref|reference)(?![a-z])")
_COMMAND_TYPE = re.compile(r"(Command|Cmd|JointTrajectory)$")
_JOINTS = re.compile(r"joint|follower|puppet|leader|master|(?<![a-z])(?:arm|qpos|q)(?![a-z])|command")
_NO_JOINTS = re.compile(r"velocit|effort|torque|force|wrench|cartesian|(?<![a-z])(?:vel|pose|tcp)(?![a-z])")
_GRIPPER = re.compile(r"gripper|finger|jaw|knuckle")
_ROBOT_POSE = re.compile(r"odom|end_effector|(?<![a-z])(ee|eef|tcp|tool\d*|flange|hand|current|robot|arm)(?![a-z])")
_SIDE = re.compile(r"(?<![a-z])(left|right|l|r|\d+)(?![a-z])")


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """Numbers of a topic that may belong to a feature.

    Attributes:
        reader: Reader of the numbers, with their source.
        kind: Joints, a gripper's opening, or a pose or velocity in space.
        is_action: Whether the topic commands the robot, or belongs to a leader arm.
        name: Name of the only element, if the message does not name it; "" otherwise.
        prefix: Prefix of each name.
    """

    reader: SourceReader
    kind: Kind
    is_action: bool
    name: str = ""
    prefix: str = ""

    @property
    def topic(self) -> str:
        """Topic of the messages."""
        return self.reader.source.topic

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of its elements."""
        return tuple(self.prefix + name for name in ((self.name,) if self.name else self.reader.names))

    @property
    def words(self) -> list[str]:
        """Words in its topic."""
        return [word for word in re.split(r"[^A-Za-z0-9]+", self.topic) if word]

    @property
    def is_leader(self) -> bool:
        """Whether a person moves this arm."""
        return _LEADER.search(self.topic.lower()) is not None

    @property
    def is_robot_pose(self) -> bool:
        """Whether a pose is the robot's own and not an object's or a tag's."""
        return self.kind == "pose" and _ROBOT_POSE.search(self.topic.lower()) is not None

    def of_joints(self, joints: Sequence[str]) -> Candidate:
        """The part with these joints, which have the same publisher."""
        source = replace(self.reader.source, joints=tuple(joints))
        reader = replace(self.reader, source=source, names=tuple(joints), joints=tuple(joints))
        kind: Kind = "gripper" if _are_gripper(joints) else "joints"
        return replace(self, reader=reader, kind=kind)


def candidates_of(topic: str, type_name: str, values: Values) -> list[Candidate]:
    """Candidates in a message of a topic; empty if nothing is recognised."""
    lower = topic.lower()
    is_action = bool(_LEADER.search(lower) or _COMMAND.search(lower) or _COMMAND_TYPE.search(type_name))
    for field in _JOINT_FIELDS:
        if found := _joints(topic, type_name, field, values, is_action):
            return [found]
    found_in_space = []
    for kind, fields in _SPACE_FIELDS:
        whole = next((field for field in fields[:2] if _has_parts(values, field, fields[2:])), "")
        parts = [whole] if whole else fields[2:] if _has_parts(values, "", fields[2:]) else []
        for field in parts:
            made = _candidate(topic, field, values, kind, is_action)
            if made is not None:
                found_in_space.append(replace(made, prefix="" if whole else f"{field}."))
    return found_in_space


def _candidate(topic: str, field: str, values: Values, kind: Kind, is_action: bool) -> Candidate | None:
    """Return the candidate of a field; None if it has no numbers."""
    try:
        return Candidate(reader=reader_of(Source(topic=topic, field=field), values), kind=kind, is_action=is_action)
    except ValueError:
        return None


def _joints(topic: str, type_name: str, field: str, values: Values, is_action: bool) -> Candidate | None:
    """Candidate of a field that usually holds joint positions or a gripper's opening."""
    try:
        numbers = follow(values, parse_path(field))
    except ValueError:
        return None
    is_vector = isinstance(numbers, np.ndarray) and numbers.ndim == 1 and numbers.dtype.kind == "f"
    if "format" in values or "encoding" in values or not (is_vector or isinstance(numbers, float)):
        return None
    found = _candidate(topic, field, values, "joints", is_action)
    if found is None:
        return None
    place = f"{topic} {type_name} {'' if field == 'data' else field}".lower()
    if _are_gripper(found.reader.joints) or (not found.reader.joints and _GRIPPER.search(topic.lower())):
        return replace(found, kind="gripper", name="" if is_vector else "_".join(found.words) or "data")
    if found.reader.joints:
        return found
    return found if is_vector and _JOINTS.search(place) and not _NO_JOINTS.search(topic.lower()) else None


def _are_gripper(joints: Sequence[str]) -> bool:
    return bool(joints) and all(_GRIPPER.search(joint.lower()) for joint in joints)


def _has_parts(values: Values, field: str, parts: Sequence[str]) -> bool:
    """Whether a message has these fields, with three or four numbers each."""
    try:
        found = follow(values, parse_path(field))
    except ValueError:
        return False
    return isinstance(found, dict) and all(isinstance(found.get(part), dict) for part in parts)


@dataclass(frozen=True, kw_only=True)
class Choice:
    """Features of a suggested mapping.

    Attributes:
        state, action: Parts of them; an empty action means the next state.
        poses: Parts of observation.ee_pose.
    """

    state: list[Candidate]
    action: list[Candidate]
    poses: list[Candidate]


def choose_features(candidates: Sequence[Candidate]) -> Choice:
    """Choose state and action: joints if there are any, otherwise poses and velocities in space.

    A gripper alone is not a state: the arm's topic was not recognised.
    """
    measured = [candidate for candidate in candidates if not candidate.is_action]
    commands = [candidate for candidate in candidates if candidate.is_action]
    state, action = _distinct(measured, ("joints", "gripper")), _distinct(commands, ("joints", "gripper"))
    if not _has_arm(state):
        state = [*_own_poses(measured), *state]
        action = [*_distinct(commands, ("pose", "twist")), *action]
    if not _has_arm(state):
        state = []
    if not _has_arm(action):
        action = []
    poses = [candidate for candidate in measured if candidate.is_robot_pose and candidate not in state]
    poses = poses if state and len({pose.topic for pose in poses}) == 1 and not poses[0].prefix else []
    return Choice(state=state, action=action, poses=poses)


def _has_arm(candidates: Sequence[Candidate]) -> bool:
    return any(candidate.kind != "gripper" for candidate in candidates)


def _own_poses(measured: Sequence[Candidate]) -> list[Candidate]:
    """Poses and velocities of the robot, or the only ones available."""
    found = [candidate for candidate in measured if candidate.kind in ("pose", "twist")]
    named = {candidate.topic for candidate in found if candidate.is_robot_pose}
    if named:
        return [candidate for candidate in found if candidate.topic in named]
    return found if len({candidate.topic for candidate in found}) == 1 else []


def _distinct(candidates: Sequence[Candidate], kinds: Sequence[Kind]) -> list[Candidate]:
    """Candidates of some kinds, without duplicate joints: arms before grippers, a leader before a command."""
    chosen: list[Candidate] = []
    found = [candidate for candidate in candidates if candidate.kind in kinds]
    for candidate in sorted(found, key=_preference):
        if not any(_are_same(candidate, other) for other in chosen):
            chosen.append(candidate)
    return sorted(chosen, key=lambda candidate: (candidate.kind == "gripper", found.index(candidate)))


def _preference(candidate: Candidate) -> tuple[bool, bool, bool, int]:
    is_gripper = candidate.kind == "gripper"
    return is_gripper, not candidate.is_leader, not candidate.reader.joints, -len(candidate.labels)


def _are_same(candidate: Candidate, other: Candidate) -> bool:
    """Whether two candidates are probably the same joints published twice; left and right, 1 and 2 are two robots."""
    if candidate.topic == other.topic:
        return False
    if _SIDE.sub("", candidate.topic.lower()) == _SIDE.sub("", other.topic.lower()):
        return False
    joints, others = set(candidate.reader.joints), set(other.reader.joints)
    if candidate.kind != other.kind:
        return bool(candidate.kind == "gripper" and any(_GRIPPER.search(label.lower()) for label in other.labels))
    return not joints or not others or bool(joints & others)


def of_publishers(candidate: Candidate, publishers: Sequence[tuple[str, ...]]) -> Iterator[Candidate]:
    """One candidate for each set of joints named in the topic's messages."""
    named: set[str] = set()
    for joints in publishers if candidate.reader.joints else ():
        if not named & {*joints}:
            yield candidate.of_joints(joints)
        named |= {*joints}
    if not named:
        yield candidate
