"""An episode as playback sees it, whether it comes from a recording or from an exported dataset."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from demorec.core.geometry import Array, Pose
from demorec.episode.episode import Event, Outcome
from demorec.episode.info import EpisodeInfo, Feature
from demorec.episode.scene import Scene
from demorec.episode.simulated import scene_of
from demorec.robots.robot import RobotSpec

Distances = NDArray[np.uint16] | NDArray[np.float32]
"""(H, W) millimetres or metres."""
Depth = Callable[[], Iterator[tuple[int, Distances]]]
"""Reads the distances of a camera, each image with its time_ns."""
EFFORT_CURVES = "effort (N m)"
FORCE_CURVES = "contact_force (N)"
Box = tuple[float, float, float, float]
Statements = tuple[tuple[int, str, str], ...]
"""(time_ns, kind, sentence), each holds until the next one of its kind."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Curves:
    """Several numbers over time: one row per time, one column per name.

    Attributes:
        time_ns: (T,) since the episode's start.
        values: (T, n).
        names: n.
    """

    time_ns: NDArray[np.int64]
    values: Array
    names: tuple[str, ...]


@dataclass(frozen=True, kw_only=True, eq=False)
class Video:
    """Coded images of a camera.

    Attributes:
        codec: "h264", "h265", "av1" or "jpeg".
        packets: Reads them anew: (time_ns, an access unit of the codec or a whole JPEG file, whether it is a keyframe).
    """

    codec: str
    packets: Callable[[], Iterator[tuple[int, bytes, bool]]]


