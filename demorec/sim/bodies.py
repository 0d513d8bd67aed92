"""Conversion of scene bodies and URDFs into PyBullet bodies, and of a client's shapes into plain data for renderers."""

from __future__ import annotations

import functools
import os
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from demorec.core.errors import DemorecError, RenderError, SceneError
from demorec.core.geometry import Array, Pose
from demorec.episode.mesh import decode_mesh
from demorec.episode.scene import Body, Texture
from demorec.render import Visual, VisualBody, VisualKind
from demorec.robots.assets import asset_path, collision_file, mesh_path, surface_file
from demorec.robots.model_check import check_masses, for_simulator
from demorec.robots.urdf import mesh_elements, parse_xml, read_links
from demorec.sim.client import silence


def add_body(client: Any, body: Body) -> int:
    """Create one body at its initial pose and return its PyBullet index.

    Raises:
        SceneError: The shape's file is missing or cannot be loaded.
    """
    pose, shape = body.world_from_body, body.shape
    if shape.kind == "urdf":
        what = f"body {body.name!r}"
        index = load_urdf(client, shape.file, pose, scale=shape.scale, is_fixed=not body.movable, what=what)
        if body.mass > 0:
            client.changeDynamics(index, -1, mass=body.mass)
        if body.rgba != (1.0, 1.0, 1.0, 1.0):
            for link in range(-1, client.getNumJoints(index)):
                client.changeVisualShape(index, link, rgbaColor=body.rgba)
    else:
        frame = shape.body_from_mesh
        place = {"FramePosition": frame.position.tolist(), "FrameOrientation": frame.quat_xyzw.tolist()}
        size, file, parts = shape.size, "", ""
        if shape.kind == "mesh":
            size = (shape.scale,) * 3
            file, parts = str(surface_file(shape)), str(collision_file(shape))
        collision = -1
        if body.collides:  # PyBullet uses the convex hull of a mesh
            geometry = shape_arguments(client, shape.kind, size, parts, length_name="height")
            with silence():  # PyBullet may warn about a mesh
                collision = client.createCollisionShape(**geometry, **{f"collision{k}": v for k, v in place.items()})
        geometry = shape_arguments(client, shape.kind, size, file)
        placed = {f"visual{k}": v for k, v in place.items()}
        visual = client.createVisualShape(**geometry, **placed, rgbaColor=body.rgba)
        index = client.createMultiBody(body.mass, collision, visual, pose.position.tolist(), pose.quat_xyzw.tolist())
        if shape.mesh and body.movable:  # PyBullet uses the moments of the bounding box
            inertia = body.mass * shape.scale**2 * decode_mesh(shape.mesh).mass_properties()[2]
            client.changeDynamics(index, -1, localInertiaDiagonal=inertia.tolist())
    for link in range(-1, client.getNumJoints(index)):
        client.changeDynamics(
            index,
            link,
            lateralFriction=body.lateral_friction,
            spinningFriction=body.spinning_friction,
            rollingFriction=body.rolling_friction,
            restitution=body.restitution,
            linearDamping=body.linear_damping,
            angularDamping=body.angular_damping,
        )
        if not body.collides:
            client.setCollisionFilterGroupMask(index, link, 0, 0)
    return int(index)


def shape_arguments(
    client: Any, kind: str, size: Sequence[float], file: str = "", *, length_name: str = "length"
) -> dict[str, Any]:
    """Build the arguments of createVisualShape, or of createCollisionShape (`length_name` "height").

    Args:
        client: The PyBullet client.
        kind, size, file: As in `demorec.render.Visual`.
        length_name: Argument name for the length of a cylinder or capsule.

    Raises:
        SceneError: Unknown shape.
    """
    match kind:
        case "box":
            return {"shapeType": client.GEOM_BOX, "halfExtents": [v / 2 for v in size]}
        case "sphere":
            return {"shapeType": client.GEOM_SPHERE, "radius": size[0]}
        case "cylinder" | "capsule":
            shape = client.GEOM_CYLINDER if kind == "cylinder" else client.GEOM_CAPSULE
            return {"shapeType": shape, "radius": size[0], length_name: size[1]}
        case "mesh":
            return {"shapeType": client.GEOM_MESH, "fileName": file, "meshScale": size}
    raise SceneError(f"A body of shape {kind!r} cannot be built.")


