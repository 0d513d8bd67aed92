"""Writes robomimic's layout: one group an episode, one HDF5 dataset a stream.

The rules come from robomimic's own reader (`SequenceDataset`, `get_env_metadata_from_dataset`). The names of the
observations are those of robosuite's environments, which robomimic's example configurations ask for.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from fractions import Fraction
from itertools import islice

import h5py
import numpy as np
from numpy.typing import NDArray

from demorec.export.columns import DONE, REWARD, SUCCESS, check_feature_names, feature_columns, frame_stride
from demorec.hdf5.collected import collected_attributes, write_collected
from demorec.hdf5.file import ENV_ARGUMENTS, PICTURE_ARGUMENTS, NewFile
from demorec.hdf5.options import Hdf5Options
from demorec.hdf5.streams import GYM, add_pictures, add_vectors
from demorec.recording import AnyRecording, CollectedRecording, Recording, channels
from demorec.scene.episode import EpisodeColumns, EpisodeInfo
from demorec.scene.features import (
    ACTION,
    DEPTH_SUFFIX,
    EE_POSE,
    ENVIRONMENT_STATE,
    IMAGE_PREFIX,
    STATE,
    VELOCITY,
    action_names,
    observation_names,
)
from demorec.tables import environment_name

_OBSERVATIONS = {
    "robot0_joint_pos": (STATE, slice(None, -1)),
    "robot0_gripper_qpos": (STATE, slice(-1, None)),
    "robot0_joint_vel": (VELOCITY, slice(None, -1)),
    "robot0_gripper_qvel": (VELOCITY, slice(-1, None)),
    "robot0_eef_pos": (EE_POSE, slice(0, 3)),
    "robot0_eef_quat": (EE_POSE, slice(3, 7)),
    "object": (ENVIRONMENT_STATE, slice(None)),
}
"""robomimic's observations: which components of which feature."""


class RobomimicWriter:
    """Adds episodes to an empty file; `finish` completes it.

    Attributes:
        options: Of the export.
        num_episodes, num_frames: Written so far.
    """

    def __init__(self, file: NewFile, options: Hdf5Options) -> None:
        self.options = options
        self.num_episodes = 0
        self.num_frames = 0
        self._file = file
        self._data = file.root.create_group("data")

    def add(self, recording: AnyRecording) -> None:
        """Append an episode: numbers at once, pictures one by one."""
        demo = self._data.create_group(f"demo_{self.num_episodes}")
        if isinstance(recording, CollectedRecording):
            num_frames = write_collected(demo, recording, self.options)
            described = collected_attributes(recording, self.options)
        else:
            num_frames = self._write_simulated(demo, recording)
            described = self._attributes(recording)
        if self.num_episodes == 0:
            self._data.attrs.update(described)
        self.num_episodes += 1
        self.num_frames += num_frames
        self._file.flush()

    def _write_simulated(self, demo: h5py.Group, recording: Recording) -> int:
        """Fill in the group of an episode; how many frames it has."""
        info, options = recording.info, self.options
        names = observation_names(info.robot, info.scene, privileged=options.privileged)
        self._check_feature_names(recording, names)
        columns = feature_columns(recording, options, dtype=np.float64)
        demo.attrs["num_samples"] = len(columns.rows)
        demo.attrs["instruction"] = info.instruction
        demo.attrs["episode_index"], demo.attrs["attempt"] = info.episode_index, info.attempt
        demo.attrs["success"] = recording.outcome is not None and recording.outcome.success
        if channels.description_topic() in recording.topics:
            demo.attrs["model_file"] = recording.description()
        add_vectors(demo, "actions", columns.features[ACTION], action_names(info.robot, options.action))
        add_vectors(demo, "states", *_states(columns.recorded, columns.rows, info))
        demo["rewards"] = columns.features[REWARD]
        demo["dones"] = columns.features[DONE].astype(np.int64)
        observations = demo.create_group("obs")
        for name, (feature, components) in _OBSERVATIONS.items():
            if feature in names and options.takes(feature):
                add_vectors(observations, name, columns.features[feature][:, components], names[feature][components])
        self._add_pictures(observations, recording, len(columns.rows))
        return len(columns.rows)

    def finish(self) -> None:
        """Write what is known of all episodes together: their number of samples, and who is for validation."""
        self._data.attrs["total"] = self.num_frames
        share = Fraction(self.options.valid_share).limit_denominator(1_000_000)
        numbers = range(self.num_episodes)
        valid = [number for number in numbers if int((number + 1) * share) > int(number * share)]
        train = [number for number in numbers if number not in set(valid)]
        for name, chosen in (("train", train), ("valid", valid)):
            self._file.root[f"mask/{name}"] = np.array([f"demo_{number}" for number in chosen], dtype="S")

    def _check_feature_names(self, recording: Recording, names: Iterable[str]) -> None:
        pictures = [IMAGE_PREFIX + camera for camera in recording.cameras]
        depth = [name + DEPTH_SUFFIX for name in pictures] if self.options.depth else []
        check_feature_names(self.options, [*names, *pictures, *depth, ACTION, REWARD, DONE, SUCCESS])

    def _add_pictures(self, observations: h5py.Group, recording: Recording, count: int) -> None:
        options, level = self.options, self.options.compression
        stride = frame_stride(recording.info.fps, options.fps)
        for camera in recording.cameras:
            settings = recording.video_settings(camera)
            size = settings.height, settings.width
            if options.takes(IMAGE_PREFIX + camera):
                pictures = islice(recording.images(camera), 0, None, stride)
                add_pictures(observations, f"{camera}_image", (count, *size, 3), pictures, level)
            if options.depth and options.takes(IMAGE_PREFIX + camera + DEPTH_SUFFIX):
                distances = islice(recording.depth(camera), 0, None, stride)
                add_pictures(observations, f"{camera}_depth", (count, *size, 1), distances, level)

    def _attributes(self, recording: Recording) -> dict[str, str | int]:
        """The attributes of `data` that robomimic makes an environment from, and what else holds for all episodes."""
        info, options = recording.info, self.options
        fps = info.fps // frame_stride(info.fps, options.fps)
        cameras = [camera for camera in info.scene.cameras if options.takes(IMAGE_PREFIX + camera.name)]
        arguments = {
            "robot": info.scene.robot.name,
            "fps": fps,
            "physics_hz": info.physics_hz,
            "cameras": [camera.name for camera in cameras],
            **({"width": cameras[0].width, "height": cameras[0].height} if cameras else {}),
            "action": options.action,
            "privileged": options.privileged,
        }
        assert arguments.keys() - PICTURE_ARGUMENTS == ENV_ARGUMENTS
        described = {"env_name": environment_name(info.task), "type": GYM, "env_kwargs": arguments}
        return {"env_args": json.dumps(described), "task": info.task, "fps": fps}


def _states(
    columns: EpisodeColumns, rows: NDArray[np.intp], info: EpisodeInfo
) -> tuple[NDArray[np.float64], tuple[str, ...]]:
    """(T, D) float64 state of the simulated world as recorded, and the names of its components.

    Positions (rad, fingers m) and velocities (rad/s, m/s) of all joints, then world_from_object of every movable body:
    xyz (m) and quaternion xyzw.
    """
    parts = [columns.joint_position, columns.joint_velocity, *columns.object_poses.values()]
    joints = info.robot.joint_names
    names = [f"{joint}.{what}" for what in ("pos", "vel") for joint in joints]
    names += [f"{body}.{axis}" for body in columns.object_poses for axis in ("x", "y", "z", "qx", "qy", "qz", "qw")]
    return np.concatenate(parts, axis=1)[rows], tuple(names)
