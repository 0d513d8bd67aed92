"""Scene bodies into PyBullet bodies."""

from __future__ import annotations

from typing import Any

from demorec.errors import DemorecError, SceneError
from demorec.scene.assets import asset_path
from demorec.scene.scene import Body, Shape
from demorec.sim.urdf_file import urdf_file


def add_body(client: Any, body: Body) -> int:
    """Create one body at its initial pose and return its PyBullet index.

    Raises:
        SceneError: The shape's file is missing or cannot be loaded.
    """
    pose = body.world_from_body
    position, quat = pose.position.tolist(), pose.quat_xyzw.tolist()
    if body.shape.kind == "urdf":
        try:
            with urdf_file(body.shape.file) as path:
                index = client.loadURDF(
                    path,
                    position,
                    quat,
                    useFixedBase=not body.movable,
                    globalScaling=body.shape.scale,
                )
        except DemorecError:
            raise
        except Exception as error:  # PyBullet raises its own bare pybullet.error
            raise SceneError(f"The body {body.name!r} cannot be loaded from {body.shape.file!r} ({error}).") from error
        if body.mass > 0:
            client.changeDynamics(index, -1, mass=body.mass)
        if body.rgba != (1.0, 1.0, 1.0, 1.0):
            for link in range(-1, client.getNumJoints(index)):
                client.changeVisualShape(index, link, rgbaColor=body.rgba)
    else:
        frame = body.shape.body_from_mesh
        place = {"FramePosition": frame.position.tolist(), "FrameOrientation": frame.quat_xyzw.tolist()}
        collision = -1
        if body.collides:  # a mesh becomes its convex hull
            geometry = _geometry(client, body.shape, length_name="height")
            collision = client.createCollisionShape(**geometry, **{f"collision{k}": v for k, v in place.items()})
        geometry = _geometry(client, body.shape, length_name="length")
        placed = {f"visual{k}": v for k, v in place.items()}
        visual = client.createVisualShape(**geometry, **placed, rgbaColor=body.rgba)
        index = client.createMultiBody(body.mass, collision, visual, position, quat)
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


def _geometry(client: Any, shape: Shape, *, length_name: str) -> dict[str, Any]:
    """Arguments of createCollisionShape ("height" of a cylinder) or createVisualShape (its "length")."""
    match shape.kind:
        case "box":
            return {"shapeType": client.GEOM_BOX, "halfExtents": [v / 2 for v in shape.size]}
        case "sphere":
            return {"shapeType": client.GEOM_SPHERE, "radius": shape.size[0]}
        case "cylinder":
            return {"shapeType": client.GEOM_CYLINDER, "radius": shape.size[0], length_name: shape.size[1]}
        case "capsule":
            return {"shapeType": client.GEOM_CAPSULE, "radius": shape.size[0], length_name: shape.size[1]}
        case "mesh":
            path = str(asset_path(shape.file))
            return {"shapeType": client.GEOM_MESH, "fileName": path, "meshScale": [shape.scale] * 3}
    raise SceneError(f"A body of shape {shape.kind!r} cannot be built.")
