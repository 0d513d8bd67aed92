"""Scenes for the renderers, and the expected images of a camera, computed by ray casting in NumPy."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pybullet
import pybullet_data
from numpy.typing import NDArray
from pybullet_utils.bullet_client import BulletClient

from demorec.core.geometry import Pose, look_at
from demorec.episode.episode import CameraImages
from demorec.episode.scene import SceneCamera, Texture
from demorec.render import Mount, Renderer, RenderSetup
from demorec.sim.bodies import body_poses, visual_bodies

DATA = pybullet_data.getDataPath()


def connect() -> Any:
    client = BulletClient(pybullet.DIRECT)
    client.setAdditionalSearchPath(DATA)
    return client


def camera(width: int = 224, height: int = 224, **changes: Any) -> SceneCamera:
    """A camera that looks down at the origin from the front left."""
    base = SceneCamera(
        name="front",
        width=width,
        height=height,
        fov_y=math.radians(50),
        mount="world",
        mount_from_camera=look_at((0.9, -0.45, 0.75), (0.0, 0.0, 0.05)),
    )
    return replace(base, **changes)


def setup(
    client: Any, *cameras: SceneCamera, textures: dict[int, Texture] | None = None, **changes: Any
) -> RenderSetup:
    """A setup of a client's bodies, with depth and segmentation."""
    bodies = visual_bodies(client, names={}, textures=textures or {}, models={})
    fields: dict[str, Any] = {"bodies": bodies, "cameras": cameras, "depth": True, "segmentation": True, **changes}
    return RenderSetup(**fields)


def draw(renderer: Renderer, client: Any) -> dict[str, CameraImages]:
    """Draw the present state of a client with a renderer that was set up for it."""
    return renderer.render(body_poses(client))


def add(client: Any, kind: str, size: tuple[float, ...], pose: Pose | None = None, **visual: Any) -> int:
    """Add a body of one visual shape, fixed (mass 0) unless a mass is given; returns its index."""
    pose = pose or Pose()
    mass = visual.pop("mass", 0.0)
    geometry = {
        "box": lambda: {"shapeType": pybullet.GEOM_BOX, "halfExtents": [v / 2 for v in size]},
        "sphere": lambda: {"shapeType": pybullet.GEOM_SPHERE, "radius": size[0]},
        "cylinder": lambda: {"shapeType": pybullet.GEOM_CYLINDER, "radius": size[0], "length": size[1]},
        "capsule": lambda: {"shapeType": pybullet.GEOM_CAPSULE, "radius": size[0], "length": size[1]},
        "mesh": lambda: {"shapeType": pybullet.GEOM_MESH, "meshScale": list(size)},
    }[kind]()
    shape = client.createVisualShape(**(geometry | {"rgbaColor": [0.8, 0.3, 0.2, 1.0]} | visual))
    return int(client.createMultiBody(mass, -1, shape, pose.position.tolist(), pose.quat_xyzw.tolist()))


