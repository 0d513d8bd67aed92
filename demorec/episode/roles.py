"""Roles of an episode's features: which ones are the robot's state, its action, its gripper, and so on.

Roles are found by common names: LeRobot's `observation.state` and `action`; openpi's `state`, `actions`,
`joint_position` and `gripper_position`; AgiBot's `observation.states.*` and `actions.*`; GR00T's `modality.json` and
`annotation.*`; the HDF5 files of robomimic, ALOHA and Isaac Lab. Names given by the user override them.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from demorec.core.errors import ConfigError
from demorec.core.plain import listed
from demorec.core.registry import nearest_match
from demorec.episode.element_names import FORCE_WORDS, VELOCITY_WORDS, is_gripper, is_numbered, joint_of
from demorec.episode.features import ACTION, EE_POSE, ENVIRONMENT_STATE, STATE, VELOCITY
from demorec.episode.info import EpisodeInfo, Feature

Role = Literal["state", "action", "gripper", "velocity", "pose", "sensor", "command", "label", "camera"]
"""state, action: input and output of a policy, in one feature or several.
gripper: a gripper with a separate feature.
velocity: velocities of the state's elements.
pose: pose of the hand or of objects.
sensor: any other observation.
command: the action in another form, or as it was sent.
label: information about a frame: an annotation, a reward, a task.
camera: images."""

ROLES: tuple[Role | None, ...] = (*get_args(Role), None)
"""Roles in display order."""
RecordedRole = Literal["", "state", "action", "gripper"]
"""Role stored in a recording for a feature; "" if its name implies it."""
SIMULATED_ROLES = (
    "--state, --action and --gripper are for data that demorec did not simulate; leave them out for its own."
)
COUNTERS = frozenset(("timestamp", "frame_index", "episode_index", "index", "task_index"))
"""Columns of every LeRobot dataset; they need no role."""
HDF5_PARTS: Mapping[str, str] = {
    "joint_pos": STATE,
    "gripper_qpos": STATE,
    "joint_vel": VELOCITY,
    "gripper_qvel": VELOCITY,
    "eef_pos": EE_POSE,
    "eef_quat": EE_POSE,
    "object": ENVIRONMENT_STATE,
    "qpos": STATE,
    "qvel": VELOCITY,
}
"""Suffix of an observation's name in HDF5 files of robomimic, Isaac Lab and ALOHA -> the feature it is a part of."""

_SEPARATOR = re.compile(r"[./_]+")
_OBSERVATION = frozenset(("observation", "observations", "obs"))
_STATE = frozenset(("state", "states"))
_ACTION = frozenset(("action", "actions"))
_WORLD = frozenset(("environment", "object", "objects"))
_LABEL = frozenset(
    ("annotation", "task", "subtask", "language", "instruction", "next", "reward", "done", "success", "discount")
)
_COMMAND = frozenset(("command", "commands", "cmd", "target", "targets"))
_KINDS: tuple[tuple[Role, frozenset[str]], ...] = (
    ("velocity", VELOCITY_WORDS),
    ("sensor", FORCE_WORDS),
    ("pose", _WORLD | {"pose", "poses", "ee", "eef", "tcp", "end", "endpose", "cartesian", "orientation"}),
    ("gripper", frozenset(("gripper", "grippers", "finger", "fingers", "effector"))),
)
"""Role -> words in a name that imply it, first match wins; an end_effector is not an effector."""
_MAX_LISTED = 20
_QUANTITIES = frozenset(("position", "positions", "pos", "velocity", "velocities", "vel"))
"""Words for the measured quantity, not for the measured part."""
_JOINTS = re.compile(r"(^|_)(joints?(_(pos|positions?|angles?))?|qpos|proprio)$")
"""Suffix of joint positions' names, used if no feature is named as the state."""


class Column(NamedTuple):
    """A feature, as input to the search for roles."""

    dtype: str  # "float32", "int64", "string", "video", ...
    # Names of the elements of a vector of numbers, "0", "1", ... where unknown; empty for anything else.
    elements: tuple[str, ...] = ()

    @property
    def is_vector(self) -> bool:
        """Whether it is a vector of floating-point numbers."""
        return self.dtype.startswith("float") and bool(self.elements)

    @property
    def is_named(self) -> bool:
        """Whether the names of its elements are known."""
        return not is_numbered(self.elements)


