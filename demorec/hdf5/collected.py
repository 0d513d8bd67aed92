"""Collected episodes in robomimic's layout: every vector and camera under its own name.

What only a simulator could tell is left out: `states`, and `rewards` where nobody said how the episode ended.
"""

from __future__ import annotations

import json

import h5py
import numpy as np

from demorec.errors import ConfigError
from demorec.export.collected import collected_data, shown, wanted_cameras, wanted_depth
from demorec.export.columns import DONE
from demorec.hdf5.file import COLLECTED_ARGUMENTS, COLLECTED_ENVIRONMENT
from demorec.hdf5.options import Hdf5Options
from demorec.hdf5.streams import GYM, add_pictures, add_vectors
from demorec.plain import to_json
from demorec.recording import CollectedRecording
from demorec.scene.features import ACTION

_IMAGE, _PREFIX = "_image", "observation."


def write_collected(demo: h5py.Group, recording: CollectedRecording, options: Hdf5Options) -> int:
    """Fill in the group of an episode; how many frames it has.

    Raises:
        ConfigError: It has no actions, two of its streams would get one name, or options that it cannot serve.
        ExportError: It has no frames, or frames without a picture.
        RecordingError: It is damaged.
    """
    names = _observation_names(recording, options)
    data, info, outcome = collected_data(recording, options), recording.info, recording.outcome
    count = data.recorded.num_frames
    demo.attrs["num_samples"] = count
    demo.attrs["instruction"], demo.attrs["episode_index"] = info.instruction, info.episode_index
    demo.attrs["origin"] = to_json(info.origin)
    if info.urdf:
        demo.attrs["model_file"] = info.urdf
    dones = data.features[DONE].astype(np.int64)
    if outcome is not None and outcome.success is not None:
        demo.attrs["success"] = outcome.success
        demo["rewards"] = (dones * outcome.success).astype(np.float32)
    demo["dones"] = dones
    elements = {feature.name: feature.names for feature in info.features}
    add_vectors(demo, "actions", data.features[ACTION], elements[ACTION])
    observations = demo.create_group("obs")
    for name, values in data.features.items():
        if name not in (ACTION, DONE):
            add_vectors(observations, names[name], values, elements[name])
    for camera, numbers in data.pictures.items():
        settings = recording.video_settings(camera)
        is_depth = camera in recording.depth_cameras
        shape = (count, settings.height, settings.width, 1 if is_depth else 3)
        name = names[camera if is_depth else camera + _IMAGE]
        add_pictures(observations, name, shape, shown(recording, camera, numbers), options.compression)
    return count


def collected_attributes(recording: CollectedRecording, options: Hdf5Options) -> dict[str, str | int]:
    """The attributes of `data`: robomimic asks for an environment, of which there is none but its name."""
    info = recording.info
    arguments = {
        "robot": info.robot,
        "fps": info.fps,
        "cameras": wanted_cameras(recording, options),
        "observations": list(_observation_names(recording, options).values()),
    }
    assert arguments.keys() == COLLECTED_ARGUMENTS
    described = {"env_name": COLLECTED_ENVIRONMENT, "type": GYM, "env_kwargs": arguments}
    return {"env_args": json.dumps(described), "fps": info.fps}


def _observation_names(recording: CollectedRecording, options: Hdf5Options) -> dict[str, str]:
    """Feature, or camera with "_image" -> what robomimic's observation is called: "state", "force", "top_image"."""
    features = [feature.name for feature in recording.info.features if options.takes(feature.name)]
    if ACTION not in features:
        raise ConfigError(f"robomimic's layout needs actions, and the episode has none: {recording.path}")
    names = {name: name.removeprefix(_PREFIX) for name in features if name != ACTION}
    cameras = {camera + _IMAGE: camera + _IMAGE for camera in wanted_cameras(recording, options)}
    depths = {camera: camera for camera in wanted_depth(recording, options)}
    given = [*names.values(), *cameras.values(), *depths.values()]
    if twice := sorted({name for name in given if given.count(name) > 1}):
        raise ConfigError(
            f"Two streams of the episode would be called {', '.join(twice)} in the file, leave one of them out "
            f"(--features): {recording.path}"
        )
    return names | cameras | depths
