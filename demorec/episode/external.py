"""External episodes: demonstrations that somebody else's robot, simulator or program made.

Nothing is known of them but what came: vectors and images, each with the stamp of its own clock. There is no scene,
no seed, no gripper and no phase, and time may be uneven. Every frame says which sample of each stream it holds and how
old that is; what was not there is absent, never invented.

An episode that demorec simulates is described by `demorec.episode.episode`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from demorec.core.geometry import Pose

EXTERNAL_VERSION = 1
"""Of the recordings of external episodes. A reader knows every version up to this one."""

NO_PICTURE = -1
"""Stands for the number of an image where a frame has none."""

Kept = Literal["", "h264", "h265", "av1", "jpeg", "16UC1", "32FC1"]
DEPTH_UNITS: Mapping[str, float] = {"16UC1": 1000.0, "32FC1": 1.0}
"""Encoding of distances -> how many of its units a metre has."""
Vector = NDArray[np.float32] | NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Feature:
    """A vector that every frame has.

    Attributes:
        name: As datasets call it: "observation.state", "action", "observation.force".
        dtype: Of its numbers, kept as it came.
        names: Of its elements; there are D.
        units: Of its elements ("rad", "deg", "m"), or none where they are unknown.
        joints: For each element the joint of the URDF of which it is the position ("" for none); empty where none is.
            Positions are in rad and m, or in degrees where the unit is "deg".
        source: Where it came from, in words: "/joint_states position, latest before, header stamps".
    """

    name: str
    dtype: Literal["float32", "float64"] = "float64"
    names: tuple[str, ...]
    units: tuple[str, ...] = ()
    joints: tuple[str, ...] = ()
    source: str = ""


@dataclass(frozen=True, kw_only=True)
class Camera:
    """A camera, as far as it is known.

    Attributes:
        name: Unique; also its topic.
        width, height: Pixels.
        kept: The codec of its images where they come encoded and stay as they are; "" where they come as pixels, which
            the recorder codes. Of a depth camera ROS's name for its distances, whose every bit stays: "16UC1" (whole
            millimetres, 0 where nothing was measured) or "32FC1" (metres, 0 or not finite where nothing was).
        intrinsics: K row by row, 9 numbers in pixels; None when unknown.
        distortion: Of the plumb bob model (k1, k2, p1, p2, k3); empty for none.
        mount: The link of the URDF that carries it; "" when unknown.
        mount_from_camera: Pose in the frame of that link, OpenCV axes; None when unknown.
        source: Where its images came from, in words.
    """

    name: str
    width: int
    height: int
    kept: Kept = ""
    intrinsics: tuple[float, ...] | None = None
    distortion: tuple[float, ...] = ()
    mount: str = ""
    mount_from_camera: Pose | None = None
    source: str = ""

    @property
    def is_depth(self) -> bool:
        """Whether its images are distances."""
        return self.kept in DEPTH_UNITS


@dataclass(frozen=True, kw_only=True)
class SourceFile:
    """A file that an episode was read from: its name, and the SHA-256 (hex) of its bytes.

    The name is without folders, but for the files of a dataset: their places in there.
    """

    name: str
    sha256: str


@dataclass(frozen=True, kw_only=True)
class Origin:
    """How an external episode came here.

    Attributes:
        kind: By the `Recorder` in somebody's program, by `demorec import`, or read in place from a dataset.
        files: What was imported.
        mapping_digest: Of the mapping by which it was imported.
    """

    kind: Literal["recorder", "import", "dataset"] = "recorder"
    files: tuple[SourceFile, ...] = ()
    mapping_digest: str = ""


@dataclass(frozen=True, kw_only=True)
class EpisodeInfo:
    """What is known before the first frame; recorded as metadata. Holds no clock, host name or path.

    Attributes:
        format_version: Of the recording.
        episode_index: Which episode of the run.
        instruction: What the robot is asked to do, in words; LeRobot's task text.
        robot: Its name.
        urdf: Its description as text, "" when unknown.
        fps: Nominal frames per second; the frames' own stamps say what they were.
        features: At least one.
        cameras: None to many.
        origin: How the episode came here.
        versions: package -> version, of what wrote it.
        scene: Nothing is known of it.
        attempt: The only one.
    """

    scene: ClassVar[None] = None
    attempt: ClassVar[int] = 0

    format_version: int = EXTERNAL_VERSION
    episode_index: int
    instruction: str
    robot: str
    urdf: str = ""
    fps: int
    features: tuple[Feature, ...]
    cameras: tuple[Camera, ...] = ()
    origin: Origin = field(default_factory=Origin)
    versions: Mapping[str, str] = field(default_factory=dict)

    @property
    def robot_name(self) -> str:
        """What the robot is called."""
        return self.robot


@dataclass(frozen=True, kw_only=True, eq=False)
class Sample:
    """A vector as it came.

    Attributes:
        stamp_ns: Of the clock of its stream.
        vector: (D,) of the feature's dtype.
    """

    stamp_ns: int
    vector: Vector


@dataclass(frozen=True, kw_only=True, eq=False)
class SampledFrame:
    """One control step.

    Attributes:
        time_ns: Its stamp; frames come in order, at whatever distances. What it holds is `time_ns - stamp_ns` old.
        samples: Feature -> what it holds; every feature.
        pictures: Camera -> number of the image that it holds, counted from 0 in each camera. One image may be held
            by several frames, or by none; a camera that is left out has no image at this frame.
        subtask: What the robot begins to do with this frame, in the words of whoever said it; "" where nothing new was
            said.
    """

    time_ns: int
    samples: Mapping[str, Sample]
    pictures: Mapping[str, int] = field(default_factory=dict)
    subtask: str = ""


@dataclass(frozen=True, kw_only=True, eq=False)
class Columns:
    """All numbers of an external episode, one row a frame (T rows); the images are read on their own.

    Attributes:
        time_ns: (T,) stamps of the frames.
        features: Feature -> (T, D) in its own dtype.
        stamps: Feature -> (T,) stamps of the samples.
        pictures: Camera -> (T,) number of the image that a frame holds, NO_PICTURE for none.
        picture_stamps: Camera -> (P,) stamps of its images.
    """

    time_ns: NDArray[np.int64]
    features: Mapping[str, NDArray[Any]]
    stamps: Mapping[str, NDArray[np.int64]]
    pictures: Mapping[str, NDArray[np.int64]]
    picture_stamps: Mapping[str, NDArray[np.int64]]

    @property
    def num_frames(self) -> int:
        """T."""
        return len(self.time_ns)

    def age_ns(self, feature: str) -> NDArray[np.int64]:
        """(T,) how old each frame's sample of a feature is."""
        return self.time_ns - self.stamps[feature]

    def picture_age_ns(self, camera: str) -> NDArray[np.int64]:
        """(N,) how old the images are, of the N frames that hold one of this camera."""
        numbers = self.pictures[camera]
        held = np.flatnonzero(numbers != NO_PICTURE)
        ages: NDArray[np.int64] = self.time_ns[held] - self.picture_stamps[camera][numbers[held]]
        return ages