@dataclass(frozen=True, kw_only=True)
class NamedRoles:
    """Features with a role named by the user."""

    state: tuple[str, ...] = ()
    """Feature that is the robot's state (auto: by its name); several are joined in this order."""
    action: tuple[str, ...] = ()
    """Feature that is the action (auto: by its name); several are joined in this order."""
    gripper: tuple[str, ...] = ()
    """Feature, or element of the state, that is a gripper (auto: by its name)."""

    def __bool__(self) -> bool:
        return bool(self.state or self.action or self.gripper)


NO_NAMES = NamedRoles()
"""No roles named by the user."""


@dataclass(frozen=True, kw_only=True)
class Modality:
    """Content of GR00T's `modality.json`."""

    # state, action: features that they consist of, in order.
    state: tuple[str, ...] = ()
    action: tuple[str, ...] = ()
    labels: tuple[str, ...] = ()
    # Feature -> names of its elements after their groups: "left_arm.0", "gripper".
    elements: Mapping[str, tuple[str, ...]] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Roles:
    """The role of each feature of an episode or a dataset."""

    of: Mapping[str, Role | None]  # feature -> its role, None if it has none; without `COUNTERS`
    columns: Mapping[str, Column]  # feature -> its type and elements
    # state, action: features that they consist of, concatenated.
    state: tuple[str, ...]
    action: tuple[str, ...]
    named: NamedRoles

    @property
    def unknown(self) -> tuple[str, ...]:
        """Features without a role."""
        return tuple(name for name, role in self.of.items() if role is None)

    def having(self, *roles: Role) -> tuple[str, ...]:
        """List the features with any of some roles."""
        return tuple(name for name, role in self.of.items() if role in roles)

    def elements(self, parts: Sequence[str], *, qualified: bool = False) -> tuple[str, ...]:
        """List the names of the elements of concatenated features.

        With `qualified`, an element is named "joint.0" after its feature even if there is only one feature.
        """
        if len(parts) == 1 and not (qualified and _head(parts[0])[1]):
            return self.columns[parts[0]].elements
        return tuple(name for part in parts for name in _qualified(part, self.columns[part]))

    def in_state(self, parts: Sequence[str]) -> list[int | None]:
        """Find for each element of the state the index of the matching one in other features; None if missing."""
        others = self.elements(parts, qualified=len(self.state) > 1)
        return matching_elements(self.elements(self.state), others)

    def usual_name(self, name: str) -> str:
        """Return a feature's common name: `observation.state` for the whole state, `action` for the whole action."""
        return {self.state: STATE, self.action: ACTION}.get((name,), name)

    def grippers(self) -> NDArray[np.bool_]:
        """Find (D,) which elements of the state are grippers."""
        owners = [part for part in self.state for _ in self.columns[part].elements]
        elements = zip(owners, self.elements(self.state), strict=True)
        chosen = self.named.gripper
        if chosen:
            return np.array([part in chosen or name in chosen for part, name in elements], dtype=np.bool_)
        return np.array([self.of[part] == "gripper" or is_gripper(name) for part, name in elements], dtype=np.bool_)

    def beyond_names(self) -> dict[str, RecordedRole]:
        """Find features with a role that names alone do not imply, for a recording to store."""
        usual = find_roles(self.columns, NO_NAMES)
        grippers = [name for name in self.having("gripper") if usual.of[name] != "gripper"]
        found: dict[str, RecordedRole] = dict.fromkeys(grippers, "gripper")
        if self.state != usual.state:
            found |= dict.fromkeys(self.having("state"), "state")
        if self.action != usual.action:
            found |= dict.fromkeys(self.having("action"), "action")
        return found

    def notes(self) -> Iterator[str]:
        """Yield sentences about missing roles."""
        if missing := [word for word, parts in (("state", self.state), ("action", self.action)) if not parts]:
            flags = ", ".join(f"--{word} FEATURE" for word in missing)
            yield f"No {' and no '.join(missing)} found, so nothing was judged by it; name it: {flags}."
        if self.unknown:
            yield f"Without a role, so not looked at: {', '.join(self.unknown)}."