def load_urdf(
    client: Any, name: str, pose: Pose, *, scale: float, is_fixed: bool, what: str, is_robot: bool = False
) -> int:
    """Load a URDF and return its PyBullet index.

    Args:
        client: The PyBullet client.
        name: As in `demorec.robots.assets.asset_path`.
        pose: Pose of its base.
        scale: Uniform scale.
        is_fixed: Whether physics cannot move its base.
        what: Name of the model in messages ("body 'duck'").
        is_robot: Whether each link must specify its mass, and a frame has none.

    Raises:
        ConfigError: A robot's link does not specify its mass.
        SceneError: The URDF or one of its meshes is missing or cannot be loaded.
    """
    if is_robot:
        check_masses(name)
    try:
        with urdf_file(name, is_robot=is_robot) as path, silence():
            place = pose.position.tolist(), pose.quat_xyzw.tolist()
            return int(client.loadURDF(path, *place, useFixedBase=is_fixed, globalScaling=scale))
    except DemorecError:
        raise
    except Exception as error:  # PyBullet raises its own bare pybullet.error
        raise SceneError(f"The {what} cannot be loaded from {name!r} ({error}).") from error


@contextmanager
def urdf_file(name: str, *, is_robot: bool = False) -> Iterator[str]:
    """Write a file that PyBullet can load while the context lasts.

    Args:
        name: As in `demorec.robots.assets.asset_path`.
        is_robot: Whether links without `<inertial>` become massless frames and damping is left to `lossy_motors`.

    Raises:
        SceneError: The URDF or one of its meshes is missing.
    """
    path = asset_path(name)
    text = path.read_text()
    descriptor, copy = tempfile.mkstemp(suffix=".urdf", prefix="demorec_")
    try:
        with os.fdopen(descriptor, "w") as file:
            file.write(_without_visual_meshes(for_simulator(text) if is_robot else text, path.parent))
        yield copy
    finally:
        Path(copy).unlink()


@functools.cache
def _without_visual_meshes(text: str, folder: Path) -> str:
    """Return a URDF with a box in place of each visual mesh, and the absolute paths of all other meshes.

    PyBullet would read the visual meshes at each load (50 ms and 60 MB for a Panda), but the renderers draw from the
    files.
    """
    robot = parse_xml(text)
    meshes = {mesh: mesh_path(folder, mesh.attrib["filename"]) for mesh in mesh_elements(robot)}
    for mesh, path in meshes.items():
        mesh.set("filename", str(path))
    for geometry in robot.iterfind("link/visual/geometry"):
        if geometry.find("*") in meshes:
            geometry[:] = [ET.Element("box", size="1 1 1")]
    return ET.tostring(robot, encoding="unicode")


def visual_bodies(
    client: Any,
    *,
    names: Mapping[int, str],
    textures: Mapping[int, Texture],
    models: Mapping[int, tuple[str, float]],
) -> tuple[VisualBody, ...]:
    """Collect the visible bodies of a client.

    Args:
        client: Client with consecutively numbered bodies.
        names: Body -> name; other bodies keep PyBullet's name.
        textures: Body -> procedural texture: PyBullet cannot return its pixels.
        models: Body -> URDF and scale, for the bodies loaded by `load_urdf`.

    Raises:
        RenderError: Some shape has a kind that no renderer draws.
    """
    bodies = []
    for body in range(client.getNumBodies()):
        dynamics = client.getDynamicsInfo(body, -1)
        name = names.get(body) or client.getBodyInfo(body)[1].decode()
        inertial_from_base = base_from_inertial(client, body).inverse()
        visuals = [_visual(client, row, name, inertial_from_base) for row in client.getVisualShapeData(body)]
        if body in models:
            visuals = list(_with_urdf_meshes(client, body, visuals, *models[body]))
        bodies.append(
            VisualBody(
                name=name,
                num_links=client.getNumJoints(body),
                is_fixed=dynamics[0] == 0,
                visuals=tuple(visuals),
                texture=textures.get(body),
            )
        )
    return tuple(bodies)


