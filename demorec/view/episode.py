"""An episode as playback sees it, whether it comes from a recording or from an exported dataset."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from demorec.core.geometry import Array
from demorec.episode.episode import Event, Outcome, SimulatedInfo
from demorec.episode.external import EpisodeInfo

Distances = NDArray[np.uint16] | NDArray[np.float32]
"""(H, W) millimetres or metres."""
Depth = Callable[[], Iterator[tuple[int, Distances]]]
"""Reads the distances of a camera, each picture with its time_ns."""
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
    """Coded pictures of a camera.

    Attributes:
        codec: "h264", "h265", "av1" or "jpeg".
        packets: Reads them anew: (time_ns, an access unit of the codec or a whole JPEG file, whether it is a keyframe).
    """

    codec: str
    packets: Callable[[], Iterator[tuple[int, bytes, bool]]]


@dataclass(frozen=True, kw_only=True, eq=False)
class _Shown:
    """What is shown of any episode. What a source does not have is None or empty.

    Attributes:
        name: In the list of recordings.
        group: Run or dataset that it belongs to.
        identity: Distinguishes it from all others.
        source: Where it was read from, for people.
        time_ns: (T,) of the frames, since the first one.
        curves: Name -> measured values.
        videos: Camera -> coded pictures.
        depth: Camera -> reads (time_ns, distances) of each of its pictures.
        statements: What is said of it: (time_ns, kind, sentence), each holds until the next one of its kind.
    """

    name: str
    group: str
    identity: str
    source: str
    time_ns: NDArray[np.int64]
    curves: Mapping[str, Curves]
    videos: Mapping[str, Video]
    depth: Mapping[str, Depth] = field(default_factory=dict)
    statements: Statements = ()

    @property
    def num_frames(self) -> int:
        """Length."""
        return len(self.time_ns)


@dataclass(frozen=True, kw_only=True, eq=False)
class PlayedExternal(_Shown):
    """What is shown of a collected episode; its curves are the elements of its features.

    Attributes:
        info: Instruction, features, cameras, origin.
        outcome: How it ended, None when nobody knows.
        joint_position: Joint of the URDF -> (T,) rad or m.
    """

    info: EpisodeInfo
    outcome: Outcome | None
    joint_position: Mapping[str, NDArray[np.float64]]

    @property
    def verdict(self) -> str:
        """The outcome in a word or two."""
        if self.outcome is None or self.outcome.success is None:
            return "outcome unknown"
        return "success" if self.outcome.success else f"failure: {self.outcome.failure_reason or 'no reason given'}"


@dataclass(frozen=True, kw_only=True, eq=False)
class PlayedEpisode(_Shown):
    """What is shown of a simulated episode; its distances are metres.

    Its curves are "position", "velocity", "effort" of the joints, "gripper" (m), "force" (N), "ee" (m), "hand force"
    (N) and "hand torque" (N m) along the hand's axes; "target" and "gripper target" are what was asked for.

    Attributes:
        info: Scene, robot, cameras, seed.
        outcome: How it ended, None when nobody knows.
        robot_description: URDF of primitives, for where the original model is not installed.
        body_description: The same of the body of a name, None where the source has none.
        joint_position: (T, n_joints) rad, fingers m.
        base_from_tcp: (T, 7).
        object_poses: name -> (T, 7), world_from_object.
        end_poses: name -> (7,) where an object ended, for sources that may not know its way there.
        world_from_camera: name -> (T, 7).
        phase: T names.
        events: (time_ns, event).
        segmentation: Camera -> reads (H, W) segment numbers of every frame.
        segment_names: Segment number -> name.
        boxes: Camera -> frame -> (name, (x, y, width, height) px) of what it sees.
    """

    info: SimulatedInfo
    outcome: Outcome | None
    robot_description: str | None
    body_description: Callable[[str], str | None] = lambda _: None
    joint_position: Array
    base_from_tcp: Array
    object_poses: Mapping[str, Array]
    end_poses: Mapping[str, Array] = field(default_factory=dict)
    world_from_camera: Mapping[str, Array]
    phase: tuple[str, ...]
    events: tuple[tuple[int, Event], ...] = ()
    segmentation: Mapping[str, Callable[[], Iterator[NDArray[np.int32]]]] = field(default_factory=dict)
    segment_names: Mapping[int, str] = field(default_factory=dict)
    boxes: Mapping[str, Mapping[int, Sequence[tuple[str, Box]]]] = field(default_factory=dict)

    @property
    def verdict(self) -> str:
        """The outcome in a word or two."""
        if self.outcome is None:
            return "outcome unknown"
        return "success" if self.outcome.success else f"failure: {self.outcome.failure_reason}"

    @property
    def duration(self) -> float:
        """Seconds from the first frame to the end of the last."""
        return self.num_frames / self.info.fps


def timed[Picture](time_ns: NDArray[np.int64], read: Callable[[], Iterator[Picture]]) -> Iterator[tuple[int, Picture]]:
    """Pictures with their times (P,), as far as there are any."""
    return zip(time_ns.tolist(), read(), strict=False)