@dataclass(frozen=True, kw_only=True, eq=False)
class PlayedEpisode:
    """What is shown of an episode. What a source does not have is None or empty.

    The curves of a simulated one are "position" and "velocity" of the joints, "gripper" (m), "ee" (m) and those that
    `sensed_curves` names; "target" and "gripper target" are what was asked for. Those of any other are the elements of
    its features, by the features' names.

    Attributes:
        name: In the list of recordings.
        group: Run or dataset that it belongs to.
        identity: Distinguishes it from all others.
        source: Where it was read from, for people.
        info: What is known before the first frame.
        outcome: How it ended, None when nobody knows.
        time_ns: (T,) of the frames, since the first one.
        curves: Name -> measured values.
        roles: Curve that is a feature -> its role (`demorec.episode.roles`), where it has one.
        videos: Camera -> encoded images.
        depth: Camera -> reads (time_ns, distances) of each of its images.
        statements: What is said of it.
        robot_description: URDF; of a simulated robot primitives, for where the original model is not installed.
        joint_position: Joint of the URDF -> (T,) rad or m.
        body_description: URDF of the body of a name, None where the source has none.
        base_from_tcp: (T, 7), None where it is not known.
        object_poses: name -> (T, 7), world_from_object.
        end_poses: name -> (7,) where an object ended, for sources that may not know its way there.
        world_from_camera: name -> (T, 7).
        phase: T names, or none.
        events: (time_ns, event).
        segmentation: Camera -> reads (H, W) segment numbers of every frame.
        segment_names: Segment number -> name.
        boxes: Camera -> frame -> (name, (x, y, width, height) px) of what it sees.
    """

    name: str
    group: str
    identity: str
    source: str
    info: EpisodeInfo
    outcome: Outcome | None
    time_ns: NDArray[np.int64]
    curves: Mapping[str, Curves]
    videos: Mapping[str, Video]
    roles: Mapping[str, str] = field(default_factory=dict)
    depth: Mapping[str, Depth] = field(default_factory=dict)
    statements: Statements = ()
    robot_description: str | None = None
    joint_position: Mapping[str, Array] = field(default_factory=dict)
    body_description: Callable[[str], str | None] = lambda _: None
    base_from_tcp: Array | None = None
    object_poses: Mapping[str, Array] = field(default_factory=dict)
    end_poses: Mapping[str, Array] = field(default_factory=dict)
    world_from_camera: Mapping[str, Array] = field(default_factory=dict)
    phase: tuple[str, ...] = ()
    events: tuple[tuple[int, Event], ...] = ()
    segmentation: Mapping[str, Callable[[], Iterator[NDArray[np.int32]]]] = field(default_factory=dict)
    segment_names: Mapping[int, str] = field(default_factory=dict)
    boxes: Mapping[str, Mapping[int, Sequence[tuple[str, Box]]]] = field(default_factory=dict)

    @property
    def scene(self) -> Scene | None:
        """The world at the start, where it is known."""
        return scene_of(self.info)

    @property
    def world_from_base(self) -> Pose:
        """Where the robot stands; at the origin where nobody knows."""
        return Pose() if self.scene is None else self.scene.robot.world_from_base

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras that there are images of, or that the scene has."""
        placed = () if self.scene is None else (camera.name for camera in self.scene.cameras)
        return tuple(dict.fromkeys([*placed, *self.videos, *self.depth]))

    @property
    def num_frames(self) -> int:
        """Length."""
        return len(self.time_ns)

    @property
    def duration(self) -> float:
        """Seconds from the first frame to the end of the last, which lasts as long as the nominal rate says."""
        return float(self.time_ns[-1]) / 1e9 + 1 / self.info.fps if self.num_frames else 0.0

    @property
    def verdict(self) -> str:
        """The outcome in a word or two."""
        if self.outcome is None or self.outcome.success is None:
            return "outcome unknown"
        return "success" if self.outcome.success else f"failure: {self.outcome.failure_reason or 'no reason given'}"


def simulated_curves(
    robot: RobotSpec,
    time_ns: NDArray[np.int64],
    values: Mapping[str, NDArray[Any]],
    sensed: Sequence[Feature],
    *,
    joints: Mapping[str, Array],
    opening: Array,
    target: Array,
    base_from_tcp: Array,
) -> dict[str, Curves]:
    """The curves of a simulated episode.

    Args:
        robot: The robot.
        time_ns: (T,) of the frames.
        values: Feature -> (T, D).
        sensed: Features that have curves of their own.
        joints: Name of the curves -> (T, ...) of the arm's joints, and maybe of others behind them.
        opening, target: (T,) of the gripper: measured, and what was asked for, metres.
        base_from_tcp: (T, 7).
    """
    shown = [(name, values, robot.arm_joints) for name, values in joints.items()]
    for feature in sensed:
        shown += sensed_curves(feature, values[feature.name])
    shown.append(("gripper", opening[:, None], ("opening",)))
    shown.append(("gripper target", target[:, None], ("target",)))
    shown.append(("ee", base_from_tcp, ("x", "y", "z")))
    return {name: Curves(time_ns=time_ns, values=values[:, : len(names)], names=names) for name, values, names in shown}


def sensed_curves(feature: Feature, values: NDArray[Any]) -> Iterator[tuple[str, NDArray[Any], tuple[str, ...]]]:
    """Split a feature's values (T, D) by unit: name of the curves as "wrench (N)", values and names of elements."""
    for unit in dict.fromkeys(feature.units):
        columns = [number for number, other in enumerate(feature.units) if other == unit]
        names = tuple(feature.names[number] for number in columns)
        yield f"{feature.name.removeprefix('observation.')} ({unit})", values[:, columns], names


def timed[Image](time_ns: NDArray[np.int64], read: Callable[[], Iterator[Image]]) -> Iterator[tuple[int, Image]]:
    """Images with their times (P,), as far as there are any."""
    return zip(time_ns.tolist(), read(), strict=False)


def millimetres(read: Callable[[], Iterator[NDArray[np.float32]]]) -> Iterator[NDArray[np.uint16]]:
    """Distances in metres as whole millimetres, which take half the space."""
    for metres in read():
        yield np.rint(metres * 1000).clip(0, 65535).astype(np.uint16)
