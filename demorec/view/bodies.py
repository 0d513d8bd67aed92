"""Appearance, motion and goals of the robot and the objects of the scene."""

from __future__ import annotations

import functools
import logging
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import rerun as rr

from demorec.core.errors import DemorecError, as_reason
from demorec.core.files import read_text_limited
from demorec.episode.scene import Body, Scene, Shape
from demorec.mcap.transforms import MovingJoints
from demorec.render.raster.mesh import RasterMesh
from demorec.robots.assets import asset_path, known_model, surface_file
from demorec.robots.urdf import MAX_BYTES, Urdf
from demorec.view.episode import Playback
from demorec.view.meshes import WHITE, as_mesh3d, joined, mesh_file, placed, primitive, urdf_meshes
from demorec.view.paths import Paths, log_pose, send_poses
from demorec.view.style import GOAL

log = logging.getLogger(__name__)

_ROD_RADIUS = 0.015
"""Radius, metres, of the rods in place of missing meshes."""


def log_bodies(recording: rr.RecordingStream, episode: Playback, scene: Scene) -> None:
    """Log every body at its pose or along its trajectory, and wire frames of goals.

    A body with a model that is missing here, or differs from the recorded one, is drawn as the recording describes it.
    """
    for body in scene.bodies:
        entity = Paths.body(body.name)
        recording.log(entity, _visible(body, episode), static=True)
        poses = episode.motion.object_poses.get(body.name)
        if poses is not None:
            send_poses(recording, entity, episode.time_ns, poses)
        else:
            log_pose(recording, entity, body.world_from_body.vector())
    for goal in scene.goals:
        wire = rr.Boxes3D(sizes=[scene.body(goal.object).shape.extents], colors=[GOAL], radii=[-1.5])
        log_pose(recording, Paths.goal(goal.object), scene.world_from_goal(goal).vector())
        recording.log(Paths.goal(goal.object), wire, static=True)


def _visible(body: Body, episode: Playback) -> rr.Mesh3D:
    shape, color = body.shape, body.mean_color
    if shape.kind not in ("mesh", "urdf"):
        return as_mesh3d(placed(primitive(shape.kind, shape.size), rgba=color))
    mesh = _installed_mesh(shape)
    if mesh is not None:
        if color != WHITE:  # replaces the model's own colours, as in the simulator
            mesh = replace(mesh, colors=np.ones_like(mesh.colors))
        return as_mesh3d(placed(mesh, rgba=color))
    if description := episode.data.description(body.name):  # already in the body's colours
        return as_mesh3d(joined(list(urdf_meshes(description, None).values())))
    return as_mesh3d(placed(primitive("box", shape.extents), rgba=color))


@functools.lru_cache(maxsize=64)
def _installed_mesh(shape: Shape) -> RasterMesh | None:
    """Load the model file of a mesh or urdf in the body's frame; None, with a warning, if it is unusable."""
    try:
        return _model_mesh(shape)
    except (DemorecError, OSError, ValueError) as error:
        log.warning("An object is drawn as the recording describes it, since %s.", as_reason(error))
        return None


def _model_mesh(shape: Shape) -> RasterMesh:
    if shape.kind == "mesh":
        return placed(mesh_file(surface_file(shape)), shape.body_from_mesh, shape.scale)
    path = asset_path(shape.file)
    text = path.read_text()
    poses = Urdf.parse(text, scale=shape.scale).link_poses({})
    links = urdf_meshes(text, path.parent, shape.scale)
    return joined([placed(mesh, poses[link]) for link, mesh in links.items()])


_SAME_PLACE = 1e-3
"""Maximum distance between joints of the installed model and of the recorded description, metres."""


