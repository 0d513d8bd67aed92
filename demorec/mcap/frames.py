"""A recording's numbers as frames, and as a pandas table."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import fields
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from demorec.core.errors import MissingDependencyError
from demorec.core.geometry import Array, Pose
from demorec.episode.episode import Action, Event, Frame, JointSample, Observation, Table, Trajectory
from demorec.episode.features import POSE_ELEMENTS
from demorec.episode.info import EpisodeInfo

if TYPE_CHECKING:
    import pandas as pd


def pose_of(row: Array) -> Pose:
    """Convert a row (7,), position and quaternion xyzw, to a pose."""
    return Pose(position=row[:3], quat_xyzw=row[3:])


def observation_at(trajectory: Trajectory, frame: int) -> Observation:
    """Build the observation of a frame, bit-exact."""
    return Observation(
        joint_position=trajectory.joint_position[frame].copy(),
        joint_velocity=trajectory.joint_velocity[frame].copy(),
        joint_effort=trajectory.joint_effort[frame].copy(),
        gripper_width=float(trajectory.gripper_width[frame]),
        base_from_tcp=pose_of(trajectory.base_from_tcp[frame]),
        object_poses={name: pose_of(rows[frame]) for name, rows in trajectory.object_poses.items()},
        contact_force=float(trajectory.contact_force[frame]),
        sensed={name: values[frame].copy() for name, values in trajectory.sensed.items()},
    )


def action_at(trajectory: Trajectory, frame: int, kind: Literal["action", "command"]) -> Action:
    """Build the expert's action at a frame, or the command that was sent to the motors."""
    return Action(
        joint_target=getattr(trajectory, f"{kind}_joint_target")[frame].copy(),
        gripper_target=float(getattr(trajectory, f"{kind}_gripper")[frame]),
        base_from_tcp_target=pose_of(getattr(trajectory, f"{kind}_base_from_tcp")[frame]),
    )


def frames_of(
    trajectory: Trajectory, events: Iterable[tuple[int, Event]], joint_samples: Iterable[JointSample]
) -> Iterator[Frame]:
    """Yield every frame without its images, bit-exact: numbers, phase, events, and the joint samples before it.

    `events` have their time_ns; `joint_samples` include those of the frames.
    """
    times = trajectory.time_ns.tolist()
    found: dict[int, list[Event]] = {}
    for time_ns, event in events:
        frame = max(int(np.searchsorted(trajectory.time_ns, time_ns, side="right")) - 1, 0)
        found.setdefault(frame, []).append(event)
    samples = _samples_before_frames(joint_samples, times)
    for index, time_ns in enumerate(times):
        yield Frame(
            frame_index=index,
            time_ns=time_ns,
            observation=observation_at(trajectory, index),
            action=action_at(trajectory, index, "action"),
            command=action_at(trajectory, index, "command"),
            phase=trajectory.phase[index],
            events=tuple(found.get(index, ())),
            joint_samples=samples.get(index, ()),
            is_deliberate_miss=bool(trajectory.is_deliberate_miss[index]),
        )


def _samples_before_frames(samples: Iterable[JointSample], times: list[int]) -> dict[int, tuple[JointSample, ...]]:
    number = {time_ns: index for index, time_ns in enumerate(times)}
    result: dict[int, tuple[JointSample, ...]] = {}
    waiting: list[JointSample] = []
    for sample in samples:
        if sample.time_ns in number:
            result[number[sample.time_ns]] = tuple(waiting)
            waiting = []
        else:
            waiting.append(sample)
    return result


def pandas_table(info: EpisodeInfo, numbers: Table | Trajectory) -> pd.DataFrame:
    """Build the table of `Recording.to_pandas`."""
    try:
        import pandas as pd
    except ImportError as error:
        raise MissingDependencyError("A table of the frames", "pandas", "pip install pandas") from error
    if isinstance(numbers, Trajectory):
        table = _trajectory_columns(info, numbers)
    else:
        table = {"time_ns": numbers.time_ns}
        for feature in info.features:
            table |= _components(feature.name, numbers.features[feature.name], feature.names)
    return pd.DataFrame(table, index=pd.RangeIndex(numbers.num_frames, name="frame_index"))


def _trajectory_columns(info: EpisodeInfo, trajectory: Trajectory) -> dict[str, Any]:
    robot = info.simulated.robot
    joint_state = ("joint_position", "joint_velocity", "joint_effort")
    parts: dict[str, Sequence[str]] = dict.fromkeys(joint_state, robot.joint_names)
    parts |= dict.fromkeys(("action_joint_target", "command_joint_target"), robot.arm_joints)
    table: dict[str, Any] = {}
    for field in fields(trajectory):
        name, value = field.name, getattr(trajectory, field.name)
        if name == "sensed":
            for quantity, rows in value.items():
                table |= _components(quantity, rows, info.sensors[quantity].names)
        elif isinstance(value, Mapping):
            for key, poses in value.items():
                table |= _components(f"{name}.{key}", poses, POSE_ELEMENTS)
        elif np.ndim(value) == 2:
            table |= _components(name, value, parts.get(name, POSE_ELEMENTS))
        else:
            table[name] = value
    return table


def _components(name: str, rows: NDArray[np.float64], parts: Sequence[str]) -> dict[str, NDArray[np.float64]]:
    """Split (T, D) rows into columns named by component."""
    return {f"{name}.{part}": rows[:, number] for number, part in enumerate(parts)}
