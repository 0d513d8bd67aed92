"""Data recorded at each control step, and about each episode.

The (observation, action) contract, everywhere: frame t contains the observation at time t, taken *before* action t is
applied. `action` is the expert's intended action (the label to learn from). `command` was sent to the motors (the
action plus any exploration noise), in float64 as sent: replaying the commands reproduces the episode bit-exactly.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from demorec.core.geometry import Array, Pose
from demorec.episode.info import EpisodeInfo

POLICY_PHASE = "policy"
"""Phase of frames controlled by a policy, or by another agent without phases; all others are the expert's."""
HALT_PHASE = "halt"
"""Phase in which an expert that has taken over only stops the arm. It must not be learned: it stops in states in which
a demonstration continues."""

TIME_LIMIT = "time_limit"
"""Failure reason of an episode that ran out of time."""

NO_IMAGE = -1
"""Image number of a frame without an image."""
MAX_STAMP_NS = 2**31 * 1_000_000_000 - 1
"""Maximum timestamp, ns: its seconds have 31 bits in ROS messages."""
MAX_SUBTASK = 1000
"""Maximum length of a subtask, characters."""

Vector = NDArray[np.float32] | NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class Observation:
    """All measurements at one instant."""

    joint_position: Array  # (n_joints,) in the order of `RobotSpec.joint_names`; rad, fingers m
    joint_velocity: Array  # (n_joints,) rad/s, fingers m/s
    joint_effort: Array  # (n_joints,) motor torque N m, fingers N
    gripper_width: float  # opening between the fingers, metres
    base_from_tcp: Pose  # TCP pose in the base frame
    object_poses: Mapping[str, Pose]  # name -> world_from_object, of every movable body of the scene
    contact_force: float  # sum of the normal forces on the fingers, N
    # Other sensors: quantity -> (D,), by the rows of `demorec.sim.sensors`.
    sensed: Mapping[str, Array] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True, eq=False)
class Action:
    """One command: absolute joint targets and gripper opening, reached by linear interpolation over the step."""

    joint_target: Array  # (n_arm,) rad
    gripper_target: float  # opening, metres
    base_from_tcp_target: Pose  # forward kinematics of `joint_target`, in the base frame


@dataclass(frozen=True, kw_only=True, eq=False)
class JointSample:
    """Joint states between two frames (recorded at the physics rate on request); shapes as in Observation."""

    time_ns: int
    joint_position: Array
    joint_velocity: Array
    joint_effort: Array


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraImages:
    """Images of one camera at one instant."""

    color: NDArray[np.uint8]  # (H, W, 3) uint8 RGB, row 0 on top
    # (H, W) float32 metres along the optical axis, 0 for the background; None unless requested.
    depth: NDArray[np.float32] | None = None
    # (H, W) int32, body index + ((link index + 1) << 24) as PyBullet numbers them, -1 for the background; None unless
    # requested.
    segmentation: NDArray[np.int32] | None = None
    world_from_camera: Pose  # OpenCV axes


@dataclass(frozen=True, kw_only=True)
class Event:
    """An event of the episode, for human readers: a grasp, a miss, a retry."""

    name: str
    message: str
    level: Literal["info", "warning", "error"] = "info"


@dataclass(frozen=True, kw_only=True, eq=False)
class Frame:
    """One control step."""

    frame_index: int  # t, from 0
    time_ns: int  # simulated time since the episode's start, computed from frame_index
    observation: Observation
    action: Action  # the expert's intended action at t
    command: Action  # command sent to the motors at t
    phase: str  # phase of the scripted motion ("approach", "lift", ...)
    events: tuple[Event, ...] = ()
    images: Mapping[str, CameraImages] = field(default_factory=dict)  # camera name -> images at t
    # Joint states since the previous frame, both ends excluded; empty unless requested.
    joint_samples: tuple[JointSample, ...] = ()
    is_deliberate_miss: bool = False  # whether this frame belongs to a deliberate miss, which no policy can predict


@dataclass(frozen=True, kw_only=True)
class SuccessCheck:
    """One success condition."""

    name: str  # measured quantity ("distance_to_goal")
    value: float  # measured value, in `unit`
    limit: float  # allowed value; `passed` implies on which side
    unit: str  # "m", "rad", "m/s", "N" or ""
    passed: bool


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """Result of an episode."""

    success: bool | None = None  # whether it succeeded; for a simulated one whether every check passed; None if unknown
    checks: tuple[SuccessCheck, ...] = ()  # the task's conditions, with the measured values
    failure_phase: str = ""  # phase of the failure, "" on success and if unknown
    # Name of the first failed check, reason of the expert's failure, or a reason in words; "" on success and if
    # unknown.
    failure_reason: str = ""
    num_frames: int
    num_retries: int = 0  # number of repeated attempts of the expert within the episode
    # SHA-256 (hex) over positions and velocities of all joints and movable bodies at the end, "" if unknown.
    final_state_digest: str = ""
    # "frames", or a camera's name -> number of dropped ones; missing names lost none.
    drops: Mapping[str, int] = field(default_factory=dict)


