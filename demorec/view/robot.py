"""The moving robot: its links' meshes once, its joints' transforms as columns."""

from __future__ import annotations

import functools
import logging
from collections.abc import Mapping

import numpy as np
import rerun as rr

from demorec.core.errors import DemorecError, as_reason
from demorec.core.geometry import Array, quat_multiply
from demorec.episode.scene import Rgba
from demorec.robots.assets import asset_path
from demorec.robots.urdf import Urdf, UrdfJoint
from demorec.view.episode import PlayedEpisode
from demorec.view.meshes import SurfaceMesh, skeleton_meshes, urdf_meshes
from demorec.view.paths import Paths
from demorec.view.times import log_pose, send_poses

log = logging.getLogger(__name__)

_SAME_PLACE = 1e-3
"""How far joints of the installed model may be from those of the recorded description, metres."""


def log_robot(recording: rr.RecordingStream, paths: Paths, episode: PlayedEpisode, tint: Rgba | None = None) -> None:
    """Meshes of all links below `paths.robot`, nested as the links are, and how the joints move them.

    Joints whose positions are not known stay at 0; a robot without a description is not shown.

    Raises:
        RecordingError: A mesh of the robot's model cannot be read.
    """
    info, description, positions = episode.simulated, episode.robot_description, episode.joint_position
    if info is not None:
        urdf, meshes = robot_model(info.robot.urdf, info.scene.robot.scale, description)
    elif description is not None:
        urdf = Urdf.parse(description)
        meshes = _meshes_or_rods(description, urdf)
    else:
        return
    entities = {urdf.root: f"{paths.robot}/{urdf.root}"}
    waiting = list(urdf.joints)
    while waiting:
        for joint in [joint for joint in waiting if joint.parent in entities]:
            entities[joint.child] = f"{entities[joint.parent]}/{joint.child}"
            waiting.remove(joint)
    log_pose(recording, entities[urdf.root], episode.world_from_base.vector())
    for joint in urdf.joints:
        entity = entities[joint.child]
        if joint.kind == "fixed" or joint.name not in positions:
            log_pose(recording, entity, joint.parent_from_joint.vector())
        else:
            poses = np.concatenate(joint_columns(joint, positions[joint.name]), axis=1)
            send_poses(recording, entity, episode.time_ns, poses)
    for link, mesh in meshes.items():
        recording.log(entities[link], as_mesh3d(mesh, tint), static=True)


def _meshes_or_rods(text: str, urdf: Urdf) -> Mapping[str, SurfaceMesh]:
    """Link -> what it looks like; rods between the joints where the URDF names files that are not here."""
    try:
        return urdf_meshes(text, None)
    except (DemorecError, OSError, ValueError) as error:
        log.warning("The robot is drawn as rods between its joints, since %s.", as_reason(error))
        return skeleton_meshes(urdf)


def as_mesh3d(mesh: SurfaceMesh, tint: Rgba | None = None) -> rr.Mesh3D:
    """For Rerun; `tint` multiplies the colours and, as the only way to do so, makes the mesh translucent."""
    return rr.Mesh3D(
        vertex_positions=mesh.vertices,
        vertex_normals=mesh.normals,
        triangle_indices=mesh.triangles,
        vertex_colors=mesh.colors,
        albedo_factor=None if tint is None else list(tint),
    )


def joint_columns(joint: UrdfJoint, position: Array) -> tuple[Array, Array]:
    """(T, 3) and (T, 4): parent_from_child of a joint at each position (rad or m)."""
    fixed, axis = joint.parent_from_joint, np.array(joint.axis)
    origin = np.tile(fixed.position, (len(position), 1))
    if joint.kind == "prismatic":
        direction = fixed.apply(axis) - fixed.position
        return origin + position[:, None] * direction, np.tile(fixed.quat_xyzw, (len(position), 1))
    half = position / 2
    turned = quat_multiply(fixed.quat_xyzw, (*joint.axis, 0.0))
    return origin, np.sin(half)[:, None] * turned + np.cos(half)[:, None] * fixed.quat_xyzw


@functools.lru_cache(maxsize=4)
def robot_model(urdf: str, scale: float, description: str | None) -> tuple[Urdf, Mapping[str, SurfaceMesh]]:
    """The joint tree and the links' meshes: the installed model, or else the recorded description.

    The installed model is used when all of it is there and its joints are where the recording has them.

    Raises:
        SceneError, MissingDependencyError, RecordingError: The model is not installed and there is no description.
    """
    recorded = None if description is None else Urdf.parse(description)
    try:
        path = asset_path(urdf)
        text = path.read_text()
        installed = Urdf.parse(text, scale=scale)
        meshes = urdf_meshes(text, path.parent, scale)
    except (DemorecError, OSError, ValueError) as error:
        if recorded is None:
            raise
        reason = as_reason(error)
    else:
        if recorded is None or _same_joints(installed, recorded):
            return installed, meshes
        reason = f"the model installed here has other joints ({urdf})"
    assert description is not None
    assert recorded is not None
    log.warning("The robot is drawn as the boxes and cylinders of the recording, since %s.", reason)
    return recorded, urdf_meshes(description, None)


def _same_joints(a: Urdf, b: Urdf) -> bool:
    if [joint.name for joint in a.joints] != [joint.name for joint in b.joints]:
        return False
    distances = [
        np.abs(first.parent_from_joint.position - second.parent_from_joint.position).max()
        for first, second in zip(a.joints, b.joints, strict=True)
    ]
    return max(distances, default=0.0) < _SAME_PLACE
