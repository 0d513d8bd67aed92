"""Scene bodies into PyBullet bodies."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from demorec.core.errors import SceneError
from demorec.episode.scene import Body
from demorec.robots.assets import asset_path
from demorec.sim.client import silence
from demorec.sim.urdf_file import load_urdf


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
        size, file = shape.size, ""
        if shape.kind == "mesh":
            size, file = (shape.scale,) * 3, str(asset_path(shape.file))
        collision = -1
        if body.collides:  # a mesh becomes its convex hull
            geometry = shape_arguments(client, shape.kind, size, file, length_name="height")
            with silence():  # a mesh may be warned of
                collision = client.createCollisionShape(**geometry, **{f"collision{k}": v for k, v in place.items()})
        geometry = shape_arguments(client, shape.kind, size, file)
        placed = {f"visual{k}": v for k, v in place.items()}
        visual = client.createVisualShape(**geometry, **placed, rgbaColor=body.rgba)
        index = client.createMultiBody(body.mass, collision, visual, pose.position.tolist(), pose.quat_xyzw.tolist())
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
    """Arguments of createVisualShape, or of createCollisionShape (`length_name` "height").

    Args:
        client: The PyBullet client.
        kind, size, file: As of `demorec.render.Visual`.
        length_name: What the length of a cylinder or capsule is called.

    Raises:
        SceneError: There is no such shape.
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
