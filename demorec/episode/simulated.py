"""Description and table of a simulated episode, in the form of all episodes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from demorec.episode.episode import Table, Trajectory
from demorec.episode.features import (
    ACTION,
    COMMAND,
    CONTACT_FORCE,
    EE_POSE,
    EFFORT,
    STATE,
    VELOCITY,
    action_vectors,
    observation_names,
    observation_vectors,
)
from demorec.episode.info import Camera, EpisodeInfo, Feature, Simulation
from demorec.episode.scene import Scene


def with_simulation(info: EpisodeInfo, **changes: Any) -> EpisodeInfo:
    """Change fields of an episode's `Simulation`, and with it cameras and names of elements; raises as `simulated`."""
    simulation = replace(info.simulated, **changes)
    features = simulated_features(simulation, list(info.sensors.values()))
    return replace(info, simulation=simulation, features=features, cameras=simulated_cameras(simulation.scene))


def simulated_cameras(scene: Scene) -> tuple[Camera, ...]:
    """Describe the cameras of a scene."""
    return tuple(
        Camera(
            name=camera.name,
            width=camera.width,
            height=camera.height,
            intrinsics=tuple(np.ravel(camera.intrinsics).tolist()),
            mount=camera.mount,
            mount_from_camera=camera.mount_from_camera,
        )
        for camera in scene.cameras
    )


def simulated_features(simulation: Simulation, sensors: Sequence[Feature]) -> tuple[Feature, ...]:
    """Describe the vectors of a simulated episode; `simulated_table` returns their values."""
    arm, names = simulation.robot.arm_joints, observation_names(simulation.robot, simulation.scene)
    state = Feature(name=STATE, names=names[STATE], units=("rad",) * len(arm) + ("m",), joints=(*arm, ""))
    efforts, force = "motor torques of the arm's joints (N m)", "sum of the normal forces on the fingers (N)"
    effort_names = tuple(f"{joint}.effort" for joint in arm)
    return (
        state,
        Feature(name=VELOCITY, names=names[VELOCITY], units=("rad/s",) * len(arm) + ("m/s",)),
        Feature(name=EE_POSE, names=names[EE_POSE], units=("m", "m", "m", "", "", "", "")),
        Feature(name=EFFORT, names=effort_names, units=("N m",) * len(arm), source=efforts),
        Feature(name=CONTACT_FORCE, names=("gripper.force",), units=("N",), source=force),
        *sensors,
        replace(state, name=ACTION),
        replace(state, name=COMMAND),
    )


def simulated_table(trajectory: Trajectory, info: EpisodeInfo) -> Table:
    """Convert a trajectory to its described features, in float64; each frame has the image of its number."""
    robot, scene = info.simulated.robot, info.simulated.scene
    vectors = observation_vectors(trajectory, robot, scene, sensed=on_request(info), dtype=np.float64)
    vectors[ACTION] = action_vectors(trajectory, scene, "joint", dtype=np.float64)
    vectors[COMMAND] = np.column_stack([trajectory.command_joint_target, trajectory.command_gripper])
    features = {feature.name: vectors[feature.name] for feature in info.features}
    cameras = list(trajectory.world_from_camera)
    return Table(
        time_ns=trajectory.time_ns,
        features=features,
        stamps=dict.fromkeys(features, trajectory.time_ns),
        images=dict.fromkeys(cameras, np.arange(trajectory.num_frames, dtype=np.int64)),
        image_stamps=dict.fromkeys(cameras, trajectory.time_ns),
    )


def on_request(info: EpisodeInfo) -> tuple[Feature, ...]:
    """Return the observations that datasets and environments include only on request."""
    return tuple(feature for feature in info.features if feature.name in (EFFORT, CONTACT_FORCE) or feature.stream)


def simulation_facts(info: EpisodeInfo) -> Mapping[str, Any]:
    """Return the facts that users ask about a simulation, as plain data; empty for any other episode.

    Keys: task, root_seed, physics_hz, objects (names of the movable bodies), config_digest.
    """
    if info.simulation is None:
        return {}
    facts = {key: getattr(info.simulation, key) for key in ("task", "root_seed", "physics_hz", "config_digest")}
    return facts | {"objects": [body.name for body in info.simulation.scene.movable]}


def scene_of(info: EpisodeInfo) -> Scene | None:
    """Return the scene at the start of the episode; None if unknown."""
    return None if info.simulation is None else info.simulation.scene