def _with_urdf_meshes(client: Any, body: int, visuals: Sequence[Visual], model: str, scale: float) -> Iterator[Visual]:
    """Yield a body's visuals with the URDF's meshes restored in place of PyBullet's boxes."""
    path = asset_path(model)
    shapes = {link.name: iter(link.visuals) for link in read_links(path.read_text(), scale=scale)}
    links = {-1: client.getBodyInfo(body)[0].decode()}
    for joint in range(client.getNumJoints(body)):
        links[joint] = client.getJointInfo(body, joint)[12].decode()
    for visual in visuals:
        shape = next(shapes[links[visual.link]], None)  # None where PyBullet shows the collision shape
        if shape is not None and shape.kind == "mesh":
            yield replace(visual, kind="mesh", size=shape.size, file=str(mesh_path(path.parent, shape.file)))
        else:
            yield visual


def base_from_inertial(client: Any, body: int) -> Pose:
    """Return the pose of the base's centre of mass, which PyBullet reports as the body's pose."""
    dynamics = client.getDynamicsInfo(body, -1)
    return Pose(position=np.array(dynamics[3]), quat_xyzw=np.array(dynamics[4]))


def body_poses(client: Any) -> Array:
    """Read (n, 7) poses for `Renderer.render`: for each body the base's centre of mass, then its links' frames."""
    rows: list[tuple[float, ...]] = []
    for body in range(client.getNumBodies()):
        position, quat = client.getBasePositionAndOrientation(body)
        rows.append(position + quat)
        links = range(client.getNumJoints(body))
        if links:
            states = client.getLinkStates(body, list(links), computeForwardKinematics=1)
            rows += [state[4] + state[5] for state in states]
    return np.array(rows).reshape(-1, 7)


def _visual(client: Any, row: tuple[Any, ...], name: str, inertial_from_base: Pose) -> Visual:
    body, link, kind, dimensions, file, position, quat, rgba = row[:8]
    known: dict[int, tuple[VisualKind, tuple[float, ...]]] = {
        client.GEOM_MESH: ("mesh", dimensions),
        client.GEOM_BOX: ("box", dimensions),
        client.GEOM_SPHERE: ("sphere", dimensions[:1]),
        client.GEOM_CYLINDER: ("cylinder", (dimensions[1], dimensions[0])),
        client.GEOM_CAPSULE: ("capsule", (dimensions[1], dimensions[0])),
    }
    if kind not in known:
        raise RenderError(
            f"Body {body} ({name!r}), link {link}: PyBullet's visual shape of kind {kind} cannot be drawn: "
            "use a mesh, box, sphere, cylinder or capsule."
        )
    kind_name, size = known[kind]
    link_from_shape = Pose(position=np.array(position), quat_xyzw=np.array(quat))
    return Visual(
        link=link,
        kind=kind_name,
        size=tuple(size),
        file=_mesh_file(file.decode()) if kind_name == "mesh" else "",
        link_from_shape=inertial_from_base @ link_from_shape if link == -1 else link_from_shape,
        rgba=rgba,
    )


def _mesh_file(name: str) -> str:
    """Resolve a file name as PyBullet does: it also searches pybullet_data and returns names unresolved."""
    path = Path(name)
    return name if path.is_absolute() or path.exists() else str(asset_path(name))
