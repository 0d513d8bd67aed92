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

Vector = NDArray[np.float32] | NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class Observation:
    """All measurements at one instant.

    Attributes:
        joint_position: (n_joints,) in the order of `RobotSpec.joint_names`; rad, fingers m.
        joint_velocity: (n_joints,) rad/s, fingers m/s.
        joint_effort: (n_joints,) motor torque N m, fingers N.
        gripper_width: Opening between the fingers, metres.
        base_from_tcp: TCP pose in the base frame.
        object_poses: name -> world_from_object, of every movable body of the scene.
        contact_force: Sum of the normal forces on the fingers, N.
        sensed: Other sensors: quantity -> (D,), by the rows of `demorec.sim.sensors`.
    """

    joint_position: Array
    joint_velocity: Array
    joint_effort: Array
    gripper_width: float
    base_from_tcp: Pose
    object_poses: Mapping[str, Pose]
    contact_force: float
    sensed: Mapping[str, Array] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True, eq=False)
class Action:
    """One command: absolute joint targets and gripper opening, reached by linear interpolation over the step.

    Attributes:
        joint_target: (n_arm,) rad.
        gripper_target: Opening, metres.
        base_from_tcp_target: Forward kinematics of `joint_target`, in the base frame.
    """

    joint_target: Array
    gripper_target: float
    base_from_tcp_target: Pose


@dataclass(frozen=True, kw_only=True, eq=False)
class JointSample:
    """Joint states between two frames (recorded at the physics rate on request); shapes as in Observation."""

    time_ns: int
    joint_position: Array
    joint_velocity: Array
    joint_effort: Array


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraImages:
    """Images of one camera at one instant.

    Attributes:
        color: (H, W, 3) uint8 RGB, row 0 on top.
        depth: (H, W) float32 metres along the optical axis, 0 for the background; None unless requested.
        segmentation: (H, W) int32, body index + ((link index + 1) << 24) as PyBullet numbers them, -1 for the
            background; None unless requested.
        world_from_camera: Pose, OpenCV axes.
    """

    color: NDArray[np.uint8]
    depth: NDArray[np.float32] | None = None
    segmentation: NDArray[np.int32] | None = None
    world_from_camera: Pose


@dataclass(frozen=True, kw_only=True)
class Event:
    """An event of the episode, for human readers: a grasp, a miss, a retry."""

    name: str
    message: str
    level: Literal["info", "warning", "error"] = "info"


@dataclass(frozen=True, kw_only=True, eq=False)
class Frame:
    """One control step.

    Attributes:
        frame_index: t, from 0.
        time_ns: Simulated time since the episode's start, computed from frame_index.
        observation: Observation at t.
        action: The expert's intended action at t.
        command: Command sent to the motors at t.
        phase: Phase of the scripted motion ("approach", "lift", ...).
        events: Events at t.
        images: Camera name -> images at t.
        joint_samples: Joint states since the previous frame, both ends excluded; empty unless requested.
        is_deliberate_miss: Whether this frame belongs to a deliberate miss, which no policy can predict.
    """

    frame_index: int
    time_ns: int
    observation: Observation
    action: Action
    command: Action
    phase: str
    events: tuple[Event, ...] = ()
    images: Mapping[str, CameraImages] = field(default_factory=dict)
    joint_samples: tuple[JointSample, ...] = ()
    is_deliberate_miss: bool = False


@dataclass(frozen=True, kw_only=True)
class SuccessCheck:
    """One success condition.

    Attributes:
        name: Measured quantity ("distance_to_goal").
        value: Measured value, in `unit`.
        limit: Allowed value; `passed` implies on which side.
        unit: "m", "rad", "m/s", "N" or "".
        passed: Whether the condition holds.
    """

    name: str
    value: float
    limit: float
    unit: str
    passed: bool


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """Result of an episode.

    Attributes:
        success: Whether it succeeded; for a simulated one whether every check passed; None if unknown.
        checks: The task's conditions, with the measured values.
        failure_phase: Phase of the failure, "" on success and if unknown.
        failure_reason: Name of the first failed check, reason of the expert's failure, or a reason in words; "" on
            success and if unknown.
        num_frames: Number of frames.
        num_retries: Number of repeated attempts of the expert within the episode.
        final_state_digest: SHA-256 (hex) over positions and velocities of all joints and movable bodies at the end, ""
            if unknown.
        drops: "frames", or a camera's name -> number of dropped ones; missing names lost none.
    """

    success: bool | None = None
    checks: tuple[SuccessCheck, ...] = ()
    failure_phase: str = ""
    failure_reason: str = ""
    num_frames: int
    num_retries: int = 0
    final_state_digest: str = ""
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
    """A received vector.

    Attributes:
        stamp_ns: Timestamp by the clock of its stream.
        vector: (D,) of the feature's dtype.
    """

    stamp_ns: int
    vector: Vector


@dataclass(frozen=True, kw_only=True, eq=False)
class SampledFrame:
    """One control step.

    Attributes:
        time_ns: Its timestamp; frames are in order, at any intervals. Its data is `time_ns - stamp_ns` old.
        samples: Feature -> its sample; contains every feature.
        images: Camera -> number of its image, counted from 0 in each camera. Several frames, or none, may refer to an
            image; a missing camera has no image at this frame.
        subtask: Subtask that begins at this frame, in the source's words; "" if it does not change.
    """

    time_ns: int
    samples: Mapping[str, Sample]
    images: Mapping[str, int] = field(default_factory=dict)
    subtask: str = ""


@dataclass(frozen=True, kw_only=True, eq=False)
class Table:
    """Numbers of an episode of T frames, and the images that the frames show.

    Attributes:
        time_ns: (T,) timestamps of the frames.
        features: Feature -> (T, D) in its own dtype.
        stamps: Feature -> (T,) timestamps of the samples.
        images: Camera -> (T,) image number of each frame, `NO_IMAGE` if none.
        image_stamps: Camera -> (P,) timestamps of its images.
    """

    time_ns: NDArray[np.int64]
    features: Mapping[str, NDArray[Any]]
    stamps: Mapping[str, NDArray[np.int64]]
    images: Mapping[str, NDArray[np.int64]]
    image_stamps: Mapping[str, NDArray[np.int64]]

    @property
    def num_frames(self) -> int:
        """Number of frames, T."""
        return len(self.time_ns)

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
class Trajectory:
    """All simulated data of an episode of T frames, exactly as computed.

    Shapes and units of a row are as in `Observation` and `Action`. A pose is (7,): position, then quaternion xyzw.
    """

    time_ns: NDArray[np.int64]  # (T,)
    joint_position: Array  # (T, n_joints)
    joint_velocity: Array  # (T, n_joints)
    joint_effort: Array  # (T, n_joints)
    gripper_width: Array  # (T,)
    base_from_tcp: Array  # (T, 7)
    object_poses: Mapping[str, Array]  # name -> (T, 7), world_from_object
    contact_force: Array  # (T,)
    sensed: Mapping[str, Array]  # quantity -> (T, D)
    action_joint_target: Array  # (T, n_arm)
    action_gripper: Array  # (T,)
    action_base_from_tcp: Array  # (T, 7)
    command_joint_target: Array  # (T, n_arm)
    command_gripper: Array  # (T,)
    command_base_from_tcp: Array  # (T, 7)
    phase: tuple[str, ...]  # T
    is_deliberate_miss: NDArray[np.bool_]  # (T,)
    world_from_camera: Mapping[str, Array]  # name -> (T, 7)

    @property
    def num_frames(self) -> int:
        """Number of frames, T."""
        return len(self.time_ns)


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
