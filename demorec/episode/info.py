"""The description of an episode before its first frame; unknown parts are absent.

A simulated episode also has a `Simulation`: a scene, a seed, the robot's model. Any other has vectors and images, each
with the timestamp of its clock.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from demorec.core.errors import RecordingError
from demorec.core.geometry import Array, Pose
from demorec.core.plain import leave_out_default
from demorec.episode.scene import Scene
from demorec.robots.robot import RobotSpec

FORMAT_VERSION = 3
"""Format version of recordings, the only one that is read; versions 1 and 2 were never released."""

NOT_SIMULATED = (
    "This needs the scene of an episode that demorec simulated; this one was recorded by another robot or program"
)

Kept = Literal["", "h264", "h265", "av1", "jpeg", "16UC1", "32FC1"]
DEPTH_UNITS: Mapping[str, float] = {"16UC1": 1000.0, "32FC1": 1.0}
"""Encoding of distances -> its units per metre."""


@dataclass(frozen=True, kw_only=True)
class SensorStream:
    """Messages of a simulated sensor, one per frame."""

    topic: str
    # "wrench" for three forces and three torques (geometry_msgs/WrenchStamped), "array" for any vector
    # (std_msgs/Float64MultiArray).
    layout: Literal["wrench", "array"] = "array"
    frame: str = ""  # link in whose axes the vectors of a wrench are given


@dataclass(frozen=True, kw_only=True)
class Feature:
    """A vector present in every frame."""

    name: str  # name in datasets: "observation.state", "action", "observation.force"
    dtype: Literal["float32", "float64"] = "float64"  # type of its numbers, as recorded
    names: tuple[str, ...]  # names of its D elements
    units: tuple[str, ...] = ()  # units of its elements ("rad", "deg", "m"), or empty if unknown
    # For each element the URDF joint that it measures ("" for none); empty without joints. Positions are in rad and m,
    # or in degrees if the unit is "deg", unless there is a calibration.
    joints: tuple[str, ...] = ()
    source: str = ""  # its origin, in words: "/joint_states position, latest before, header stamps"
    # For each element a factor and an offset, for servos with other units: factor times the value plus offset is rad or
    # m; empty if the unit suffices.
    calibration: tuple[tuple[float, float], ...] = ()
    # Role that its name does not imply; "" if its common name does (`demorec.episode.roles`).
    role: Literal["", "state", "action", "gripper"] = ""
    stream: SensorStream | None = None  # messages of a simulated sensor; None for any other feature

    def in_si(self, values: NDArray[Any]) -> Array:
        """Convert values (..., D) to float64 (..., D): positions to rad and m, other values unchanged."""
        degree = (math.radians(1.0), 0.0)
        units = self.units or ("",) * len(self.names)
        scale = self.calibration or [degree if unit in ("deg", "degree") else (1.0, 0.0) for unit in units]
        factor, offset = np.array(scale).T
        return np.asarray(values.astype(np.float64) * factor + offset)


leave_out_default(Feature, "role", "stream")

OBSERVATION = "observation."
"""Prefix of a sensed quantity's feature: "observation.wrench" for "wrench"."""


@dataclass(frozen=True, kw_only=True)
class Camera:
    """A camera; unknown parts are absent."""

    name: str  # unique; also its topic
    # width, height: pixels.
    width: int
    height: int
    # Codec of passthrough images; "" for pixels, which the recorder encodes. For a depth camera ROS's name of its bit-
    # exact distances: "16UC1" (whole millimetres, 0 where nothing was measured) or "32FC1" (metres, 0 or not finite
    # where nothing was measured).
    kept: Kept = ""
    intrinsics: tuple[float, ...] | None = None  # K row by row, 9 numbers in pixels; None if unknown
    distortion: tuple[float, ...] = ()  # plumb bob coefficients (k1, k2, p1, p2, k3); empty for none
    mount: str = ""  # the URDF link that carries it, "world" for a fixed camera of a scene; "" if unknown
    mount_from_camera: Pose | None = None  # pose in the frame of that link, OpenCV axes; None if unknown
    source: str = ""  # origin of its images, in words

    @property
    def is_depth(self) -> bool:
        """Whether its images are distances."""
        return self.kept in DEPTH_UNITS


@dataclass(frozen=True, kw_only=True)
class SourceFile:
    """A file that an episode was read from: its name, and the SHA-256 (hex) of its bytes.

    The name has no folders; for files of a dataset it is the path within the dataset.
    """

    name: str
    sha256: str


@dataclass(frozen=True, kw_only=True)
class Origin:
    """The origin of an external episode."""

    # The `Recorder` in a user's program, `demorec import`, or a dataset that is read directly.
    kind: Literal["recorder", "import", "dataset"] = "recorder"
    files: tuple[SourceFile, ...] = ()
    mapping_digest: str = ""  # digest of the mapping used by the import


@dataclass(frozen=True, kw_only=True)
class Simulation:
    """The part of a description that only simulated episodes have."""

    root_seed: int
    task: str  # name of the task (or "package.module:Name")
    robot: RobotSpec
    scene: Scene  # scene at the start, including cameras with intrinsics and mounts
    physics_hz: int  # steps per second
    cpu: str = ""  # type of the CPU that simulated it (`demorec.core.config.cpu_type`)
    # Name -> value of all other random draws of this episode (speed, approach height, noise level), for the card and
    # for analysis.
    behaviour: Mapping[str, float] = field(default_factory=dict)
    config: Mapping[str, Any] = field(default_factory=dict)  # the resolved GenerateConfig as plain JSON data
    config_digest: str = ""  # SHA-256 of it, 16 hex digits


@dataclass(frozen=True, kw_only=True)
class EpisodeInfo:
    """The description of an episode, recorded as metadata. Holds no clock, host name or path."""

    episode_index: int
    attempt: int = 0
    instruction: str  # the task in words; LeRobot's task text
    robot_name: str = ""
    urdf: str = ""  # its description as text, "" if unknown; that of a simulated robot is in the scene's models
    fps: int  # nominal frames per second; the timestamps of the frames are exact
    features: tuple[Feature, ...] = ()
    cameras: tuple[Camera, ...] = ()
    # Origin of the episode; for a simulated one "" if generated, "replay of DIGEST" or "render of DIGEST" if derived.
    origin: str | Origin = ""
    # package -> version of the packages that wrote it; for a simulated one those that determine the bits (demorec,
    # pybullet, numpy, numba, av), and digests of the user's modules.
    versions: Mapping[str, str] = field(default_factory=dict)
    simulation: Simulation | None = None  # scene, seed, task; None for an episode that demorec did not simulate

    @property
    def sensors(self) -> Mapping[str, Feature]:
        """Sensed quantity, as in `Observation.sensed` -> its feature."""
        return {f.name.removeprefix(OBSERVATION): f for f in self.features if f.stream is not None}

    @property
    def simulated(self) -> Simulation:
        """The simulation of the episode, for code that requires one; RecordingError for any other episode."""
        if self.simulation is None:
            raise RecordingError(NOT_SIMULATED)
        return self.simulation
