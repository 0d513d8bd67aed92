"""Export of recordings to an HDF5 file in robomimic's layout."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from fractions import Fraction
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from demorec.core.atomic import atomic_write
from demorec.core.errors import ConfigError
from demorec.core.tables import environment_name
from demorec.datasets.episode import ExportEpisode
from demorec.datasets.options import ExportReport, ProgressCallback
from demorec.datasets.sources import Intake, find_recordings, places_of, why_left_out
from demorec.episode.features import ACTION, EE_POSE, ENVIRONMENT_STATE, IMAGE_PREFIX, STATE, VELOCITY
from demorec.episode.roles import NO_NAMES, roles_of_recording
from demorec.extensions.hdf5.file import DATASET, ENVIRONMENT_PREFIX, NewFile
from demorec.extensions.hdf5.options import Hdf5Options
from demorec.mcap import open_recording

Hdf5Episode = ExportEpisode[Hdf5Options]


def export_hdf5(
    sources: Sequence[Path], out: Path, options: Hdf5Options, progress: ProgressCallback | None = None
) -> ExportReport:
    """Write the recordings to the file `out`, completely or not at all. Only one image is in memory at a time.

    Args:
        sources: Recordings, runs, or folders of recordings.
        out: The file.
        options: Options of the export.
        progress: Called after every recording.

    Raises:
        ConfigError: Impossible options, nothing to export, or an existing file.
        ExportError: Recordings that differ, a full disk. `out` is unchanged.
        RecordingError: A recording is damaged, or lacks requested images.
    """
    options.validate()
    found = find_recordings(sources)
    with (
        atomic_write(out, DATASET, overwrite=options.overwrite, sources=places_of(found)) as part,
        NewFile(part) as file,
    ):
        return _write(file, found, out, options, progress)


def _write(
    file: NewFile, found: Sequence[Path], out: Path, options: Hdf5Options, progress: ProgressCallback | None
) -> ExportReport:
    intake = Intake(found, options)
    data = file.root.create_group("data")
    num_frames = 0
    depth_left_out: tuple[str, ...] = ()
    for done, path in enumerate(found, start=1):
        with open_recording(path) as recording:
            if (reason := why_left_out(recording, options)) is None:
                episode = ExportEpisode(recording, options)
                intake.take(path, episode.traits())
                _add(data, intake.num_taken - 1, episode)
                depth_left_out = depth_left_out or episode.depth_left_out
                num_frames += episode.num_frames
                file.flush()
            else:
                intake.leave_out(reason)
        if progress is not None:
            progress(done, len(found))
    if not intake.num_taken:
        raise intake.nothing_to_export()
    data.attrs["total"] = num_frames
    _add_masks(file.root, intake.num_taken, options.valid_share)
    return ExportReport(
        path=out,
        num_episodes=intake.num_taken,
        num_frames=num_frames,
        new_episodes=intake.num_taken,
        depth_left_out=depth_left_out,
        skipped_failures=intake.skipped["failures"],
        skipped_unwanted=intake.skipped["unwanted"],
    )


_NO_ENVIRONMENT = f"{ENVIRONMENT_PREFIX}collected"
"""Environment name for episodes without one."""
_GYM = 2
"""`EnvType.GYM_TYPE` of robomimic."""
_GZIP_LEVEL = 4
"""Level of gzip for images, of 1 to 9 (smallest)."""
_ROBOSUITE = {
    STATE: {"robot0_joint_pos": slice(None, -1), "robot0_gripper_qpos": slice(-1, None)},
    VELOCITY: {"robot0_joint_vel": slice(None, -1), "robot0_gripper_qvel": slice(-1, None)},
    EE_POSE: {"robot0_eef_pos": slice(0, 3), "robot0_eef_quat": slice(3, 7)},
    ENVIRONMENT_STATE: {"object": slice(None)},
}
"""Feature of an arm in a scene -> robosuite's observations, and the elements of each."""


def _add(data: h5py.Group, number: int, episode: Hdf5Episode) -> None:
    """Append an episode: numbers at once, images one at a time."""
    # A separate function, because its return closes the groups, which affects where HDF5 places the following bytes.
    _fill(data.create_group(f"demo_{number}"), episode)
    if number == 0:
        data.attrs.update(_attributes(episode))


def _fill(demo: h5py.Group, episode: Hdf5Episode) -> None:
    observations, images = _observation_names(episode), _image_names(episode)
    count = episode.num_frames
    demo.attrs["num_samples"] = count
    demo.attrs["instruction"] = episode.info.instruction
    if urdf := episode.urdf:
        demo.attrs["model_file"] = urdf
    dones = episode.is_last.astype(np.int64)
    if (success := episode.recording.success) is not None:
        demo.attrs["success"] = success
        demo["rewards"] = (dones * success).astype(np.float32)
    demo["dones"] = dones
    actions = _action_features(episode)
    parts = [name for feature in actions for name in episode.names[feature]]
    _add_vectors(demo, "actions", np.hstack([episode.vectors[feature] for feature in actions]), parts)
    if episode.scene is not None:
        _add_vectors(demo, "states", *_states(episode))
    group = demo.create_group("obs")
    for name, (feature, elements) in observations.items():
        _add_vectors(group, name, episode.vectors[feature][:, elements], episode.names[feature][elements])
    for name, camera in zip(images, episode.cameras, strict=True):
        settings = episode.recording.video_settings(camera.name)
        shape = (count, settings.height, settings.width, 1 if camera.is_depth else 3)
        _add_images(group, name, shape, episode.images(camera))