def log_robot(recording: rr.RecordingStream, episode: Playback) -> None:
    """Log the meshes of all links below `Paths.robot`, nested as the links are, and their motion.

    Joints with unknown positions stay at 0; a robot without a description is not shown.

    Raises:
        DemorecError: A simulated robot's model is neither installed nor recorded.
    """
    info, positions = episode.info, episode.motion.joint_position
    description = info.urdf or episode.data.description()
    if episode.scene is not None:
        model = robot_model(info.simulated.robot.urdf, episode.scene.robot.scale, description)
    elif description:
        model = robot_model("", 1.0, description)
    else:
        return
    urdf = model.urdf
    entities = {urdf.root: f"{Paths.robot}/{urdf.root}"}
    for joint in urdf.depth_first():
        entities[joint.child] = f"{entities[joint.parent]}/{joint.child}"
    log_pose(recording, entities[urdf.root], episode.world_from_base.vector())
    joints = MovingJoints(urdf, [*positions])
    for _, child, pose in joints.static:
        log_pose(recording, entities[child], pose.vector())
    poses = joints.values(np.array([*positions.values()]).reshape(len(positions), episode.num_frames).T)
    for number, (_, child) in enumerate(joints.moving):
        send_poses(recording, entities[child], episode.time_ns, poses[:, number])
    for link, mesh in model.meshes.items():
        recording.log(entities[link], mesh, static=True)
    if not model.is_complete:
        for parent in {joint.parent for joint in urdf.joints} - model.meshes.keys():
            ends = [joint.parent_from_joint.position for joint in urdf.joints if joint.parent == parent]
            rods = rr.LineStrips3D([[np.zeros(3), end] for end in ends], radii=_ROD_RADIUS)
            recording.log(entities[parent], rods, static=True)


class _Model(NamedTuple):
    """Joint tree and meshes of the links, of which some may be missing."""

    urdf: Urdf
    meshes: Mapping[str, rr.Mesh3D]
    is_complete: bool = True


@functools.lru_cache(maxsize=4)
def robot_model(name: str, scale: float, description: str) -> _Model:
    """Load a robot from the model that it was recorded with, else from the recorded description.

    The model is used if it is complete and its joints are where the recording has them.

    Args:
        name: Name of a simulated robot's model, or "": the file that the description was made from, if it is known.
        scale: Uniform scale of that model.
        description: Recorded URDF, or "".

    Raises:
        DemorecError: The model is not installed, and the recording does not describe it.
    """
    recorded = Urdf.parse(description) if description else None
    try:
        path = asset_path(name) if name else known_model(description)
        if path is not None:
            return _original(path, scale, recorded)
    except (DemorecError, OSError, ValueError) as error:
        if recorded is None:
            raise
        log.warning("The robot is drawn as the recording describes it, since %s.", as_reason(error))
    assert recorded is not None
    failures: list[DemorecError] = []
    meshes = urdf_meshes(description, None, failures=failures)
    if failures:
        why = as_reason(failures[0])
        log.warning("The robot is drawn as rods between its joints where its meshes are not found, since %s.", why)
    return _Model(recorded, _drawable(meshes), not failures)


def _original(path: Path, scale: float, recorded: Urdf | None) -> _Model:
    """Load the model that a description was made from; ValueError if its joints differ from the recorded ones."""
    text = read_text_limited(path, MAX_BYTES)
    urdf = Urdf.parse(text, scale=scale)
    if recorded is not None and not _same_joints(urdf, recorded):
        raise ValueError(f"the model installed here has other joints ({path.name})")
    return _Model(urdf, _drawable(urdf_meshes(text, path.parent, scale)))


def _drawable(meshes: Mapping[str, RasterMesh]) -> dict[str, rr.Mesh3D]:
    return {link: as_mesh3d(mesh) for link, mesh in meshes.items()}


def _same_joints(a: Urdf, b: Urdf) -> bool:
    return len(a.joints) == len(b.joints) and all(
        first.name == second.name
        and np.abs(first.parent_from_joint.position - second.parent_from_joint.position).max() < _SAME_PLACE
        for first, second in zip(a.joints, b.joints, strict=True)
    )
