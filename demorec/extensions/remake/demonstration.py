"""Recordings, and episodes of datasets, opened for replay.

Datasets have float32 actions of any kind; their scenes come from the sidecar.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import get_args

import numpy as np

from demorec.core.errors import ConfigError, ExportError, RecordingError
from demorec.core.geometry import Array
from demorec.episode.episode import Frame, Observation, Outcome, gave_up
from demorec.episode.features import ACTION, STATE, ActionKind, action_names
from demorec.episode.info import EpisodeInfo
from demorec.mcap import Recording, open_simulated
from demorec.mcap.frames import frames_of
from demorec.sim.sensors import SENSORS

JOINTS, OPENING, POSE_OF = "joint positions", "gripper opening", "the pose of "


@dataclass(frozen=True, kw_only=True, eq=False)
class Demonstration:
    """An episode to replay: a start, commands, and recorded states.

    Attributes:
        name: Name of the file or of the dataset's episode.
        info: The recorded scene and robot, at the rate of the commands.
        compared: Name in `seen_in` -> (T, D) recorded before each command; for a dataset only the opening and the arm's
        joints.
        outcome: Recorded outcome; None if unknown.
        recorded: Frames of a recording, without images, whose commands are sent.
        actions: (T, D) of a dataset, from which the commands are decoded.
        action_kind: Meaning of `actions`; None for a recording.
        tolerance: Maximum difference of equal states: 0 for float64, rounding for float32.
        source: File of the recording; None for an episode of a dataset.
        digest: Digest of its content.
        gave_up: Whether the recording gives the reason of its failure (`gave_up`).
    """

    name: str
    info: EpisodeInfo
    compared: Mapping[str, Array]
    outcome: Outcome | None
    recorded: tuple[Frame, ...] = ()
    actions: Array | None = None
    action_kind: ActionKind | None = None
    tolerance: float = 0.0
    source: Path | None = None
    digest: str = ""
    gave_up: bool = False


def open_demonstration(recording: Recording) -> Demonstration:
    """Open a recording for replay; RecordingError if it is damaged or empty."""
    info, trajectory = _sensed_here(recording.info), recording.trajectory()
    trajectory = replace(trajectory, sensed={name: trajectory.sensed[name] for name in info.sensors})
    if trajectory.num_frames == 0:
        raise RecordingError(f"The recording has no frames: {recording.path}")
    frames = tuple(frames_of(trajectory, recording.events(), recording.joint_samples()))
    seen = [seen_in(frame.observation) for frame in frames]
    outcome = recording.outcome
    return Demonstration(
        name=recording.path.name,
        info=info,
        compared={name: np.array([values[name] for values in seen]) for name in seen[0]},
        outcome=outcome,
        recorded=frames,
        source=recording.path,
        digest=recording.digest(),
        gave_up=outcome is not None and gave_up(outcome, [event for _, event in recording.events()], info),
    )


def _sensed_here(info: EpisodeInfo) -> EpisodeInfo:
    """Leave out the sensors of a recording that this version does not simulate."""
    here = {sensor.quantity for sensor in SENSORS}
    unknown = [feature for quantity, feature in info.sensors.items() if quantity not in here]
    return replace(info, features=tuple(feature for feature in info.features if feature not in unknown))


def seen_in(observation: Observation) -> dict[str, Array]:
    """All sensed quantities: name -> (D,)."""
    return {
        JOINTS: observation.joint_position,
        OPENING: np.array([observation.gripper_width]),
        "joint velocities": observation.joint_velocity,
        "joint efforts": observation.joint_effort,
        "the contact force": np.array([observation.contact_force]),
        "the EE pose": observation.base_from_tcp.vector(),
        **{f"the {name}": values for name, values in observation.sensed.items()},
        **{f"{POSE_OF}{name}": pose.vector() for name, pose in observation.object_poses.items()},
    }


def open_file(path: Path) -> Demonstration:
    """Open a recording's file for replay; errors as in `open_demonstration`."""
    with open_simulated(path) as recording:
        return open_demonstration(recording)


def dataset_demonstrations(path: Path, wanted: Callable[[int], bool]) -> Iterator[Demonstration]:
    """Yield the wanted episodes of an exported dataset, with the scenes from its sidecar.

    Raises:
        ExportError: A wanted episode is not readable.
        ConfigError: The dataset has no sidecar of demorec, or unknown actions.
    """
    from demorec.check.dataset import CheckedDataset  # loads pyarrow

    dataset = CheckedDataset(path)
    if missing := dataset.missing:
        raise ExportError(missing)
    if bad := [problem for number, problem in dataset.unreadable.items() if wanted(number)]:
        raise ExportError(f"{bad[0]}, in {path}")
    if not dataset.records:
        raise ConfigError(f"The dataset does not record its scenes (no demorec/episodes): {path}")
    dataset.check_simulated()
    names = dataset.info.features[ACTION].names if ACTION in dataset.info.features else None
    for each in dataset.described():
        if not wanted(each.number):
            continue
        robot = each.info.simulated.robot
        kind = next((kind for kind in get_args(ActionKind) if action_names(robot, kind) == names), None)
        if kind is None:
            raise ConfigError(f"The dataset's actions were not written by demorec and cannot be replayed: {path}")
        state, arm = each.rows[STATE].astype(np.float64), len(robot.arm_joints)
        yield Demonstration(
            name=f"{path.name}_episode_{each.number:06d}",
            info=replace(each.info, fps=dataset.info.fps),
            actions=each.rows[ACTION].astype(np.float64),
            action_kind=kind,
            compared={JOINTS: state[:, :arm], OPENING: state[:, arm : arm + 1]},
            outcome=Outcome(success=bool(each.kept["success"]), num_frames=len(state)),
            tolerance=1e-6,
            digest=str(each.kept["content_digest"]),
        )
