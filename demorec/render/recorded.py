"""Recorded states as renderers want them, without a simulator.

Bodies, their numbers and all poses are those of `demorec.sim.world.World`, to the bit, so that images drawn from a
recording are those that were drawn while it was made.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from demorec.core.errors import SceneError, describe_error
from demorec.core.geometry import Array, Pose
from demorec.episode.scene import Body, Rgba, Scene
from demorec.render import Mount, Visual, VisualBody
from demorec.robots.assets import asset_path, mesh_path, surface_file
from demorec.robots.bullet_kinematics import BulletBody, as_told, origin_as_told, standing_as_told
from demorec.robots.robot import RobotSpec
from demorec.robots.urdf import read_links

_WHITE: Rgba = (1.0, 1.0, 1.0, 1.0)


class RecordedWorld:
    """A scene at recorded states, one at a time; the counterpart of `World` for `demorec.render.painter.Painter`.

    Args:
        robot: The arm.
        scene: As it was recorded, or with other cameras and looks.
        joint_position: (T, n_joints) in the order of `RobotSpec.joint_names`; rad, fingers m.
        object_poses: Name -> (T, 7) world_from_object of every movable body: position, quaternion xyzw.

    Attributes:
        scene: The scene.
        frame: Which state is shown, 0 .. T - 1.
        all_poses: (T, n, 7) poses of all bodies and links at every frame, as `poses` gives them of one.

    Raises:
        SceneError: A model file is missing or broken.
    """

    def __init__(
        self, robot: RobotSpec, scene: Scene, *, joint_position: Array, object_poses: Mapping[str, Array]
    ) -> None:
        self.scene = scene
        self.frame = 0
        bodies, poses = [], []
        for body in scene.fixed:
            visuals, model = _load_body(body)
            bodies.append(visuals)
            poses.append(_poses_of_fixed(body, model))
        placement = scene.robot
        visuals, arm = _load_urdf(robot.urdf, placement.scale, name=robot.name, is_fixed=True)
        self._mounts = _mounts(arm, len(bodies))
        bodies.append(visuals)
        positions = dict(zip(robot.joint_names, joint_position.T, strict=True))
        poses.append(arm.poses(placement.world_from_base.vector()[None], positions))
        for body in scene.movable:
            visuals, model = _load_body(body)
            bodies.append(visuals)
            poses.append(_poses_of_movable(object_poses[body.name], model))
        self._visuals = tuple(bodies)
        count = len(joint_position)
        self.all_poses = np.concatenate([np.broadcast_to(rows, (count, *rows.shape[1:])) for rows in poses], axis=1)

    def visuals(self) -> tuple[VisualBody, ...]:
        """What can be seen: the fixed bodies, the robot, the movable bodies."""
        return self._visuals

    def mounts(self) -> Mapping[str, Mount]:
        """Links of the robot, by name, for cameras."""
        return self._mounts

    def poses(self) -> Array:
        """(n, 7) poses of all bodies and links at the present frame, as `Renderer.render` takes them."""
        return np.asarray(self.all_poses[self.frame])


def _poses_of_fixed(body: Body, model: BulletBody | None) -> Array:
    """(1, n, 7)."""
    if model is None:
        return standing_as_told(body.world_from_body).vector()[None, None]
    return model.poses(body.world_from_body.vector()[None], {})


def _poses_of_movable(recorded: Array, model: BulletBody | None) -> Array:
    """(T, n, 7) from the recorded poses (T, 7); joints of its own are at rest."""
    if model is None:
        return recorded[:, None]
    poses = model.poses(recorded, {})
    if model.base_from_inertial == Pose():
        poses[:, 0] = recorded
    return poses


def _mounts(arm: BulletBody, body: int) -> Mapping[str, Mount]:
    base = {arm.link_names[0]: Mount(body=body, link=-1, link_from_mount=arm.base_from_inertial.inverse())}
    return base | {name: Mount(body=body, link=link) for link, name in enumerate(arm.link_names[1:])}


def _load_body(body: Body) -> tuple[VisualBody, BulletBody | None]:
    """What a body looks like, and its links where it has a URDF."""
    if body.shape.kind == "urdf":
        visuals, model = _load_urdf(body.shape.file, body.shape.scale, name=body.name, is_fixed=body.mass == 0)
        visuals = replace(visuals, texture=body.texture)
        if body.rgba == _WHITE:  # the model's own colours stay
            return visuals, model
        colored = tuple(replace(visual, rgba=body.rgba) for visual in visuals.visuals)
        return replace(visuals, visuals=colored), model
    shape = body.shape
    visual = Visual(
        link=-1,
        kind=body.shape.kind,
        size=(shape.scale,) * 3 if shape.kind == "mesh" else shape.size,
        file=str(surface_file(shape)) if shape.kind == "mesh" else "",
        link_from_shape=as_told(shape.body_from_mesh),
        rgba=_in_single(body.rgba),
    )
    is_fixed = body.mass == 0
    return VisualBody(name=body.name, num_links=0, is_fixed=is_fixed, visuals=(visual,), texture=body.texture), None


def _load_urdf(urdf: str, scale: float, *, name: str, is_fixed: bool) -> tuple[VisualBody, BulletBody]:
    path = asset_path(urdf)
    try:
        return _body_of(path.read_text(), path.parent, scale, name=name, is_fixed=is_fixed)
    except (OSError, ValueError) as error:
        raise SceneError(f"The model of {name!r} cannot be read from {urdf!r} ({describe_error(error)}).") from error


@lru_cache(maxsize=64)  # all recordings of a robot have the same
def _body_of(text: str, folder: Path, scale: float, *, name: str, is_fixed: bool) -> tuple[VisualBody, BulletBody]:
    """Of a URDF's text, whose meshes are named from a folder; ValueError: it is broken."""
    model = BulletBody(text, scale=scale)
    links = {link.name: link for link in read_links(text, scale=scale)}
    visuals = []
    for number, link in enumerate(model.link_names, start=-1):
        for shape in links[link].seen:
            pose = origin_as_told(shape.link_from_shape)
            visuals.append(
                Visual(
                    link=number,
                    kind=shape.kind,
                    size=shape.size,
                    file=str(mesh_path(folder, shape.file)) if shape.kind == "mesh" else "",
                    link_from_shape=pose if number >= 0 else model.base_from_inertial.inverse() @ pose,
                    rgba=_WHITE if shape.rgba is None else _in_single(shape.rgba),
                )
            )
    body = VisualBody(name=name, num_links=len(model.link_names) - 1, is_fixed=is_fixed, visuals=tuple(visuals))
    return body, model


def _in_single(rgba: Rgba) -> Rgba:
    """A colour in single precision, in which PyBullet keeps those of materials."""
    r, g, b, a = (float(np.float32(value)) for value in rgba)
    return (r, g, b, a)