def _add_masks(root: h5py.Group, num_episodes: int, valid_share: float) -> None:
    """Write the names of the episodes for training and for validation."""
    share = Fraction(valid_share).limit_denominator(1_000_000)
    chosen: dict[str, list[str]] = {"train": [], "valid": []}
    for number in range(num_episodes):
        is_valid = int((number + 1) * share) > int(number * share)
        chosen["valid" if is_valid else "train"].append(f"demo_{number}")
    for name, episodes in chosen.items():
        root[f"mask/{name}"] = np.array(episodes, dtype="S")


def _action_features(episode: Hdf5Episode) -> tuple[str, ...]:
    """Find the features of the action by role, not by name; several are joined in this order."""
    if ACTION in episode.names:
        return (ACTION,)
    roles = roles_of_recording(episode.info, NO_NAMES)
    found = tuple(name for name in roles.action if name in episode.names)
    if not found:
        raise ConfigError(f"robomimic's layout needs actions, and the episode has none: {episode.recording.path}")
    return found


def _observation_names(episode: Hdf5Episode) -> dict[str, tuple[str, slice]]:
    """Return observation -> feature and element slice, with robosuite's names, or "force" for "observation.force"."""
    actions = _action_features(episode)
    known = {} if episode.scene is None else _ROBOSUITE
    found = [
        (name, (feature, elements))
        for feature in episode.names
        if feature not in actions
        for name, elements in known.get(feature, {feature.removeprefix("observation."): slice(None)}).items()
    ]
    given = [*(name for name, _ in found), *_image_names(episode)]
    if twice := sorted({name for name in given if given.count(name) > 1}):
        raise ConfigError(
            f"Two streams of the episode would be called {', '.join(twice)} in the file, leave one of them out "
            f"(--features): {episode.recording.path}"
        )
    return dict(found)


def _image_names(episode: Hdf5Episode) -> list[str]:
    """Return a name for each camera: "front_image", or for a depth camera the last part of its feature's name."""
    return [
        camera.feature.removeprefix(IMAGE_PREFIX) + ("" if camera.is_depth else "_image") for camera in episode.cameras
    ]


def _attributes(episode: Hdf5Episode) -> dict[str, str | int]:
    """Return the attributes of `data`: arguments of robomimic's environment, rate and observation names."""
    info, options = episode.info, episode.options
    colour = [camera.name for camera in episode.cameras if not camera.is_depth]
    arguments: dict[str, object] = {"robot": info.robot_name, "fps": info.fps, "cameras": colour}
    name = _NO_ENVIRONMENT
    if episode.scene is not None:
        name = environment_name(info.simulated.task)
        cameras = [camera for camera in info.cameras if options.takes(IMAGE_PREFIX + camera.name)]
        arguments |= {
            "physics_hz": info.simulated.physics_hz,
            **({"width": cameras[0].width, "height": cameras[0].height} if cameras else {}),
            "action": options.action,
            "privileged": options.privileged,
        }
    return {
        "env_args": json.dumps({"env_name": name, "type": _GYM, "env_kwargs": arguments}),
        "fps": info.fps,
        "observations": json.dumps([*_observation_names(episode), *_image_names(episode)]),
    }


def _states(episode: Hdf5Episode) -> tuple[NDArray[np.float64], tuple[str, ...]]:
    """(T, D) positions and velocities of all joints, then world_from_object of each movable body, and their names."""
    trajectory, joints = episode.recording.trajectory(), episode.info.simulated.robot.joint_names
    parts = [trajectory.joint_position, trajectory.joint_velocity, *trajectory.object_poses.values()]
    names = [f"{joint}.{what}" for what in ("pos", "vel") for joint in joints]
    names += [f"{body}.{axis}" for body in trajectory.object_poses for axis in ("x", "y", "z", "qx", "qy", "qz", "qw")]
    return np.concatenate(parts, axis=1), tuple(names)


def _add_vectors(group: h5py.Group, name: str, values: NDArray[np.generic], components: Sequence[str]) -> None:
    """Write (T, D) numbers as a dataset; its attribute `names` lists the D components."""
    stored = group.create_dataset(name, data=values)
    stored.attrs["names"] = json.dumps(components)


def _add_images(group: h5py.Group, name: str, shape: tuple[int, ...], images: Iterable[NDArray[np.generic]]) -> None:
    """Write (T, H, W, 3) uint8 colour or (T, H, W, 1) float32 depth images; each image is one chunk."""
    kind = np.uint8 if shape[-1] == 3 else np.float32
    stored = group.create_dataset(
        name, shape, kind, chunks=(1, *shape[1:]), compression="gzip", compression_opts=_GZIP_LEVEL
    )
    for index, image in enumerate(images):
        stored[index] = image.reshape(shape[1:])