def roles_of_recording(info: EpisodeInfo, named: NamedRoles) -> Roles:
    """Find the roles of a recording's features; raises as `find_roles`, or if the user named those of a simulation."""
    if named and info.simulation is not None:
        raise ConfigError(SIMULATED_ROLES)
    return roles_of_features(info.features, named)


def roles_of_features(features: Iterable[Feature], named: NamedRoles) -> Roles:
    """Find the roles of recorded features; raises as `find_roles`."""
    features = tuple(features)
    taken = {*named.state, *named.action, *named.gripper}
    free = [feature for feature in features if feature.name not in taken]
    recorded = {
        role: tuple(feature.name for feature in free if feature.role == role) for role in ("state", "action", "gripper")
    }
    merged = NamedRoles(**{role: getattr(named, role) or names for role, names in recorded.items()})
    return find_roles({feature.name: Column(feature.dtype, feature.names) for feature in features}, merged)


def find_roles(columns: Mapping[str, Column], named: NamedRoles, modality: Modality | None = None) -> Roles:
    """Find the role of each feature: named by the user, else in `modality.json`, else implied by its name.

    ConfigError if the user named a missing feature, one that is not a vector, or one feature for two roles.
    """
    modality = modality or Modality()
    columns = {
        name: column if column.is_named else column._replace(elements=modality.elements.get(name, column.elements))
        for name, column in columns.items()
        if name not in COUNTERS
    }
    gripper_features = [name for name in named.gripper if name in columns]
    _check_named(columns, {"state": named.state, "action": named.action, "gripper": gripper_features})
    taken = {*named.state, *named.action, *gripper_features}
    free = [name for name, column in columns.items() if column.is_vector and name not in taken]
    state = named.state or tuple(filter(free.__contains__, modality.state)) or _state_parts(free)
    action = named.action or tuple(filter(free.__contains__, modality.action)) or _action_parts(free)
    of = {name: _role_by_name(name, column) for name, column in columns.items()}
    for name in modality.labels:
        if name in of:
            of[name] = "label"
    for name in state:
        of[name] = "state" if name in named.state or of[name] != "gripper" else "gripper"
    for name in action:
        of[name] = "action"
    for name in gripper_features:
        of[name] = "gripper"
    state = (*state, *(name for name in gripper_features if state and name not in state))
    roles = Roles(of=of, columns=columns, state=state, action=action, named=named)
    elements = roles.elements(roles.state)
    for name in named.gripper:
        if name not in columns and name not in elements:
            raise _nothing_called("gripper", name, columns, elements)
    return roles


def matching_elements(names: Sequence[str], others: Sequence[str]) -> list[int | None]:
    """Find for each element the index of the same one among others; None if missing.

    They match by name, ignoring words for position or velocity. If one side has numbers instead of names, they match by
    index if the counts are equal.
    """
    if is_numbered(names) or is_numbered(others) or list(names) == list(others):
        return list(range(len(names))) if len(names) == len(others) else [None] * len(names)
    places = {joint_of(name): place for place, name in enumerate(others)}
    return [places.get(joint_of(name)) for name in names]


def _qualified(part: str, column: Column) -> tuple[str, ...]:
    """Qualify the names of a part's elements by the words of its name beyond state or action."""
    _, words = _head(part)
    stem = ".".join(word for word in words if word not in _QUANTITIES) or part
    if len(column.elements) == 1 and not column.is_named:
        return (stem,)
    return tuple(f"{stem}.{element}" for element in column.elements)


def _words(name: str) -> list[str]:
    return [word for word in _SEPARATOR.split(name.lower()) if word]