def rays(cam: SceneCamera, world_from_body: Pose) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Origin (3,) and directions (H, W, 3) through the pixels' centres in a body's frame, of depth 1."""
    k = cam.intrinsics
    u, v = np.meshgrid(np.arange(cam.width) + 0.5, np.arange(cam.height) + 0.5)
    directions = np.stack([(u - k[0, 2]) / k[0, 0], (v - k[1, 2]) / k[1, 1], np.ones_like(u)], -1)
    body_from_camera = world_from_body.inverse() @ cam.mount_from_camera
    return np.array(body_from_camera.position), directions @ body_from_camera.rotation.T


def cast_sphere(radius: float, origin: Any, direction: Any, centre: Any = (0, 0, 0)) -> NDArray[np.float64]:
    """(H, W) depth of a sphere, inf for rays that miss it."""
    o = np.asarray(origin) - np.asarray(centre)
    a, b, c = (direction**2).sum(-1), (direction * o).sum(-1), (o * o).sum() - radius**2
    root = b * b - a * c
    depth = (-b - np.sqrt(np.maximum(root, 0))) / a
    return np.where((root >= 0) & (depth > 0), depth, np.inf)


def cast_box(size: Any, origin: Any, direction: Any) -> NDArray[np.float64]:
    half = np.asarray(size) / 2
    with np.errstate(divide="ignore", invalid="ignore"):
        one, two = (-half - origin) / direction, (half - origin) / direction
    enter, leave = np.minimum(one, two).max(-1), np.maximum(one, two).min(-1)
    return np.where((enter <= leave) & (enter > 0), enter, np.inf)


def cast_tube(radius: float, length: float, origin: Any, direction: Any) -> NDArray[np.float64]:
    """(H, W) depth of the side of a cylinder along z."""
    a = (direction[..., :2] ** 2).sum(-1)
    b = (direction[..., :2] * origin[:2]).sum(-1)
    root = b * b - a * ((origin[:2] ** 2).sum() - radius**2)
    depth = (-b - np.sqrt(np.maximum(root, 0))) / a
    z = origin[2] + depth * direction[..., 2]
    return np.where((root >= 0) & (depth > 0) & (np.abs(z) <= length / 2), depth, np.inf)


def cast_cylinder(radius: float, length: float, origin: Any, direction: Any) -> NDArray[np.float64]:
    """(H, W) depth of a closed cylinder along z."""
    depth = cast_tube(radius, length, origin, direction)
    for height in (-length / 2, length / 2):
        lid = (height - origin[2]) / direction[..., 2]
        place = origin[:2] + lid[..., None] * direction[..., :2]
        depth = np.where((lid > 0) & ((place**2).sum(-1) <= radius**2), np.minimum(depth, lid), depth)
    return depth


def cast_capsule(radius: float, length: float, origin: Any, direction: Any) -> NDArray[np.float64]:
    """(H, W) depth of a capsule along z, `length` between the centres of its half spheres."""
    ends = [cast_sphere(radius, origin, direction, (0, 0, z)) for z in (-length / 2, length / 2)]
    return np.asarray(np.minimum.reduce([cast_tube(radius, length, origin, direction), *ends]))


def away_from_borders(labels: NDArray[np.int32], distance: int = 1) -> NDArray[np.bool_]:
    """(H, W) whether all neighbours of a pixel within `distance` have the same label."""
    same = np.ones(labels.shape, dtype=bool)
    for dy in range(-distance, distance + 1):
        for dx in range(-distance, distance + 1):
            same &= np.roll(labels, (dy, dx), (0, 1)) == labels
    same[:distance] = same[-distance:] = False
    same[:, :distance] = same[:, -distance:] = False
    return same


def panda_scene(client: Any) -> dict[str, Any]:
    """A Panda behind a textured table with three cubes on a floor: bodies by name, and the robot's moving joints."""
    bodies: dict[str, Any] = {
        "floor": client.loadURDF("plane.urdf", [0, 0, -0.65]),
        "table": client.loadURDF("table/table.urdf", [0.5, 0, -0.65], useFixedBase=True),
        "panda": client.loadURDF("franka_panda/panda.urdf", useFixedBase=True),
    }
    for number, (x, y) in enumerate([(0.5, 0.0), (0.6, 0.15), (0.45, -0.18)]):
        cube = client.loadURDF("cube_small.urdf", [x, y, 0.0])
        client.changeVisualShape(cube, -1, rgbaColor=[0.9 * (number == i) + 0.05 for i in range(3)] + [1])
        bodies[f"cube{number}"] = cube
    robot = bodies["panda"]
    bodies["joints"] = [
        j for j in range(client.getNumJoints(robot)) if client.getJointInfo(robot, j)[2] != pybullet.JOINT_FIXED
    ]
    pose_panda(client, bodies, 0.0)
    return bodies


def pose_panda(client: Any, bodies: dict[str, Any], t: float) -> None:
    """Move the arm to a point of a path, and the first cube too."""
    home = (0.0, -0.3, 0.0, -2.2, 0.0, 2.0, 0.785, 0.04, 0.04)
    for k, (joint, q) in enumerate(zip(bodies["joints"], home, strict=True)):
        client.resetJointState(bodies["panda"], joint, q + (0.25 * math.sin(t + k) if k < 7 else 0.0))
    client.resetBasePositionAndOrientation(
        bodies["cube0"], [0.5 + 0.05 * math.sin(t), 0.0, 0.05], [0, 0, math.sin(t / 2), math.cos(t / 2)]
    )


def panda_cameras(width: int, height: int) -> tuple[SceneCamera, SceneCamera]:
    """One in the world, one on the hand."""
    front = SceneCamera(
        name="front",
        width=width,
        height=height,
        fov_y=math.radians(55),
        mount="world",
        mount_from_camera=look_at((1.3, -0.5, 0.8), (0.4, 0.0, 0.15)),
    )
    wrist = SceneCamera(
        name="wrist",
        width=width,
        height=height,
        fov_y=math.radians(70),
        mount="hand",
        mount_from_camera=Pose(
            position=np.array([0.07, 0.0, 0.0]), quat_xyzw=np.array([0, 0, math.sqrt(0.5), math.sqrt(0.5)])
        ),
    )
    return front, wrist


def panda_mounts(bodies: dict[str, Any]) -> dict[str, Mount]:
    return {"hand": Mount(body=bodies["panda"], link=8)}
