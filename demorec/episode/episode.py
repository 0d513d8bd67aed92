"""What is recorded at each control step, and about each episode.

The (observation, action) contract, everywhere: frame t holds the observation at time t, taken *before* action t
is applied. `action` is what the expert wanted (the label to learn from); `command` is what was sent to the motors
(the same, plus exploration noise where there was any), in float64 as sent: replaying the commands reproduces the
episode to the bit.
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
"""Phase of the frames in which a policy acts, or somebody else who tells no phase; all others are the expert's."""
HALT_PHASE = "halt"
"""Phase in which an expert that has taken over does nothing yet but stop the arm. That is not to be learned: it stops
in states in which a demonstration goes on."""

TIME_LIMIT = "time_limit"
"""Reason of a failure that had not ended when its time was over."""

NO_IMAGE = -1
"""Stands for the number of an image where a frame has none."""

Vector = NDArray[np.float32] | NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class Observation:
    """All that is sensed at one instant.

    Attributes:
        joint_position: (n_joints,) in the order of `RobotSpec.joint_names`; rad, fingers m.
        joint_velocity: (n_joints,) rad/s, fingers m/s.
        joint_effort: (n_joints,) motor torque N m, fingers N.
        gripper_width: Opening between the fingers, metres.
        base_from_tcp: TCP pose in the base frame.
        object_poses: name -> world_from_object, of every movable body of the scene.
        contact_force: Sum of the normal forces on the fingers, N.
        sensed: What else is sensed: quantity -> (D,), by the rows of `demorec.sim.sensors`.
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
    """Joint states between two frames (recorded at the physics rate when asked for); shapes as in Observation."""

    time_ns: int
    joint_position: Array
    joint_velocity: Array
    joint_effort: Array


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraImages:
    """What one camera sees at one instant.

    Attributes:
        color: (H, W, 3) uint8 RGB, row 0 on top.
        depth: (H, W) float32 metres along the optical axis, 0 where nothing is hit; None when not asked for.
        segmentation: (H, W) int32, body index + ((link index + 1) << 24) as PyBullet numbers them, -1 for the
            background; None when not asked for.
        world_from_camera: Pose, OpenCV axes.
    """

    color: NDArray[np.uint8]
    depth: NDArray[np.float32] | None = None
    segmentation: NDArray[np.int32] | None = None
    world_from_camera: Pose


@dataclass(frozen=True, kw_only=True)
class Event:
    """Something that happened, for people to read: a grasp, a miss, a retry."""

    name: str
    message: str
    level: Literal["info", "warning", "error"] = "info"


@dataclass(frozen=True, kw_only=True, eq=False)
class Frame:
    """One control step.

    Attributes:
        frame_index: t, from 0.
        time_ns: Simulated time since the episode's start, computed from frame_index.
        observation: At t.
        action: What the expert wanted at t.
        command: What was sent to the motors at t.
        phase: Of the scripted motion ("approach", "lift", ...).
        events: At t.
        images: camera name -> images at t.
        joint_samples: Joint states since the previous frame, both ends left out; empty unless asked for.
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
    """One condition of success.

    Attributes:
        name: What is measured ("distance_to_goal").
        value: What was found, in `unit`.
        limit: What is allowed; `passed` tells on which side.
        unit: "m", "rad", "m/s", "N" or "".
        passed: Whether it holds.
    """

    name: str
    value: float
    limit: float
    unit: str
    passed: bool


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """How an episode ended.

    Attributes:
        success: Whether it succeeded, for a simulated one whether every check passed; None when nobody said.
        checks: The task's conditions, with the values found.
        failure_phase: Phase in which it went wrong, "" on success and where it is not known.
        failure_reason: Name of the first failed check, what made the expert give up, or why in somebody's words; "" on
            success and when nobody said.
        num_frames: Length.
        num_retries: How often the expert tried again within the episode.
        final_state_digest: SHA-256 (hex) over positions and velocities of all joints and movable bodies at the end, ""
            where nobody knows them.
        drops: "frames", or a camera's name -> how many of them could not be taken; what is not named lost none.
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
    """Whether a recording shows the reason of a failure, whatever the conditions say: an event of its name, or the end
    of the time."""
    limit = info.simulated.config.get("max_episode_seconds")
    is_over = isinstance(limit, int | float) and outcome.num_frames + 1 > limit * info.fps
    return (outcome.failure_reason == TIME_LIMIT and is_over) or any(
        event.name == outcome.failure_reason and event.level != "info" for event in events
    )


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
        images: Camera -> number of the image that it holds, counted from 0 in each camera. One image may be held
            by several frames, or by none; a camera that is left out has no image at this frame.
        subtask: What the robot begins to do with this frame, in the words of whoever said it; "" where nothing new was
            said.
    """

    time_ns: int
    samples: Mapping[str, Sample]
    images: Mapping[str, int] = field(default_factory=dict)
    subtask: str = ""


@dataclass(frozen=True, kw_only=True, eq=False)
class Table:
    """Numbers of an episode of T frames, and the images that the frames show.

    Attributes:
        time_ns: (T,) stamps of the frames.
        features: Feature -> (T, D) in its own dtype.
        stamps: Feature -> (T,) stamps of the samples.
        images: Camera -> (T,) number of the image that each frame shows, `NO_IMAGE` for none.
        image_stamps: Camera -> (P,) stamps of its images.
    """

    time_ns: NDArray[np.int64]
    features: Mapping[str, NDArray[Any]]
    stamps: Mapping[str, NDArray[np.int64]]
    images: Mapping[str, NDArray[np.int64]]
    image_stamps: Mapping[str, NDArray[np.int64]]

    @property
    def num_frames(self) -> int:
        """T."""
        return len(self.time_ns)

    def age_ns(self, feature: str) -> NDArray[np.int64]:
        """(T,) age of each frame's sample of a feature."""
        return self.time_ns - self.stamps[feature]

    def image_age_ns(self, camera: str) -> NDArray[np.int64]:
        """(N,) age of the image of each of the N frames that show one of this camera."""
        numbers = self.images[camera]
        frames = np.flatnonzero(numbers != NO_IMAGE)
        ages: NDArray[np.int64] = self.time_ns[frames] - self.image_stamps[camera][numbers[frames]]
        return ages


@dataclass(frozen=True, kw_only=True, eq=False)
class Trajectory:
    """Everything that demorec simulates in an episode of T frames, as it was computed.

    Shapes and units of a row are those of `Observation` and `Action`. A pose is (7,): position, then quaternion xyzw.
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
        """T."""
        return len(self.time_ns)


def frame_time_ns(frame_index: int, fps: int) -> int:
    """Nanoseconds of a frame since the episode's start: exact integer arithmetic, rounded half up."""
    return (frame_index * 2_000_000_000 + fps) // (2 * fps)


def interventions(phases: Sequence[str]) -> NDArray[np.bool_]:
    """(T,) where an expert acts that has taken over from a policy, and does more than stop the arm.

    False in all frames of a demonstration, which nobody took over.
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