def gave_up(outcome: Outcome, events: Sequence[Event], info: EpisodeInfo) -> bool:
    """Check whether a recording explains a failure by an event of its name, or by the time limit."""
    limit = info.simulated.config.get("max_episode_seconds")
    is_over = isinstance(limit, int | float) and outcome.num_frames + 1 > limit * info.fps
    return (outcome.failure_reason == TIME_LIMIT and is_over) or any(
        event.name == outcome.failure_reason and event.level != "info" for event in events
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class Sample:
    """A received vector."""

    stamp_ns: int  # timestamp by the clock of its stream
    vector: Vector  # (D,) of the feature's dtype


@dataclass(frozen=True, kw_only=True, eq=False)
class SampledFrame:
    """One control step."""

    # Its timestamp; frames are in order, at any intervals. Its data is `time_ns - stamp_ns` old.
    time_ns: int
    samples: Mapping[str, Sample]  # feature -> its sample; contains every feature
    # Camera -> number of its image, counted from 0 in each camera. Several frames, or none, may refer to an image; a
    # missing camera has no image at this frame.
    images: Mapping[str, int] = field(default_factory=dict)
    subtask: str = ""  # subtask that begins at this frame, in the source's words; "" if it does not change


@dataclass(frozen=True, kw_only=True, eq=False)
class TimedRows:
    """Rows of T frames."""

    time_ns: NDArray[np.int64]  # (T,) timestamps of the frames

    @property
    def num_frames(self) -> int:
        """Number of frames, T."""
        return len(self.time_ns)


@dataclass(frozen=True, kw_only=True, eq=False)
class Table(TimedRows):
    """Numbers of an episode of T frames, and the images that the frames show."""

    features: Mapping[str, NDArray[Any]]  # feature -> (T, D) in its own dtype
    stamps: Mapping[str, NDArray[np.int64]]  # feature -> (T,) timestamps of the samples
    images: Mapping[str, NDArray[np.int64]]  # camera -> (T,) image number of each frame, `NO_IMAGE` if none
    image_stamps: Mapping[str, NDArray[np.int64]]  # camera -> (P,) timestamps of its images

    def age_ns(self, feature: str) -> NDArray[np.int64]:
        """Compute (T,) age of each frame's sample of a feature."""
        return self.time_ns - self.stamps[feature]

    def image_age_ns(self, camera: str) -> NDArray[np.int64]:
        """Compute (N,) image age for the N frames that have an image of this camera."""
        numbers = self.images[camera]
        frames = np.flatnonzero(numbers != NO_IMAGE)
        ages: NDArray[np.int64] = self.time_ns[frames] - self.image_stamps[camera][numbers[frames]]
        return ages


@dataclass(frozen=True, kw_only=True, eq=False)
class Observations:
    """Numbers of T observations, measured now or recorded; shapes and units of a row as in `Observation`.

    A pose is (7,): position, then quaternion xyzw.
    """

    joint_position: Array  # (T, n_joints)
    joint_velocity: Array  # (T, n_joints)
    joint_effort: Array  # (T, n_joints)
    gripper_width: Array  # (T,)
    base_from_tcp: Array  # (T, 7)
    object_poses: Mapping[str, Array]  # name -> (T, 7), world_from_object
    contact_force: Array  # (T,)
    sensed: Mapping[str, Array]  # quantity -> (T, D)

    @classmethod
    def of(cls, observation: Observation) -> Observations:
        """Take one observation, as T = 1."""
        return cls(
            joint_position=observation.joint_position[np.newaxis],
            joint_velocity=observation.joint_velocity[np.newaxis],
            joint_effort=observation.joint_effort[np.newaxis],
            gripper_width=np.array([observation.gripper_width]),
            base_from_tcp=observation.base_from_tcp.vector()[np.newaxis],
            object_poses={name: pose.vector()[np.newaxis] for name, pose in observation.object_poses.items()},
            contact_force=np.array([observation.contact_force]),
            sensed={name: values[np.newaxis] for name, values in observation.sensed.items()},
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Trajectory(Observations, TimedRows):
    """All simulated data of an episode of T frames, exactly as computed; rows of actions as in `Action`.

    Digests follow the order of the fields: times, observations, actions.
    """

    action_joint_target: Array  # (T, n_arm)
    action_gripper: Array  # (T,)
    action_base_from_tcp: Array  # (T, 7)
    command_joint_target: Array  # (T, n_arm)
    command_gripper: Array  # (T,)
    command_base_from_tcp: Array  # (T, 7)
    phase: tuple[str, ...]  # T
    is_deliberate_miss: NDArray[np.bool_]  # (T,)
    world_from_camera: Mapping[str, Array]  # name -> (T, 7)


def frame_time_ns(frame_index: int, fps: int) -> int:
    """Compute nanoseconds of a frame since the episode's start: exact integer arithmetic, rounded half up."""
    return (frame_index * 2_000_000_000 + fps) // (2 * fps)


def interventions(phases: Sequence[str]) -> NDArray[np.bool_]:
    """Find (T,) frames in which an expert that took over from a policy acts, excluding the stop of the arm.

    False in all frames of a demonstration without a takeover.
    """
    acts = np.array([phase not in (POLICY_PHASE, HALT_PHASE) for phase in phases], dtype=np.bool_)
    return acts & (POLICY_PHASE in phases)


def consecutive_runs(names: Sequence[str]) -> Iterator[tuple[str, int, int]]:
    """Yield name, first index and index after the last, for each run of equal names."""
    first = 0
    for name, group in groupby(names):
        end = first + sum(1 for _ in group)
        yield name, first, end
        first = end
