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
    """Messages of a simulated sensor, one per frame.

    Attributes:
        topic: Topic of the messages.
        layout: "wrench" for three forces and three torques (geometry_msgs/WrenchStamped), "array" for any vector
            (std_msgs/Float64MultiArray).
        frame: Link in whose axes the vectors of a wrench are given.
    """

    topic: str
    layout: Literal["wrench", "array"] = "array"
    frame: str = ""


@dataclass(frozen=True, kw_only=True)
class Feature:
    """A vector present in every frame.

    Attributes:
        name: Name in datasets: "observation.state", "action", "observation.force".
        dtype: Type of its numbers, as recorded.
        names: Names of its D elements.
        units: Units of its elements ("rad", "deg", "m"), or empty if unknown.
        joints: For each element the URDF joint that it measures ("" for none); empty without joints. Positions are
            in rad and m, or in degrees if the unit is "deg", unless there is a calibration.
        source: Its origin, in words: "/joint_states position, latest before, header stamps".
        calibration: For each element a factor and an offset, for servos with other units: factor times the value plus
            offset is rad or m; empty if the unit suffices.
        role: Role that its name does not imply; "" if its common name does (`demorec.episode.roles`).
        stream: Messages of a simulated sensor; None for any other feature.
    """

    name: str
    dtype: Literal["float32", "float64"] = "float64"
    names: tuple[str, ...]
    units: tuple[str, ...] = ()
    joints: tuple[str, ...] = ()
    source: str = ""
    calibration: tuple[tuple[float, float], ...] = ()
    role: Literal["", "state", "action", "gripper"] = ""
    stream: SensorStream | None = None

    def in_si(self, values: NDArray[Any]) -> Array:
        """Convert values (..., D) to float64 (..., D): positions to rad and m, other values unchanged."""
        degree = (math.radians(1.0), 0.0)
        units = self.units or ("",) * len(self.names)
        scale = self.calibration or [degree if unit in ("deg", "degree") else (1.0, 0.0) for unit in units]
        factor, offset = np.array(scale).T
        return np.asarray(values.astype(np.float64) * factor + offset)


leave_out_default(Feature, "role", "stream")

_OBSERVATION = "observation."


def sensor_feature(quantity: str) -> str:
    """Return the feature of a sensed quantity: "observation.wrench" for "wrench"."""
    return _OBSERVATION + quantity


@dataclass(frozen=True, kw_only=True)
class Camera:
    """A camera; unknown parts are absent.

    Attributes:
        name: Unique; also its topic.
        width, height: Pixels.
        kept: Codec of passthrough images; "" for pixels, which the recorder encodes. For a depth camera ROS's name of
            its bit-exact distances: "16UC1" (whole millimetres, 0 where nothing was measured) or "32FC1" (metres, 0 or
            not finite where nothing was measured).
        intrinsics: K row by row, 9 numbers in pixels; None if unknown.
        distortion: Plumb bob coefficients (k1, k2, p1, p2, k3); empty for none.
        mount: The URDF link that carries it, "world" for a fixed camera of a scene; "" if unknown.
        mount_from_camera: Pose in the frame of that link, OpenCV axes; None if unknown.
        source: Origin of its images, in words.
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

    The name has no folders; for files of a dataset it is the path within the dataset.
    """

    name: str
    sha256: str


@dataclass(frozen=True, kw_only=True)
class Origin:
    """The origin of an external episode.

    Attributes:
        kind: The `Recorder` in a user's program, `demorec import`, or a dataset that is read directly.
        files: Imported files.
        mapping_digest: Digest of the mapping used by the import.
    """

    kind: Literal["recorder", "import", "dataset"] = "recorder"
    files: tuple[SourceFile, ...] = ()
    mapping_digest: str = ""


@dataclass(frozen=True, kw_only=True)
class Simulation:
    """The part of a description that only simulated episodes have.

    Attributes:
        root_seed: Root seed of the run.
        task: Name of the task (or "package.module:Name").
        robot: The arm.
        scene: Scene at the start, including cameras with intrinsics and mounts.
        physics_hz: Steps per second.
        cpu: Type of the CPU that simulated it (`demorec.core.config.cpu_type`).
        behaviour: Name -> value of all other random draws of this episode (speed, approach height,
            noise level), for the card and for analysis.
        config: The resolved GenerateConfig as plain JSON data.
        config_digest: SHA-256 of it, 16 hex digits.
    """

    root_seed: int
    task: str
    robot: RobotSpec
    scene: Scene
    physics_hz: int
    cpu: str = ""
    behaviour: Mapping[str, float] = field(default_factory=dict)
    config: Mapping[str, Any] = field(default_factory=dict)
    config_digest: str = ""


@dataclass(frozen=True, kw_only=True)
class EpisodeInfo:
    """The description of an episode, recorded as metadata. Holds no clock, host name or path.

    Attributes:
        episode_index: Index of the episode in the run.
        attempt: Number of the attempt.
        instruction: The task in words; LeRobot's task text.
        robot_name: Name of the robot.
        urdf: Its description as text, "" if unknown; that of a simulated robot is in the scene's models.
        fps: Nominal frames per second; the timestamps of the frames are exact.
        features: Vectors that every frame has.
        cameras: None to many.
        origin: Origin of the episode; for a simulated one "" if generated, "replay of DIGEST" or "render of DIGEST" if
            derived.
        versions: package -> version of the packages that wrote it; for a simulated one those that determine the bits
            (demorec, pybullet, numpy, numba, av), and digests of the user's modules.
        simulation: Scene, seed, task; None for an episode that demorec did not simulate.
    """

    episode_index: int
    attempt: int = 0
    instruction: str
    robot_name: str = ""
    urdf: str = ""
    fps: int
    features: tuple[Feature, ...] = ()
    cameras: tuple[Camera, ...] = ()
    origin: str | Origin = ""
    versions: Mapping[str, str] = field(default_factory=dict)
    simulation: Simulation | None = None

    @property
    def sensors(self) -> Mapping[str, Feature]:
        """Sensed quantity, as in `Observation.sensed` -> its feature."""
        return {f.name.removeprefix(_OBSERVATION): f for f in self.features if f.stream is not None}

    @property
    def simulated(self) -> Simulation:
        """The simulation of the episode, for code that requires one.

        Raises:
            RecordingError: demorec did not simulate this episode.
        """
        if self.simulation is None:
            raise RecordingError(NOT_SIMULATED)
        return self.simulation
