"""The coordinate frames of an episode (ROS: TF): their tree, and the motion of the moving ones.

Every link of a described robot, every body and every camera with a pose is a frame. Frames moved by joints or physics
are on `/tf` at each time step, the rest on `/tf_static`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from demorec.core.geometry import Array, Pose, quat_multiply
from demorec.episode.episode import Table, Vector
from demorec.episode.info import Camera, EpisodeInfo, Feature
from demorec.episode.protocol import SceneMotion
from demorec.episode.scene import Scene
from demorec.mcap import messages
from demorec.mcap.cdr import Slot, layout
from demorec.mcap.streams import POSE_SLOTS, WORLD
from demorec.robots.urdf import Urdf, joint_motion

RERUN_ROOT = "tf#/"
"""Rerun's name of its scene's root: without this row its 3D view cannot connect any frame to it."""

Row = tuple[str, str, Pose]
"""Parent frame, child frame, parent_from_child."""


def camera_frame(camera: str) -> str:
    """Coordinate frame of a camera, in OpenCV axes (ROS: "optical")."""
    return f"camera_{camera}"


class FrameTree:
    """Coordinate frames of one episode, given the names of the recorded joints; any other joint stays at 0.

    `layout` is that of the messages on `/tf`, None if nothing moves; `static` has the rows that never change.
    """

    def __init__(
        self, urdf: Urdf, joints: Sequence[str], cameras: Sequence[Camera], scene: Scene | None = None
    ) -> None:
        bodies = () if scene is None else scene.bodies
        self._joints = MovingJoints(urdf, joints)
        moving = (*self._joints.moving, *((WORLD, body.name) for body in bodies if body.movable))
        rows = tuple(((Slot.TIME, parent), child, POSE_SLOTS) for parent, child in moving)
        self.layout = layout(messages.TRANSFORMS, rows) if rows else None
        self.static: tuple[Row, ...] = (
            (RERUN_ROOT, WORLD, Pose()),
            (WORLD, urdf.root, Pose() if scene is None else scene.robot.world_from_base),
            *self._joints.static,
            *((WORLD, body.name, body.world_from_body) for body in bodies if not body.movable),
            *(
                (camera.mount or urdf.root, camera_frame(camera.name), camera.mount_from_camera)
                for camera in cameras
                if camera.mount_from_camera is not None
            ),
        )

    def rows(self, positions: Array, poses: Array) -> Array:
        """Compute the moving frames (N, 7 m), given joint positions (N, n) and poses of movable bodies (N, 7 k)."""
        return np.concatenate((self._joints.values(positions).reshape(len(positions), -1), poses), axis=1)


class MovingJoints:
    """parent_from_child of the recorded moving joints at once; the others stay at 0.

    A revolute joint about axis a from the fixed rotation q0: q0 * (a sin(t/2), cos(t/2)), linear in sine and cosine.
    `moving` has (parent, child) of the moving joints, `static` the rows of the others.
    """

    def __init__(self, urdf: Urdf, names: Sequence[str]) -> None:
        places = {name: index for index, name in enumerate(names)}
        joints = [joint for joint in urdf.joints if joint.kind != "fixed" and joint.name in places]
        self.moving = tuple((joint.parent, joint.child) for joint in joints)
        self.static: tuple[Row, ...] = tuple(
            (joint.parent, joint.child, joint.parent_from_joint @ joint_motion(joint, 0.0))
            for joint in urdf.joints
            if joint not in joints
        )
        slides = [joint.kind == "prismatic" for joint in joints]
        self._indices = np.array([places[joint.name] for joint in joints], dtype=np.intp)
        self._half = np.array([0.0 if slide else 0.5 for slide in slides])
        self._origin = np.zeros((len(joints), 3))
        self._slide = np.zeros((len(joints), 3))
        self._sine, self._cosine = np.zeros((len(joints), 4)), np.zeros((len(joints), 4))
        for row, joint in enumerate(joints):
            fixed = joint.parent_from_joint
            self._origin[row] = fixed.position
            self._cosine[row] = fixed.quat_xyzw
            if slides[row]:
                self._slide[row] = fixed.apply(np.array(joint.axis)) - fixed.position
            else:
                self._sine[row] = quat_multiply(fixed.quat_xyzw, (*joint.axis, 0.0))

    def values(self, joint_position: Array) -> Array:
        """Compute (N, n, 7) for N joint vectors."""
        position = joint_position[:, self._indices]
        # math.sin, since the last bit of numpy's depends on the CPU's vector unit.
        angles = (position * self._half).reshape(-1).tolist()
        sine = np.array([math.sin(angle) for angle in angles]).reshape(*position.shape, 1)
        cosine = np.array([math.cos(angle) for angle in angles]).reshape(*position.shape, 1)
        result = np.empty((*position.shape, 7))
        result[..., :3] = self._origin + self._slide * position[..., None]
        result[..., 3:] = self._sine * sine + self._cosine * cosine
        return result


def joint_places(features: Sequence[Feature]) -> dict[str, tuple[Feature, int]]:
    """Find joint -> the first observation feature, and its element, that is the joint's position."""
    places: dict[str, tuple[Feature, int]] = {}
    for feature in features:
        for index, joint in enumerate(feature.joints if feature.name.partition(".")[0] == "observation" else ()):
            if joint:
                places.setdefault(joint, (feature, index))
    return places


def joint_positions(places: Mapping[str, tuple[Feature, int]], features: Mapping[str, Vector]) -> Array:
    """Read (..., n) rad or m of the available joints from features (..., D)."""
    used = {feature.name: feature for feature, _ in places.values()}
    values = {name: feature.in_si(features[name]) for name, feature in used.items()}
    return np.stack([values[feature.name][..., index] for feature, index in places.values()], axis=-1)


def measured_motion(info: EpisodeInfo, table: Table) -> SceneMotion:
    """Compute the motion of the joints with positions in the features."""
    places = joint_places(info.features)
    if not places:
        return SceneMotion()
    positions = joint_positions(places, table.features).T
    return SceneMotion(joint_position=dict(zip(places, positions, strict=True)))