def _head(name: str) -> tuple[str, list[str]]:
    """Split a feature's name into ("state", "action", "observation" or "", the other words)."""
    words = _words(name)
    is_observed = len(words) > 1 and words[0] in _OBSERVATION
    words = words[1:] if is_observed else words
    for head, known in (("state", _STATE), ("action", _ACTION)):
        if head == "action" and is_observed:
            continue  # the previous action
        if words and words[0] in known:
            return head, words[1:]
        if words and words[-1] in known:
            return head, words[:-1]
    return ("observation" if is_observed else ""), words


def _kind(words: Iterable[str]) -> Role | None:
    """Determine the role implied by the words of a name; None if none is known."""
    there = set(words)
    return next((role for role, known in _KINDS if there & known), None)


def _role_by_name(name: str, column: Column) -> Role | None:
    """Determine a feature's role by its own name and type; a state or an action may still be found."""
    head, words = _head(name)
    first = (_words(name) or [""])[0]
    if column.dtype in ("video", "image"):
        return "camera"
    if column.dtype in ("string", "language") or first in _LABEL or "annotation" in words:
        return "label"
    if not column.is_vector:
        return "sensor" if first in _OBSERVATION else "label" if column.dtype == "bool" else None
    if head == "action" or (not head and _COMMAND & set(words)):
        return "command"
    kind = _kind(words)
    is_observation = bool(head) or _JOINTS.search("_".join(words)) is not None
    return kind or ("sensor" if is_observation else None)


def _state_parts(free: Sequence[str]) -> tuple[str, ...]:
    """Find the state: a feature of this name, else all parts of one that are joints or grippers, else joints, else
    poses.
    """
    heads = {name: _head(name) for name in free}
    whole = [name for name, (head, words) in heads.items() if head == "state" and words in ([], ["robot"])]
    if whole:
        return (min(whole, key=lambda name: _words(name)[0] not in _OBSERVATION),)
    parts = {name: words for name, (head, words) in heads.items() if head == "state" and not _WORLD & set(words)}
    joints = [name for name, words in parts.items() if _kind(words) is None]
    if not joints:
        others = {name: words for name, (head, words) in heads.items() if head in ("", "observation")}
        joints = [name for name, words in others.items() if _kind(words) is None and _JOINTS.search("_".join(words))]
        parts |= others if joints else {}
    if joints:
        return (*joints, *(name for name, words in parts.items() if _kind(words) == "gripper"))
    return tuple(name for name, words in parts.items() if _kind(words) == "pose")


def _action_parts(free: Sequence[str]) -> tuple[str, ...]:
    """Find the action: a feature of this name, else all parts of one that are joints or grippers, else poses."""
    heads = {name: _head(name) for name in free}
    own = {name: words for name, (head, words) in heads.items() if head == "action"}
    whole = [name for name, words in own.items() if not words]
    if whole:
        return (min(whole),)
    joints = [name for name, words in own.items() if _kind(words) in (None, "gripper")]
    return tuple(joints or [name for name, words in own.items() if _kind(words) == "pose"])


def _check_named(columns: Mapping[str, Column], wanted: Mapping[str, Sequence[str]]) -> None:
    """Raise ConfigError for features that cannot have the role named by the user."""
    seen: dict[str, str] = {}
    for flag, names in wanted.items():
        for name in names:
            if name not in columns:
                raise _nothing_called(flag, name, columns)
            if not columns[name].is_vector:
                raise ConfigError(f"--{flag} names {name!r}, which is {columns[name].dtype}, not a vector of numbers.")
            if name in seen:
                raise ConfigError(
                    f"--{flag} names {name!r}, which --{seen[name]} already names: give each feature one role."
                )
            seen[name] = flag


def _nothing_called(flag: str, name: str, columns: Mapping[str, Column], elements: Sequence[str] = ()) -> ConfigError:
    what = "feature or element of the state" if flag == "gripper" else "feature"
    vectors = [each for each, column in columns.items() if column.is_vector]
    there = listed([*vectors, *elements], _MAX_LISTED, ", ") or "none"
    near = nearest_match(name, [*columns, *elements])
    return ConfigError(f"--{flag}: unknown {what} {name!r}.{near} Vectors of numbers are: {there}.")
