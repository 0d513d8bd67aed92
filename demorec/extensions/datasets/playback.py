"""Episodes of exported datasets: numbers from the data files, the scene from demorec's own tables.

A dataset without environment state has only the first pose of each object.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from demorec.core.errors import ConfigError, RecordingError, describe_error, resource_error
from demorec.core.geometry import Array, Pose
from demorec.episode.features import ACTION, EE_POSE, ENVIRONMENT_STATE, STATE
from demorec.episode.info import EpisodeInfo
from demorec.episode.protocol import SceneMotion
from demorec.episode.roles import NamedRoles
from demorec.episode.validity import read_episode_info
from demorec.extensions.datasets.folder import LeRobotFolder
from demorec.extensions.datasets.recording import DatasetRecording
from demorec.robots.robot import RobotSpec
from demorec.robots.urdf import check_primitives
from demorec.view.episode import Playback, feature_curves, simulated_curves
from demorec.view.sources import PlaybackSource


def dataset_episodes(path: Path, named: NamedRoles) -> list[PlaybackSource]:
    """List the episodes of a dataset for playback. Raises ConfigError if it has none, or lacks a feature that the user
    named, and ExportError if it cannot be read.
    """
    dataset = LeRobotFolder(path, named=named)
    if not dataset.places:
        raise ConfigError(f"The dataset has no episodes to show: {path}")
    missing = dataset.leave_out_missing_cameras()
    notes = (*dataset.notes, *(f"No episode has a video of {key}, which is not shown: {path}" for key in missing))
    return [
        PlaybackSource(
            name=f"{path}: episode {place.episode_index}",
            open=partial(open_dataset_episode, dataset, number),
            notes=notes,
        )
        for number, place in enumerate(dataset.places)
    ]


@contextmanager
def open_dataset_episode(dataset: LeRobotFolder, number: int) -> Iterator[Playback]:
    """Open one episode of a dataset by its index, from 0, with scene and outcome as far as they are known.

    Raises:
        ConfigError: It lacks a feature that the user named.
        RecordingError: It cannot be read.
    """
    try:
        episode = _playback(dataset, number)
    except (OSError, ValueError, TypeError, KeyError, IndexError) as error:  # nulls and unexpected values in its tables
        unreadable = RecordingError(f"The dataset cannot be read ({describe_error(error)}): {dataset.root}")
        raise resource_error(error) or unreadable from error
    yield episode


def _playback(dataset: LeRobotFolder, number: int) -> Playback:
    root = dataset.root.resolve()
    data = DatasetRecording(dataset, number, finds_robot=True)
    has_scene = data.known.get("root_seed") is not None and {STATE, ACTION} <= dataset.info.features.keys()
    if has_scene:
        data = _SimulatedEpisode(dataset, number)
    index, last = data.place.episode_index, data.num_frames - 1
    statements = tuple(
        (min(round(row["timestamp"] * dataset.info.fps), last), str(row["style"]), str(row["content"]))
        for row in data.spoken.persistent
    )
    return Playback(
        name=f"episode_{index:06d}",
        group=root.name,
        identity=hashlib.sha256(f"{root} {index}".encode()).hexdigest()[:16],
        data=data,
        motion=data.motion(),
        roles=dataset.roles,
        curves=simulated_curves(data) if has_scene else feature_curves(data, dataset.roles),
        statements=statements,
    )


class _SimulatedEpisode(DatasetRecording):
    """An episode simulated by demorec, with the scene and the phases from the sidecar.

    Raises ValueError, TypeError, KeyError or IndexError for unexpected values in its tables.
    """

    def __init__(self, dataset: LeRobotFolder, number: int) -> None:
        super().__init__(dataset, number)
        self._row = dataset.sidecar_row(self.place.episode_index)
        self._phases = _phases(self._row, self.num_frames)
        if self.robot is not None:
            check_primitives(self.robot.urdf)

    @cached_property
    def info(self) -> EpisodeInfo:
        """The sidecar's description, with the features of the dataset."""
        return replace(read_episode_info(self._row["episode_info"]), features=super().info.features)

    @property
    def _spec(self) -> RobotSpec:
        return self.info.simulated.robot

    @property
    def phases(self) -> tuple[str, ...]:
        """T phases of the motion."""
        return self._phases

    def description(self, body: str = "") -> str:
        """Return the robot's URDF; "" if unknown, and for bodies."""
        return "" if body or self.robot is None else self.robot.urdf

    def motion(self) -> SceneMotion:
        """Read the motion of the robot and, if the dataset has it, of objects and cameras."""
        data = {name: values.astype(np.float64) for name, values in self.table().features.items()}
        state, count = data[STATE], len(self._spec.arm_joints)
        fingers = self._spec.gripper.joint_position(state[:, count])
        poses = self._object_poses(data[ENVIRONMENT_STATE]) if ENVIRONMENT_STATE in data else {}
        return SceneMotion(
            joint_position=dict(zip(self._spec.joint_names, [*state[:, :count].T, *fingers.T], strict=True)),
            base_from_tcp=data.get(EE_POSE),
            object_poses=poses,
            world_from_camera=self._camera_poses(data[EE_POSE]) if EE_POSE in data else {},
        )

    def _camera_poses(self, base_from_tcp: Array) -> dict[str, Array]:
        """Compute name -> (T, 7) of the cameras on the hand from (T, 7) TCP poses."""
        scene = self.info.simulated.scene
        tcp = [scene.robot.world_from_base @ Pose(position=row[:3], quat_xyzw=row[3:]) for row in base_from_tcp]
        return {
            camera.name: np.array([(pose @ camera.mount_from_camera).vector() for pose in tcp])
            for camera in scene.cameras
            if camera.mount == self._spec.tcp_link
        }

    def _object_poses(self, values: Array) -> dict[str, Array]:
        """Read name -> (T, 7) from the rows of `observation.environment_state`."""
        names = list(self.dataset.info.features[ENVIRONMENT_STATE].names or ())
        scene, result = self.info.simulated.scene, {}
        for body in scene.movable:
            column = names.index(f"{body.name}.pose.x")
            rows = values[:, column : column + 7]
            poses = (scene.robot.world_from_base @ Pose(position=row[:3], quat_xyzw=row[3:]) for row in rows)
            result[body.name] = np.array([pose.vector() for pose in poses])
        return result


def _phases(row: dict[str, Any], num_frames: int) -> tuple[str, ...]:
    names = [""] * num_frames
    for phase in row["phases"]:
        if not 0 <= phase["from"] <= phase["to"] <= num_frames:
            raise ValueError(f"a phase from frame {phase['from']} to {phase['to']} of {num_frames}")
        names[phase["from"] : phase["to"]] = [phase["name"]] * (phase["to"] - phase["from"])
    return tuple(names)
