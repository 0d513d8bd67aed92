"""Input of the checks: every episode read once, its numbers by role, its images as small grey thumbnails."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import NDArray

from demorec.check.base import NotMeasuredError
from demorec.core.geometry import Array, signs_of_course
from demorec.episode.element_names import is_position, joint_of
from demorec.episode.roles import Roles
from demorec.extensions.doctor.robust import without_gaps

if TYPE_CHECKING:
    from demorec.extensions.datasets.folder import LeRobotFolder
    from demorec.extensions.doctor.thumbnails import CameraThumbnails

Flags = NDArray[np.bool_]
DROP = "demorec dataset drop {path} --episodes {episode} --out NEW"
"""Advice for one bad episode."""
LOOK_OR_DROP = "look at it: demorec view {path} --episodes {episode}; then drop it: " + DROP
"""Advice for one unusual episode."""
REPAIR = "demorec dataset repair {path} --out NEW"
"""Advice for tables, counts and statistics that contradict the rows."""
_INCREMENT = re.compile(r"^delta_|\.delta$")
"""Mark of an action's element that is the change of the state's element: LeRobot's prefix, demorec's suffix."""
_HAND = re.compile(
    "thumb|pinky|knuckle|proximal|index_|middle_|ring_|little_|palm|hand.*(?:joint|index|middle)", re.IGNORECASE
)
"""Joint names of a hand with fingers."""


@dataclass(frozen=True, kw_only=True, eq=False)
class EpisodeEvidence:
    """The numbers of one episode of T frames.

    Attributes:
        number: Its `episode_index`.
        instruction: Its task; several are joined.
        columns: Feature -> (T, D) as recorded.
        state: (T, D) elements of the state without gaps, quaternions without changes of sign; None without a state.
        action: (T, K) elements of the action, processed likewise; None without an action.
        time_s: (T,) measured timestamps of the frames; None if unknown.
        image_ages_s: Camera or feature -> (T,) age of each image or sample relative to its frame.
        drops: Losses while recording, in words.
    """

    number: int
    instruction: str
    columns: Mapping[str, NDArray[Any]]
    state: Array | None
    action: Array | None
    time_s: Array | None = None
    image_ages_s: Mapping[str, Array] = field(default_factory=dict)
    drops: str = ""

    @property
    def length(self) -> int:
        """Number of frames, T."""
        return len(next(iter(self.columns.values()), ()))

    @cached_property
    def speed(self) -> Array:
        """Compute the (T - 1,) speed of the state, each element in units of its usual step; zeros without a state."""
        if self.state is None or len(self.state) < 2:
            return np.zeros(max(self.length - 1, 0))
        steps = np.diff(self.state, axis=0)
        scale = np.sqrt((steps**2).mean(axis=0))
        return np.asarray(np.linalg.norm(steps[:, scale > 0] / scale[scale > 0], axis=1))


@dataclass(kw_only=True, eq=False)
class Evidence:
    """A set of episodes, read.

    Attributes:
        path: Path given by the user.
        fps: Frames per second.
        roles: Roles of its features.
        episodes: Readable episodes, in order.
        unreadable: Number of an episode -> reason why it cannot be read.
        folder: The open LeRobot dataset; None for recordings.
        cameras: Camera -> its images; empty if images are not examined.
        images_missing: Reason why images are not examined, "" if they are.
        urdf: Text of the robot's description, "" if unknown.
        robot_problem: Reason why the dataset's robot description cannot be read, "" if it can.
        arm_joints: Joint of the URDF for each element of the state, "" for others.
        opens_lerobot: Whether to open the dataset with the installed LeRobot too.
        names: Number of an episode -> its file, for recordings.
        earlier: The sets named before this one.
    """

    path: Path
    fps: float
    roles: Roles
    episodes: Sequence[EpisodeEvidence]
    unreadable: Mapping[int, str] = field(default_factory=dict)
    folder: LeRobotFolder | None = None
    cameras: Mapping[str, CameraThumbnails] = field(default_factory=dict)
    images_missing: str = ""
    urdf: str = ""
    robot_problem: str = ""
    arm_joints: tuple[str, ...] = ()
    opens_lerobot: bool = False
    names: Mapping[int, str] = field(default_factory=dict)
    earlier: Sequence[Evidence] = ()
    _derived: dict[tuple[object, ...], object] = field(default_factory=dict)

    def without_images(self) -> Evidence:
        """Return the same episodes without their images, to compare other sets with."""
        return Evidence(path=self.path, fps=self.fps, roles=self.roles, episodes=self.episodes)

    @cached_property
    def elements(self) -> tuple[str, ...]:
        """Names of the D elements of the state."""
        return self.roles.elements(self.roles.state)

    @cached_property
    def is_gripper(self) -> Flags:
        """Flags (D,) of the state's elements that are grippers or their fingers."""
        if not self.roles.state:
            return np.zeros(0, dtype=np.bool_)
        hands = np.array([_HAND.search(name) is not None for name in self.elements], dtype=np.bool_)
        return np.asarray(self.roles.grippers() | hands)

    @cached_property
    def is_position(self) -> Flags:
        """Flags (D,) of the state's elements that are positions, not velocities or forces."""
        return np.array([is_position(name) for name in self.elements], dtype=np.bool_)

    @cached_property
    def action_of(self) -> list[int | None]:
        """Index in the action of each element of the state, for "x" also "delta_x" or "x.delta"; None if missing."""
        if not (self.roles.state and self.roles.action):
            return [None] * len(self.elements)
        actions = enumerate(self.roles.elements(self.roles.action))
        increments = {_INCREMENT.sub("", name): place for place, name in actions if _INCREMENT.search(name)}
        matched = self.roles.in_state(self.roles.action)
        return [
            increments.get(joint_of(name)) if place is None else place
            for name, place in zip(self.elements, matched, strict=True)
        ]

    @cached_property
    def by_number(self) -> Mapping[int, EpisodeEvidence]:
        """Episode number -> its evidence."""
        return {episode.number: episode for episode in self.episodes}

    @cached_property
    def ranges(self) -> Array:
        """Usual range (D,) of each element of the state within an episode: the median over the episodes."""
        if not self.with_state():
            return np.zeros(0)
        spans = [np.ptp(state, axis=0) for _, state in self.with_state()]
        return np.asarray(np.median(spans, axis=0))

    def with_state(self, min_frames: int = 2) -> list[tuple[EpisodeEvidence, Array]]:
        """Return the episodes that have a state, with it."""
        return [
            (each, each.state) for each in self.episodes if each.state is not None and len(each.state) >= min_frames
        ]

    def need_state(self, min_frames: int = 2) -> list[tuple[EpisodeEvidence, Array]]:
        """Return `with_state`. Raises NotMeasuredError if it is empty."""
        if not self.roles.state:
            raise NotMeasuredError("no column is known to be the state (name it: --state COLUMN)")
        if not (found := self.with_state(min_frames)):
            raise NotMeasuredError(f"no readable episode has {min_frames} frames")
        return found

    def need_images(self) -> Mapping[str, CameraThumbnails]:
        """Return the cameras. Raises NotMeasuredError without cameras."""
        if self.images_missing:
            raise NotMeasuredError(self.images_missing)
        if not self.cameras:
            raise NotMeasuredError("cameras are missing")
        return self.cameras

    def once[T](self, derive: Callable[..., T], *arguments: object) -> T:
        """Return `derive(self, *arguments)`, computed at the first call; a NotMeasuredError is raised each time."""
        key = (derive, *map(id, arguments))
        if key not in self._derived:
            try:
                self._derived[key] = derive(self, *arguments)
            except NotMeasuredError as error:
                self._derived[key] = error
        found = self._derived[key]
        if isinstance(found, NotMeasuredError):
            raise NotMeasuredError(str(found))
        return cast("T", found)

    def seconds(self, frames: float) -> float:
        """Convert a number of frames to a duration."""
        return frames / self.fps


def joined(parts: Sequence[str], columns: Mapping[str, NDArray[Any]]) -> Array | None:
    """Concatenate features to (T, D), without gaps; None if the list is empty or one is missing."""
    if not parts or any(part not in columns for part in parts):
        return None
    values = np.hstack([columns[part].reshape(len(columns[part]), -1) for part in parts])
    return without_gaps(values) if len(values) else values.astype(np.float64)


def quaternion_places(names: Sequence[str]) -> list[int]:
    """Find the first of each four adjacent elements that are x, y, z and w of one rotation, in either order."""
    fours = [(start, names[start : start + 4]) for start in range(len(names) - 3)]
    return [
        start
        for start, four in fours
        if "".join(each[-1:] for each in four) in ("xyzw", "wxyz") and len({each[:-1] for each in four}) == 1
    ]


def continuous(values: Array | None, names: Sequence[str]) -> Array | None:
    """Make quaternions in (T, D) values keep their sign: both signs mean the same rotation."""
    if values is None or not len(values):
        return values
    for place in quaternion_places(names):
        values[:, place : place + 4] *= signs_of_course(values[:, place : place + 4])[:, None]
    return values
